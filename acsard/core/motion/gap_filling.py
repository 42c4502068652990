"""Fills gaps in the feedback: estimates the motion of the wheels in a gap, and its uncertainty.

`Rolling` takes the angles from encoder counts, whole counts recovered from speeds, or speed times
time, each time and count once. In a gap that no line covers, the speed before it is assumed for its
first half, and the speed after it for the second. If rest was commanded in it, the speed before
lasts until then and decays exponentially to the speed after, unless this may be the mean of the
gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import sub

from msgspec import Struct

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.motion.error_model import PERIOD_GAIN
from acsard.core.motion.gyro import REST_S
from acsard.core.motion.sanity import MAX_WHEEL_ACCELERATION, SPEED_MARGIN
from acsard.core.values import REST, Twist, WheelSpeeds

# Beyond both, the motion in consecutive implausible lines without counts is unknown. Otherwise they
# have the speed of the next plausible line. s and number.
MAX_LOST_S, MAX_LOST = 0.05, 1

AT_REST = (0.0, 0.0, 0.0, 0.0)

# Standard deviation, m/s2 and rad/s2, until it is measured: an eighth of the default limits, which
# random driving rarely exceeds.
ASSUMED_ACCELERATION = Twist(0.125, 0.5)

ACCELERATION_SPAN_S = 0.2  # over which the deviation from constant acceleration is measured

# Spans for which `ASSUMED_ACCELERATION` counts; and the most, which is a minute of driving.
INITIAL_WEIGHT, MAX_WEIGHT = 4.0, 300.0

# s for which a command counts in a gap. A board that receives nothing stops by its watchdog.
MAX_COMMANDED_S = 1.0

MIN_DECAY = 0.02  # fraction of its speed at which a wheel counts as resting

STEP_DECAY = 0.05  # of the estimated quantization step, forgotten with each line

VARIANCE_POWER = 5  # of a gap's duration, with which the variance of its motion grows


class Rolled(Struct, frozen=True, gc=False):
    """The angles that the wheels rolled since the last plausible line, rad in `WHEELS` order."""

    pieces: tuple[Motors, ...]  # from speeds, one arc each, in the order of time
    turned: Motors  # from encoder counts, before `pieces`
    seen: Motors  # in the last `seconds`; from speeds with their rounding
    seconds: float  # of the motion `seen`
    bridged: float  # part of `seconds` without a line: its speeds are assumed
    unknown: float  # s in addition to `seconds` in which the motion is unknown
    known: float  # s of `pieces` and `turned`; 0 if a part is unknown
    missed: Motors = AT_REST  # more, if the MCU missed the command to rest until its watchdog


class Rolling:
    """The angles that the wheels rolled from one plausible feedback line to the next.

    The motion in lines that `sanity.py` or `Confirmation` rejects is computed with the next one.
    """

    def __init__(self, quiet: float = math.inf) -> None:
        self._quiet = quiet  # s without feedback, after which a running daemon commands rest
        self.forget()

    def forget(self) -> None:
        """Forget the implausible lines since the last plausible one, and their motion."""
        # s of implausible lines without counts (`_lost`), with counts, of the gaps before them that
        # can (`_bridged`) or cannot (`_gap`) be filled, and of `_bridged` until rest was commanded.
        self._lost = self._gap = self._bridged = self._counted = self._driven = 0.0
        self._turned, self._skipped = AT_REST, 0

    @property
    def skipped(self) -> float:
        """Time of the implausible lines without counts since the last plausible one, s."""
        return self._lost + self._gap + self._bridged

    def skip(self, line: Feedback) -> None:
        """Record an implausible line; the motion comes from its counts, if it has any."""
        self._skipped += 1
        if line.turned is None:
            self._lost += line.dt - line.bridged
            self._gap += line.gap
            self._driven = self._driven_in(line)
            self._bridged += line.bridged
        else:
            self._counted += line.dt
            self._turned = plus(self._turned, line.turned)

    def _driven_in(self, line: Feedback) -> float:
        return self._bridged + line.driven if line.bridged else self._driven

    def take(self, line: Feedback, before: WheelSpeeds) -> Rolled:
        """Return the angles since the last plausible line, which had the speeds `before`."""
        speeds, dt, bridged = line.speeds.as_tuple(), line.dt, line.bridged + self._bridged
        if not (self._skipped or bridged or line.gap or line.turned is not None):
            # Nearly every line takes this shortcut, with the same result as below.
            angles = times(speeds, dt)
            moved = angles if line.counted is None else line.counted
            arcs = () if moved == AT_REST else (moved,)
            return Rolled(arcs, AT_REST, angles, dt, 0.0, 0.0, dt)
        # Implausible lines without counts have the speed of this line, unless they last too long.
        guessed = self._lost <= MAX_LOST_S or self._skipped <= MAX_LOST
        lost, unknown = (self._lost, 0.0) if guessed else (0.0, self._lost)
        turned, filled, unknown = self._turned, self._bridged, unknown + self._gap
        driven, missed = self._driven_in(line), AT_REST
        known = lost + filled + self._counted + dt
        if self._skipped:
            self.forget()
        if line.turned is not None:
            pieces, angles, seconds = _some(times(speeds, lost + filled)), line.turned, dt
            turned, bridged = plus(turned, line.turned), 0.0
        else:
            unknown, seconds = unknown + line.gap, lost + filled + dt
            angles = line_angles = times(speeds, seconds - bridged)
            pieces = _some(line_angles)
            if line.counted is not None:
                pieces = _some(line.counted, times(speeds, lost))
            if bridged:
                first, own = before.as_tuple(), seconds - bridged
                if self._quiet < driven < bridged + own:
                    between = _until_rest(first, driven, speeds, bridged, own)
                    stopped = max(WATCHDOG_S, driven)
                    moved_on = _until_rest(first, stopped, speeds, bridged, own)
                    missed = plus(moved_on, times(between, -1.0))
                else:
                    # A running daemon commands rest after `quiet`. After an earlier command to
                    # rest, the wheels also need about this time to slow down.
                    stops = max(self._quiet, driven)
                    on, doubtful = min(bridged / 2, stops), min(bridged, WATCHDOG_S) - stops
                    between = plus(times(first, on), times(speeds, bridged - on))
                    if doubtful > 0.0:
                        missed = times(plus(first, times(speeds, -1.0)), doubtful)
                angles, pieces = plus(between, line_angles), _some(between, *pieces)
        known = 0.0 if unknown else known
        return Rolled(pieces, turned, angles, seconds, bridged, unknown, known, missed)


def _some(*pieces: Motors) -> tuple[Motors, ...]:
    return tuple([piece for piece in pieces if piece != AT_REST])


def _until_rest(before: Motors, driven: float, after: Motors, bridged: float, own: float) -> Motors:
    # Rest was commanded `driven` s into a gap of `bridged` s; the line of the speeds `after` covers
    # the `own` s behind it. A board that computes its speeds since its last reply reports the means
    # over the whole time, which are large enough for the motion until the command to rest.
    angles, whole = [], bridged + own
    for old, new in zip(before, after, strict=True):
        if driven >= bridged and old * new > 0.0 and abs(new) > abs(old):
            angles.append((old + new) / 2 * bridged)
        elif old * new >= 0.0 and abs(new) * whole >= abs(old) * min(driven, whole):
            angles.append(new * bridged)
        elif driven >= bridged:
            angles.append(old * bridged)
        else:
            angles.append(old * driven + _slowing(old, new) * (whole - driven) - new * own)
    front_right, front_left, rear_left, rear_right = angles
    return front_right, front_left, rear_left, rear_right


def _slowing(old: float, new: float) -> float:
    ratio = new / old if old else 1.0
    if ratio >= 0.99:
        return new
    ratio = max(ratio, MIN_DECAY)
    return old * (1.0 - ratio) / -math.log(ratio)


def plus(a: Motors, b: Motors) -> Motors:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def times(a: Motors, factor: float) -> Motors:
    return a[0] * factor, a[1] * factor, a[2] * factor, a[3] * factor


class Confirmation:
    """Holds back a feedback line that follows a gap and reports a doubtful speed.

    Damage changes one wheel alone, motion both wheels of a side alike. Two lines agree if no wheel
    alone has changed by more than a limit, which a longer gap lowers. A line with counts, of the
    usual time, or that agrees with the last used line is used at once. Any other is held: if the
    next line agrees with it, both are used; if the next agrees with the last used one, the held
    line is dropped; otherwise the third decides, and a line that differs much more is dropped. The
    time of a dropped line is a gap.
    """

    def __init__(self) -> None:
        self._period = 0.0  # s between two lines; 0 before the first
        self.forget()

    def forget(self) -> None:
        self._held: list[Feedback] = []
        self._seconds = 0.0  # of the held lines with the gaps before them

    def confirm(
        self,
        line: Feedback,
        skipped: float,
        before: WheelSpeeds,
        believed: Callable[[Motors], Motors],
    ) -> tuple[list[Feedback], list[Feedback]]:
        """Return the lines to use now, in the order of time, and those to drop.

        `skipped` is the time of implausible lines directly before `line`, s, `before` the speeds of
        the last used one. `believed` replaces the speeds of faulty wheels.
        """
        period, pending, seconds = self._period, self._held, line.dt + line.gap + skipped
        # A long time counts as two periods, so that a gap changes the mean only a little.
        self._period += PERIOD_GAIN * (min(seconds, 2 * period) - period) if period else seconds
        if not pending and (seconds <= 2 * period or not period or line.turned is not None):
            return [line], []
        self._seconds = seconds = seconds + (self._seconds if pending else 0.0)
        # Such a change falsifies the whole time by as much as a damaged line of usual duration can.
        most = (MAX_WHEEL_ACCELERATION * period + SPEED_MARGIN) * period / seconds
        used, now = believed(before.as_tuple()), believed(line.speeds.as_tuple())
        lines = good_lines = [*pending, line]
        three = [*[believed(sample.speeds.as_tuple()) for sample in pending], now]
        if len(lines) == 3:
            nearest = [min(_alone(a, b, line.steps) for b in three if b is not a) for a in three]
            least = 2 * min(nearest) + most
            good_lines = [
                sample for sample, off in zip(lines, nearest, strict=True) if off <= least
            ]
        elif _alone(now, three[0] if pending else used, line.steps) > most:
            if not pending or _alone(now, used, line.steps) > most:
                pending.append(line)
                return [], []
            good_lines = [line]
        pending.clear()
        return good_lines, [sample for sample in lines if sample not in good_lines]


def _alone(a: Motors, b: Motors, steps: Motors) -> float:
    # Change of one wheel of a side without the other, beyond one quantization step, rad/s.
    changes, largest = tuple(map(sub, a, b)), 0.0
    # i and 3 - i in `WHEELS` order are of one side.
    for own, other, step in zip(changes, reversed(changes), steps, strict=True):
        explained = step if step < math.inf else 0.0
        largest = max(largest, min(abs(own), abs(own - other)) - explained)
    return largest


class Gaps:
    """The variances of the motion in gaps of the feedback.

    With the standard deviation s of the acceleration, the motion after t s is wrong by s t^2 / 2,
    and as the acceleration may change, s^2 grows with t: `VARIANCE_POWER`. `follow` measures s
    without gaps; the configured limits are seldom reached. The deviation is limited to the motion
    at the highest speed before, after or commanded in the gap, the latter for `MAX_COMMANDED_S`. So
    a robot at rest before and after a gap, without a command to move, has not moved.
    """

    def __init__(self) -> None:
        self._along = (ASSUMED_ACCELERATION.linear * ACCELERATION_SPAN_S**2 / 2) ** 2
        self._turning = (ASSUMED_ACCELERATION.angular * ACCELERATION_SPAN_S**2 / 2) ** 2
        self._spans = INITIAL_WEIGHT
        self.interrupt(REST)

    def interrupt(self, twist: Twist) -> None:
        """Start a new measurement of the acceleration with this twist."""
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0
        self._bridged, self._given = 0.0, (0.0, 0.0)

    def follow(self, twist: Twist, dt: float) -> None:
        """Measure the acceleration by a line of `dt` s without a gap before it."""
        linear, angular = twist.linear, twist.angular
        self._bridged, self._given = 0.0, (0.0, 0.0)
        self._seconds += dt
        self._distance += linear * dt
        self._turn += angular * dt
        span = self._seconds - dt  # the time between the first and the last line of the span
        if span < ACCELERATION_SPAN_S:
            return
        # Compare with the motion at the mean of the first and last speeds.
        first = self._first
        if self._distance or self._turn or linear or angular:
            off = self._distance - linear * dt - span * (first.linear + linear) / 2
            turned = self._turn - angular * dt - span * (first.angular + angular) / 2
            scale = (ACCELERATION_SPAN_S / span) ** VARIANCE_POWER
            self._spans = min(self._spans + 1.0, MAX_WEIGHT)
            self._along += (off * off * scale - self._along) / self._spans
            self._turning += (turned * turned * scale - self._turning) / self._spans
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0

    def fill(
        self,
        seconds: float,
        before: Twist,
        after: Twist,
        commanded: Twist,
    ) -> tuple[float, float]:
        """Return the variances of distance, m2, and turn, rad2, that a filled gap adds.

        A gap that follows a gap adds what makes both one longer gap. `commanded` are the highest
        speeds in it, without sign.
        """
        bridged, previous = self._bridged + seconds, self._given
        along, yaw = self.unseen(bridged, before, after, commanded)
        self.interrupt(after)
        self._bridged, self._given = bridged, (max(along, previous[0]), max(yaw, previous[1]))
        return max(0.0, along - previous[0]), max(0.0, yaw - previous[1])

    def unseen(
        self, seconds: float, before: Twist, after: Twist, commanded: Twist = REST
    ) -> tuple[float, float]:
        """Return the variances of distance, m2, and turn, rad2, in one gap (see `fill`)."""
        scale = (seconds / ACCELERATION_SPAN_S) ** VARIANCE_POWER
        driven = min(seconds, MAX_COMMANDED_S)
        fastest = max(abs(before.linear), abs(after.linear)) * seconds
        fastest = max(fastest, commanded.linear * driven)
        turning = max(abs(before.angular), abs(after.angular)) * seconds
        turning = max(turning, commanded.angular * driven)
        return min(self._along * scale, fastest**2), min(self._turning * scale, turning**2)


class Rounding:
    """How much reported speeds differ from the true ones if the encoders are coarse.

    A line of a slow wheel then has one count or none. |v0 - 2 v1 + v2| / 2 of three speeds in a row
    is about one quantization step; with many counts it is near 0, unless the acceleration changes
    or a line is damaged.
    """

    def __init__(self) -> None:
        self._last: Motors | None = None  # speeds in the last line
        self._older: Motors | None = None  # in the line before it; None after a gap
        self._step = 0.0  # largest recent one, rad/s, less `STEP_DECAY` per line
        self._before = self._after = 0.0  # of the last two lines, rad/s; they shrink at rest

    def add(
        self, speeds: Motors, own: float, still: float, after_gap: bool, largest: float
    ) -> None:
        """Use the next line, which covers `own` s (0 if unknown) without a gap before it.

        `still` is how long all wheels have reported zero, s without gaps, in which each turned by
        less than one count. `largest` is the largest possible step, rad/s.
        """
        last, older = self._last, self._older
        if after_gap:
            last = None
        elif last is not None and older is not None and not speeds == last == older == AT_REST:
            jumps = [abs(a - 2 * b + c) for a, b, c in zip(speeds, last, older, strict=True)]
            self._step = max(self._step * (1 - STEP_DECAY), max(jumps) / 2)
        if self._step > largest:
            self._step = largest
        self._last, self._older = speeds, last
        self._before, self._after = self._after, self._step
        if still > REST_S:
            self._after = 0.0
        elif still > own > 0.0:
            self._after *= own / still

    @property
    def square(self) -> float:
        """Sum of the squares of the quantization steps before and after the gap, rad2/s2.

        For t s, each speed counts for t / 2, so `TwistUncertainty.rounding` times t^2 / 4 is for
        independent errors. The caller takes t^2: both wheels of a side turn alike, which doubles
        it, and so does an encoder edge too many or too few in one line.
        """
        return self._before**2 + self._after**2
