"""The content of a recording, collected step by step: the data to draw and to describe.

Mode, reasons, path, events and the driving source are taken from the recording. The wished, limited
and measured speeds come from a robot that replays the same inputs. The serial line is counted per
second, and so is the lateness of the control loop.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.robot import Robot
from acsard.core.thinning import Band, Curve, Place, Point, Track
from acsard.core.values import NS_PER_S, Outputs, Twist
from acsard.recording.recorded_steps import MICRO, Step
from acsard.recording.timeline import TimelineEntry, TimelineWriter
from acsard.report.command_sources import LOOK_S, MOST_TEXT, CommandSources

NS_PER_MS = 1_000_000


class Totals:
    """Totals of a part of a recording."""

    def __init__(self) -> None:
        self.sent = self.good = self.dropped = self.unanswered = 0


class Link:
    """Lines sent, answered, dropped and unanswered, for each second."""

    def __init__(self) -> None:
        self.sent, self.good, self.dropped, self.unanswered = Curve(), Curve(), Curve(), Curve()
        self.totals = Totals()
        self._second: int | None = None
        self._sent = self._base = 0
        self._heard = (0, 0)
        """Good and dropped lines since the daemon's start, at the beginning of this second."""
        self._now = (0, 0)
        """Good and dropped lines since the daemon's start, at the last step."""
        self._least: int | None = None
        """Smallest number of unanswered lines at any step of this second. The newest line may just
        be under way; the others are lost."""
        self._open: int | None = None
        """Maximum of `_least` over all earlier seconds."""

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """Process a step: its time in s, whether a line was sent, and the counters after it."""
        heard = self._now = _heard(counters)
        if self._second is None:
            self._second, self._heard, self._base = int(t), heard, sum(heard)
        elif int(t) != self._second:
            self._end(heard)
            self._second = int(t)
        if self._least is None or self._outstanding(heard) < self._least:
            self._least = self._outstanding(heard)
        self._sent += sent

    def _outstanding(self, heard: tuple[int, int]) -> int:
        return self.totals.sent + self._sent - (sum(heard) - self._base)

    def _end(self, heard: tuple[int, int]) -> None:
        """Close a second; seconds without a step may follow."""
        t, totals = float(self._second or 0) + 0.5, self.totals
        good, dropped = (now - then for now, then in zip(heard, self._heard, strict=True))
        least = self._least or 0
        most = least if self._open is None else max(least, self._open)
        lost = 0 if self._open is None else most - self._open
        for curve, count in (
            (self.sent, self._sent),
            (self.good, good),
            (self.dropped, dropped),
            (self.unanswered, lost),
        ):
            curve.add(t, count)
        totals.sent += self._sent
        totals.good += good
        totals.dropped += dropped
        totals.unanswered += lost
        self._sent, self._heard, self._open, self._least = 0, heard, most, None

    def end(self) -> None:
        if self._second is not None:
            self._end(self._now)


def _heard(counters: Mapping[str, int]) -> tuple[int, int]:
    """Return the number of good and of dropped lines. An implausible line was parsed, too."""
    bad = sum(count for name, count in counters.items() if name.startswith("line_"))
    return counters.get("lines", 0) - counters.get("line_implausible", 0), bad


class Lateness:
    """Lateness of each period's step in ms, relative to the earliest step.

    Missed periods are counted, so the number of each period is known. Its due time is then known
    except for a constant offset, which the least late step determines.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()
        self._number = 0
        self._ahead = 0
        self._began_ns: int | None = None
        self._earliest = math.inf
        self.missed = 0
        """Number of periods without a step."""
        self.most_missed = 0
        """Largest number of consecutive periods without a step."""

    def at_once(self) -> None:
        """Note that a line was sent at once, in place of the next period's line."""
        self._ahead += 1

    def tick(self, t: float, now_ns: int, missed: int, known: bool) -> None:
        """Process the step of a period, before which `missed` periods ended without a step.

        `known` is False if steps are missing from the recording; then the period is derived from
        the clock.
        """
        period_ns, began_ns = self._period_ns, self._began_ns
        if began_ns is None:
            began_ns = self._began_ns = now_ns
            missed = 0
        elif known:
            self._number += 1 + missed + self._ahead
        else:
            self._number, missed = round((now_ns - began_ns) / period_ns), 0
        behind_ns = now_ns - began_ns - self._number * period_ns
        if missed and self._ahead and behind_ns < self._earliest - period_ns / 2:
            self._number -= 1  # the line sent at once belonged to a missed period
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self.most_missed = max(self.most_missed, missed)
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """Return the lateness in ms over time in s."""
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most(self) -> float:
        """Largest lateness, ms."""
        return max([point.value for point in self.points()], default=0.0)


MODES = ("fault", "stopped", "shutdown", "waiting", "inactive", "driving", "ready")
"""Robot modes, in the order in which they win when short spans are merged."""

LINKS = ("down", "stale", "booting", "up")

FIRST, LAST = 30, 30
"""Number of first and of last events of one name that are kept."""


class Mark(Struct, frozen=True):
    """An event at time `t` (s), and the place of the robot by odometry."""

    t: float
    name: str
    text: str
    level: str
    by: str
    count: int
    place: Place | None


class Marks:
    """Events; of each name only the first and the last ones are kept."""

    def __init__(self) -> None:
        self._first: dict[str, list[Mark]] = {}
        self._last: dict[str, deque[Mark]] = {}
        self.counts: Counter[str] = Counter()
        """Number of events by name. A repeated event counts as often as it occurred."""
        self.left_out = 0

    def add(self, mark: Mark) -> None:
        """Add an event, and drop a middle one of the same name if there are too many."""
        self.counts[mark.name] += mark.count
        first = self._first.setdefault(mark.name, [])
        if len(first) < FIRST:
            first.append(mark)
            return
        last = self._last.setdefault(mark.name, deque(maxlen=LAST))
        self.left_out += len(last) == LAST
        last.append(mark)

    def all(self) -> list[Mark]:
        """Return the kept events in order of time."""
        rows = [mark for kept in (self._first, self._last) for row in kept.values() for mark in row]
        return sorted(rows, key=lambda mark: mark.t)


class Driven(Struct):
    """Time and distance that one source drove the robot."""

    seconds: float = 0.0
    metres: float = 0.0


class Course:
    """Collects the steps between the times `begin` and `end` (s since 1970)."""

    def __init__(
        self, config: Config, begin: float | None = None, end: float | None = None
    ) -> None:
        self._window = (-math.inf if begin is None else begin, math.inf if end is None else end)
        self.config = config
        """Configuration at the beginning."""
        self.path = Track()
        self.linear = {name: Curve() for name in ("wished", "limited", "measured")}
        self.angular = {name: Curve() for name in ("wished", "limited", "measured")}
        self.asked, self.turned = [Curve() for _ in range(4)], [Curve() for _ in range(4)]
        """Commanded and measured wheel speeds, rad/s, in `WHEELS` order."""
        self.modes, self.links = Band(MODES), Band(LINKS)
        self.sources = CommandSources(config.commands.sources)
        self.link = Link()
        self.lateness = Lateness(config.rate_hz)
        self.marks = Marks()
        self.began: float | None = None
        """Time of the first collected step in s since 1970; `t` is 0 there."""
        self.seconds = self.metres = 0.0
        self.driven: dict[str, Driven] = {}
        self.fastest = Twist()
        """Highest measured speed of each axis, as a magnitude."""
        self.steps = self.missing = 0
        self._story = TimelineWriter()
        self._mono_ns = self._wall_ns = 0
        self._wall = -math.inf
        """Wall-clock time of the last step, s since 1970."""
        self._number: int | None = None
        self._place: Place | None = None
        self._jumps = True
        self._looked = self._left = -math.inf
        self._status: tuple[str, ...] = ()

    @property
    def over(self) -> bool:
        """Whether the last step was after the end of the time window."""
        return self._wall > self._window[1]

    @property
    def at(self) -> float:
        """Wall-clock time of the last step, s since 1970."""
        return self._wall

    def step(self, step: Step, outputs: Outputs, robot: Robot) -> None:
        """Process a recorded step; `outputs` and `robot` are its replay."""
        now = step.inputs.now
        if self._number is None:
            self._mono_ns, self._wall_ns = now.mono_ns, now.wall_ns
        self._wall = wall = (self._wall_ns + now.mono_ns - self._mono_ns) / NS_PER_S
        counts = self._window[0] <= wall <= self._window[1]
        known = self._number is None or step.number == self._number + 1
        if counts and self.began is None:
            self.began = wall
        t = max(self.seconds, wall - (self.began or wall))
        self._drive(step, t, counts)
        refused = self.sources.hear(step, t, robot)
        told = list(self._story.step(step))
        if counts:
            if not known:
                self.missing += step.number - (self._number or 0) - 1
            self.steps += 1
            self._speeds(step, outputs, t)
            self._line(step, outputs, robot, t, known)
            self._look(step, t, robot, refused)
            for one in told:
                self.marks.add(self._mark(one, t))
            self.seconds = t
        self._number = step.number

    def end(self) -> None:
        t = self.seconds
        for band in (self.modes, self.links, *self.sources.bands.values()):
            band.end(t)
        self.link.end()

    def _mark(self, one: TimelineEntry, t: float) -> Mark:
        text, by = one.text[:MOST_TEXT], one.by[:MOST_TEXT]
        return Mark(t, one.name, text, one.level, by, one.count, self._place)

    # Distance and speeds.

    def _drive(self, step: Step, t: float, counts: bool) -> None:
        mode, _, _, source = step.recorded.status
        by = self._driven(source) if mode == "driving" and counts else None
        if by is not None and t > self.seconds:
            by.seconds += t - self.seconds
        for x, y, yaw in step.recorded.poses:
            place = Place(t, x / MICRO, y / MICRO, yaw / MICRO, self._jumps)
            if self._place is not None and not self._jumps and counts:
                way = math.hypot(place.x - self._place.x, place.y - self._place.y)
                self.metres += way
                if by is not None:
                    by.metres += way
            self._place, self._jumps = place, False
            if counts:
                self.path.add(place)
        # A request takes effect after the poses of its step.
        if any(request.verb in ("set_pose", "reset_odometry") for request in step.inputs.requests):
            self._jumps = True

    def _driven(self, source: str) -> Driven:
        return self.driven.setdefault(self.sources.name(source), Driven())

    def _speeds(self, step: Step, outputs: Outputs, t: float) -> None:
        wish = self.sources.wish(outputs)
        curves = ((self.linear, "linear"), (self.angular, "angular"))
        for curve, axis in curves:
            curve["wished"].add(t, None if wish is None else getattr(wish, axis))
            self._asked(curve["limited"], step, t, getattr(outputs.applied, axis))
        for wheel, speed in zip(self.asked, outputs.speeds.as_tuple(), strict=True):
            self._asked(wheel, step, t, speed)
        if step.recorded.sent is not None:
            self._left = t
        if step.recorded.status[2] != "up":
            for one in (self.linear["measured"], self.angular["measured"], *self.turned):
                one.add(t, None)
        for estimate in outputs.estimates:
            twist, most = estimate.twist, self.fastest
            self.linear["measured"].add(t, twist.linear)
            self.angular["measured"].add(t, twist.angular)
            for wheel, speed in zip(self.turned, estimate.speeds.as_tuple(), strict=True):
                wheel.add(t, speed)
            self.fastest = Twist(
                max(most.linear, abs(twist.linear)), max(most.angular, abs(twist.angular))
            )

    def _asked(self, curve: Curve, step: Step, t: float, speed: float) -> None:
        """Record a commanded speed.

        A sent line is valid until the microcontroller's watchdog expires.
        """
        if step.recorded.sent is not None:
            curve.add(t, speed)
        elif t - self._left > WATCHDOG_S:
            curve.add(t, None)

    # Serial line and modes.

    def _line(self, step: Step, outputs: Outputs, robot: Robot, t: float, known: bool) -> None:
        inputs, left = step.inputs, step.recorded.sent is not None
        session = robot.session
        rejected = {f"line_{reason}": count for reason, count in session.rejects.items()}
        impossible = {"line_implausible": robot.counters["line_implausible"]}
        self.link.step(t, left, {"lines": session.good_lines} | rejected | impossible)
        if inputs.tick:
            self.lateness.tick(t, inputs.now.mono_ns, inputs.missed, known)
        elif outputs.due and left:
            self.lateness.at_once()

    def _look(self, step: Step, t: float, robot: Robot, refused: bool) -> None:
        mode, reason, link, _ = status = step.recorded.status
        if status == self._status and t - self._looked < LOOK_S and not refused:
            return
        self._status, self._looked = status, t
        self.modes.add(t, mode[:MOST_TEXT], reason[:MOST_TEXT])
        self.links.add(t, link[:MOST_TEXT])
        self.sources.look(step, t, robot)
