"""Fills gaps in the feedback: estimates the motion of the wheels in a gap, and its uncertainty.

`Rolling` computes the angles that the wheels rolled since the last plausible feedback line. A line
is implausible if `sanity.py` or `Confirmation` rejects it. `Rolling` uses the first of these
sources that exists: the encoder counts in the line, whole counts that are recovered from the speeds
in the line, or these speeds times the time. Each time and each encoder count is used once.

In a gap that no line covers, `Rolling` assumes two speeds: the speed before the gap for the first
half, and the speed after the gap for the second half. If the motors were commanded to rest in the
gap, the speed before the gap is assumed until that command, and an exponential decay to the speed
after the gap from then on. An exception is a speed after the gap that may be the mean of the gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import sub

from msgspec import Struct

from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.motion.error_model import PERIOD_GAIN
from acsard.core.motion.gyro import REST_S
from acsard.core.motion.sanity import SPEED_MARGIN
from acsard.core.values import REST, Twist, WheelSpeeds

MAX_LOST_S, MAX_LOST = 0.05, 1
"""Limits for consecutive implausible feedback lines without encoder counts: `MAX_LOST_S` for their
total duration, s, and `MAX_LOST` for their number. If the lines exceed both limits, the motion of
the robot during these lines is unknown. Otherwise, the robot is assumed to have moved at the speed
of the next plausible line."""

AT_REST = (0.0, 0.0, 0.0, 0.0)

ASSUMED_ACCELERATION = Twist(0.125, 0.5)
"""Standard deviation of the acceleration, m/s2 and rad/s2, until it is measured. It is an eighth of
the default acceleration limits. Random driving rarely exceeds it."""

ACCELERATION_SPAN_S = 0.2
"""Time over which the deviation from constant acceleration is measured, s."""

INITIAL_WEIGHT, MAX_WEIGHT = 4.0, 300.0
"""Weights in the mean of the squared deviations from constant acceleration. Each measured span of
`ACCELERATION_SPAN_S` s has the weight 1, and `ASSUMED_ACCELERATION` has the weight
`INITIAL_WEIGHT`. The total weight is limited to `MAX_WEIGHT` (a minute of driving)."""

MAX_COMMANDED_S = 1.0
"""Longest time for which a command is assumed to have moved the robot in a gap, s. Without
feedback, the daemon usually commands rest much earlier. If the board receives nothing, its watchdog
stops the motors."""

MIN_DECAY = 0.02
"""Fraction of its speed to which a wheel at rest is assumed to have slowed down after a command to
rest. An exponential decay never reaches zero."""

STEP_DECAY = 0.05
"""Fraction of the estimated quantization step that is forgotten with each line."""

VARIANCE_POWER = 5
"""Exponent: the variance of the motion in a gap grows with this power of the gap's duration."""


class Rolled(Struct, frozen=True, gc=False):
    """The angles that the wheels rolled since the last plausible feedback line from the board.

    All angles are in rad and in `WHEELS` order.
    """

    pieces: tuple[Motors, ...]
    """Angles that are computed from the speeds, rad. Each item is one arc of the path, and has at
    least one angle that is not zero. The items are in the order of time."""
    turned: Motors
    """Angles that are computed from encoder counts, rad. The odometry adds this motion to the pose
    before the motion in `pieces`."""
    seen: Motors
    """Angles that the wheels rolled in the last `seconds` s, rad. Angles that were computed from
    speeds have the rounding errors of these speeds."""
    seconds: float
    """Duration of the motion `seen`, s."""
    bridged: float
    """Part of `seconds` that no feedback line covers, s. The speeds in this part are assumed."""
    unknown: float
    """Time in addition to `seconds` in which the motion of the wheels is unknown, s."""
    known: float
    """Total duration of the motion in `pieces` and `turned`, s; 0 if a part of the motion is
    unknown."""
    missed: Motors = AT_REST
    """Angles that the wheels rolled in addition to `pieces` if the MCU did not receive the command
    to rest, rad. The wheels then moved on until the MCU's watchdog stopped the motors."""


class Rolling:
    """Computes the angles that the wheels rolled from one plausible feedback line to the next.

    A feedback line is a line from the board with the speeds of the wheels. It is plausible unless
    `sanity.py` or `Confirmation` rejects it. The motion during rejected lines, and in the gaps
    before these lines, is computed with the next plausible line.
    """

    def __init__(self, quiet: float = math.inf) -> None:
        """Start without implausible feedback lines.

        `quiet` is the time without feedback after which a running daemon commands rest, s.
        """
        self._quiet = quiet
        self.forget()

    def forget(self) -> None:
        """Forget the implausible feedback lines since the last plausible line.

        The next call of `take` does not include the motion during these lines.
        """
        self._lost = self._gap = self._bridged = self._counted = self._driven = 0.0
        """Durations, s.

        - `_lost`: the time that implausible feedback lines without encoder counts cover.
        - `_counted`: the time that implausible feedback lines with encoder counts cover.
        - `_bridged`: the total of the gaps before the lines without counts that can be filled.
        - `_gap`: the total of the gaps before the lines without counts that cannot be filled.
        - `_driven`: the part of `_bridged` before the motors were commanded to rest.
        """
        self._turned, self._skipped = AT_REST, 0

    @property
    def skipped(self) -> float:
        """Total time of the implausible feedback lines without encoder counts, s.

        Only the lines after the last plausible line count. The total includes the gaps before these
        lines.
        """
        return self._lost + self._gap + self._bridged

    def skip(self, line: Feedback) -> None:
        """Record an implausible feedback line, so that the next call of `take` includes its motion.

        If the line has encoder counts, the motion comes from these counts. Otherwise only the time
        that the line covers is recorded.
        """
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
        """Return the part of the gaps before `line` in which the daemon still commanded motion, s.

        A gap is a time without plausible feedback lines. Later in the gap, the daemon commands
        rest.
        """
        return self._bridged + line.driven if line.bridged else self._driven

    def take(self, line: Feedback, before: WheelSpeeds) -> Rolled:
        """Return the angles that the wheels rolled since the last plausible feedback line.

        The result includes the motion during the implausible lines since then.

        Args:
            line: the present feedback line, which is plausible.
            before: the wheel speeds in the last plausible feedback line, rad/s.
        """
        speeds, dt, bridged = line.speeds.as_tuple(), line.dt, line.bridged + self._bridged
        if not (self._skipped or bridged or line.gap or line.turned is not None):
            # Nearly every line takes this shortcut. The code below would give the same result.
            angles = times(speeds, dt)
            moved = angles if line.counted is None else line.counted
            arcs = () if moved == AT_REST else (moved,)
            return Rolled(arcs, AT_REST, angles, dt, 0.0, 0.0, dt)
        # For implausible lines without counts, assume the speed of this line, unless those lines
        # last too long.
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
    """Return the angles that the wheels rolled in a gap, rad.

    The daemon commanded rest `driven` s after the gap began. `before` and `after` are the wheel
    speeds before and after the gap, rad/s. `bridged` is the duration of the gap, s. The line with
    the speeds `after` covers the `own` s after the gap.
    """
    # A board that computes its speeds since its last reply reports the means over the whole time.
    # These means are large enough for the motion until the command to rest. A smaller speed is the
    # speed after the gap. A wheel that became faster until then has not slowed down yet.
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
    """Return the mean speed of a wheel whose speed decays exponentially from `old` to `new`."""
    ratio = new / old if old else 1.0
    if ratio >= 0.99:
        return new
    ratio = max(ratio, MIN_DECAY)
    return old * (1.0 - ratio) / -math.log(ratio)


def plus(a: Motors, b: Motors) -> Motors:
    """Return the sums of two sets of wheel angles, wheel by wheel."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def times(a: Motors, factor: float) -> Motors:
    """Return the angles or speeds of all wheels, multiplied by `factor`."""
    return a[0] * factor, a[1] * factor, a[2] * factor, a[3] * factor


class Confirmation:
    """Holds back a feedback line that follows a gap and reports a doubtful speed.

    After a gap, one damaged line would falsify the motion of the whole gap. Damage changes the
    speed of one wheel alone, while motion changes the speeds of both wheels of a side alike. Two
    lines agree if no wheel alone has changed its speed by more than a limit, which is smaller after
    a longer gap.

    A line with encoder counts is used immediately, and so is a line that covers the usual time
    between two lines. A line that covers more time is used immediately if it agrees with the last
    line that was used. Otherwise it is held, and the next line decides:

    - If the next line agrees with the held line, both are used, because one wheel really changed
      its speed alone.
    - If the next line agrees with the last line that was used, the held line is dropped.
    - If the next line agrees with neither, both are held, and the third line decides. A line is
      dropped if it differs from the other two much more than these differ from each other.

    The time of a dropped line counts as a gap.
    """

    def __init__(self, feedback: FeedbackConfig) -> None:
        self._acceleration = feedback.wheel_acceleration
        self._period = 0.0
        """Usual time between two feedback lines, s; 0 before the first line."""
        self.forget()

    def forget(self) -> None:
        """Forget the feedback lines that are held back."""
        self._held: list[Feedback] = []
        self._seconds = 0.0
        """Time that the held feedback lines and the gaps before these lines cover, s."""

    def confirm(
        self,
        line: Feedback,
        skipped: float,
        before: WheelSpeeds,
        believed: Callable[[Motors], Motors],
    ) -> tuple[list[Feedback], list[Feedback]]:
        """Return a pair: the feedback lines to use now, and the feedback lines to drop.

        The lines to use are in the order of time. If `line` is held back, both lists are empty.

        Args:
            line: The next plausible feedback line.
            skipped: The time that the implausible lines directly before `line` cover, s. The gaps
                before these lines are included.
            before: The wheel speeds in the last line that was used, rad/s.
            believed: The function that replaces the speeds of wheels that are known to be faulty.
        """
        period, pending, seconds = self._period, self._held, line.dt + line.gap + skipped
        # A long time counts as two periods, so that a single gap changes the mean only a little.
        # A board with a longer period still changes it in the long run.
        self._period += PERIOD_GAIN * (min(seconds, 2 * period) - period) if period else seconds
        if not pending and (seconds <= 2 * period or not period or line.turned is not None):
            return [line], []
        self._seconds = seconds = seconds + (self._seconds if pending else 0.0)
        # This change of one wheel's speed falsifies the motion of the whole time by as much as a
        # damaged line of the usual duration can.
        most = (self._acceleration * period + SPEED_MARGIN) * period / seconds
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
    """Return the largest speed change that one wheel of a side made without the other, rad/s.

    `a` and `b` are the wheel speeds in two lines, rad/s. `steps` contains the quantization step of
    each wheel, rad/s. The result leaves out the part of a change that one such step can explain.
    """
    changes, largest = tuple(map(sub, a, b)), 0.0
    # The wheels i and 3 - i in `WHEELS` order are those of one side.
    for own, other, step in zip(changes, reversed(changes), steps, strict=True):
        explained = step if step < math.inf else 0.0
        largest = max(largest, min(abs(own), abs(own - other)) - explained)
    return largest


class Gaps:
    """Estimates the variances of the motion in gaps of the feedback.

    Let s be the standard deviation of the acceleration, m/s2 or rad/s2. After t s without lines,
    the true motion deviates by s t^2 / 2 from the motion at the known speeds, so the variance of
    the motion is s^2 t^4 / 4. The robot may change its acceleration at any time. Therefore s^2
    itself grows with t, and the variance grows with t^5 (`VARIANCE_POWER`).

    `follow` measures s while lines arrive without gaps. The configured acceleration limits are not
    used, because robots seldom accelerate that much. The deviation is limited to the motion at the
    highest of three speeds: the speed before the gap, the speed after the gap, and the highest
    speed commanded in the gap. The commanded speed counts for at most `MAX_COMMANDED_S` of the gap.
    Therefore a robot that stood still before and after a gap, and had no command to move, is
    assumed not to have moved in the gap.
    """

    def __init__(self) -> None:
        self._along = (ASSUMED_ACCELERATION.linear * ACCELERATION_SPAN_S**2 / 2) ** 2
        self._turning = (ASSUMED_ACCELERATION.angular * ACCELERATION_SPAN_S**2 / 2) ** 2
        self._spans = INITIAL_WEIGHT
        self.interrupt(REST)

    def interrupt(self, twist: Twist) -> None:
        """Discard the unfinished measurement of the acceleration, and start a new one.

        `twist` is the present twist of the robot, with which the new measurement starts.
        """
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0
        self._bridged, self._given = 0.0, (0.0, 0.0)

    def follow(self, twist: Twist, dt: float) -> None:
        """Use a feedback line from the board to measure the acceleration of the robot.

        The line reports that the robot moved with `twist` in the last `dt` s. Call this only if no
        gap precedes the line.
        """
        linear, angular = twist.linear, twist.angular
        self._bridged, self._given = 0.0, (0.0, 0.0)
        self._seconds += dt
        self._distance += linear * dt
        self._turn += angular * dt
        span = self._seconds - dt  # the time between the first and the last line of the span
        if span < ACCELERATION_SPAN_S:
            return
        # Compare the motion in the span with the motion at the mean of the first and last speeds.
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
        """Return a pair: the variances of distance (m2) and turn (rad2) that a filled gap adds.

        If the gap directly follows another gap, both count as one longer gap. The result is then
        the increase of the variances since the earlier gap.

        Args:
            seconds: the duration of the gap, s.
            before: the twist before the gap.
            after: the twist after the gap.
            commanded: the highest speeds that were commanded in the gap, m/s and rad/s, both
                without sign.
        """
        bridged, previous = self._bridged + seconds, self._given
        along, yaw = self.unseen(bridged, before, after, commanded)
        self.interrupt(after)
        self._bridged, self._given = bridged, (max(along, previous[0]), max(yaw, previous[1]))
        return max(0.0, along - previous[0]), max(0.0, yaw - previous[1])

    def unseen(
        self, seconds: float, before: Twist, after: Twist, commanded: Twist = REST
    ) -> tuple[float, float]:
        """Return the variances of the distance (m2) and the turn (rad2) in a gap of `seconds` s.

        `before` and `after` are the twists before and after the gap. `commanded` contains the
        highest speeds that were commanded in the gap, m/s and rad/s, both without sign. The default
        is for callers that do not know the commands.
        """
        scale = (seconds / ACCELERATION_SPAN_S) ** VARIANCE_POWER
        driven = min(seconds, MAX_COMMANDED_S)
        fastest = max(abs(before.linear), abs(after.linear)) * seconds
        fastest = max(fastest, commanded.linear * driven)
        turning = max(abs(before.angular), abs(after.angular)) * seconds
        turning = max(turning, commanded.angular * driven)
        return min(self._along * scale, fastest**2), min(self._turning * scale, turning**2)


class Rounding:
    """Estimates how much reported speeds differ from the true speeds if the encoders are coarse.

    With few encoder counts, a line of a slow wheel contains one count or none, so its speed jumps
    from line to line. Let v0, v1 and v2 be the speeds of a wheel in three consecutive lines. With
    few counts, |v0 - 2 v1 + v2| / 2 is about one quantization step of the speed. With many counts
    it is near 0, unless the acceleration changes or a line is damaged.
    """

    def __init__(self) -> None:
        self._last: Motors | None = None
        """Speeds in the last line, rad/s; None before the first line."""
        self._older: Motors | None = None
        """Speeds in the line before the last line, rad/s; None if a gap lies between the two
        lines."""
        self._step = 0.0
        """Estimated quantization step, rad/s: the largest recent step, which loses the fraction
        `STEP_DECAY` with each later line."""
        self._before = self._after = 0.0
        """Quantization steps of the line before the last one, and of the last one, rad/s. While the
        wheels stand still, they become smaller from line to line."""

    def add(
        self, speeds: Motors, own: float, still: float, after_gap: bool, largest: float
    ) -> None:
        """Use the next line from the board.

        Args:
            speeds: the wheel speeds in the line, rad/s.
            own: the time that the line covers, s, without a gap before it; 0 if it is unknown.
            still: the time for which all wheels have reported zero speed, s, without gaps. In this
                time, each wheel turned by less than one count.
            after_gap: whether a gap precedes the line.
            largest: the largest quantization step that is possible, rad/s.
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

        `TwistUncertainty.rounding` converts this sum to variances of speeds, for wheels with
        independent errors. In a gap of t s, the speed before the gap is assumed for t / 2 s, and
        the speed after the gap for the other t / 2 s. Therefore the variances of the motion are t^2
        / 4 times the variances of the speeds. Each of two facts doubles this result, so the caller
        multiplies by t^2:

        - Both wheels of a side turn alike, so their errors are equal and not independent.
        - A single line can contain an encoder edge too many or too few.
        """
        return self._before**2 + self._after**2
