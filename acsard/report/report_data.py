"""Collects the data of a report from a recording, step by step.

Modes, reasons, path, events and driving source come from the recording, and speeds from a replay.
Data are thinned as they arrive, so a day needs no more memory than a minute.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import nullcontext

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.robot import Robot
from acsard.core.thinning import Band, Curve, Place, Point, Track
from acsard.core.values import NS_PER_S, Ns, Outputs, Twist
from acsard.recording.recorded_steps import US_PER_S, RecordedStep
from acsard.recording.timeline import TimelineEntry, TimelineWriter
from acsard.report.command_sources import MAX_TEXT_LENGTH, SAMPLE_PERIOD_S, CommandSources
from acsard.report.robot_reader import RobotErrors, RobotReader

NS_PER_MS = 1_000_000

# Most important first, which wins a merge.
MODES = ("fault", "stopped", "shutdown", "waiting", "inactive", "driving", "ready")

LINKS = ("down", "stale", "booting", "up")  # most important first, which wins a merge

MAX_EVENT_TEXT = 1000  # characters; the daemon's longest text has 308

FIRST, LAST = 30, 30  # of each event name, kept


class Mark(Struct, frozen=True):
    """An event of a recording, and where the robot was."""

    t: float  # s of the report
    name: str
    text: str
    level: str
    by: str  # client, or sources of a drive
    count: int  # equal events in the log's line
    place: Place | None  # by odometry
    seconds: float  # since 1970, whatever the clock does later


class Marks:
    """The events of a recording: the first and the last ones with each name."""

    def __init__(self) -> None:
        self._first: dict[str, list[tuple[int, Mark]]] = {}
        # Marks by name; number in the order of all events.
        self._last: dict[str, deque[tuple[int, Mark]]] = {}
        self._count = 0  # added
        self.counts: Counter[str] = Counter()  # by name, with those that are not kept
        self.left_out = 0  # added, but not kept

    def add(self, mark: Mark) -> None:
        """Add an event; it displaces the oldest of the last ones of its name."""
        self.counts[mark.name] += mark.count
        self._count += 1
        row = (self._count, mark)
        first = self._first.setdefault(mark.name, [])
        if len(first) < FIRST:
            first.append(row)
            return
        last = self._last.setdefault(mark.name, deque(maxlen=LAST))
        self.left_out += len(last) == LAST
        last.append(row)

    def all(self) -> list[Mark]:
        """Return the kept events, in order."""
        rows = [
            row for groups in (self._first, self._last) for rows in groups.values() for row in rows
        ]
        return [mark for _, mark in sorted(rows, key=lambda row: row[0])]


class Driven(Struct):
    """The time and the distance for which one source drove the robot."""

    seconds: float = 0.0
    metres: float = 0.0


class StepLateness:
    """How late each control period's step was, relative to the promptest of the report."""

    # The recording contains the number of missed periods, so the number of each step's period is
    # known. The times at which the periods were due follow from these numbers, except for a
    # constant offset. The offset is chosen so that the smallest delay is 0.

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()  # ms, relative to the first step
        self._number = 0  # of the last period, from 0
        self._ahead = 0  # early lines since the last period's step
        self._began_ns: Ns | None = None  # first step of a period
        self._earliest = math.inf  # least delay, relative to the first step's, ns
        self.missed = 0  # periods without a step

    def at_once(self) -> None:
        """Process an early line, which replaces that of the next period."""
        self._ahead += 1

    def tick(self, t: float, now_ns: Ns, missed: int, known: bool) -> None:
        """Process a period's step; `known` is false after missing steps, which hide its number."""
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
            # The line that was sent for a fresh command replaced the line of the missed period.
            self._number -= 1
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """Return the delays, ms, over s of the report; the least is 0."""
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most_ms(self) -> float:
        return max([point.value for point in self.points()], default=0.0)


class LineCount:
    """The serial lines of one kind, in each second and in total."""

    def __init__(self) -> None:
        self.curve, self.total = Curve(), 0  # in each second, and their sum

    def add(self, t: float, count: int) -> None:
        """Add the lines of the second around `t`."""
        self.curve.add(t, count)
        self.total += count


class SerialCounts:
    """The sent, accepted, dropped and unanswered serial lines in each second."""

    def __init__(self) -> None:
        self.sent, self.good = LineCount(), LineCount()  # to the board; accepted from it
        # Unreadable or implausible; sent without an answer.
        self.dropped, self.unanswered = LineCount(), LineCount()
        self._second: int | None = None  # number of the present second
        self._sent = 0  # in the present second
        self._base = 0  # received at the first step
        self._before = (0, 0)  # accepted and dropped when the second began
        self._now = (0, 0)  # accepted and dropped at the last step
        # Least unanswered lines in the second; in other steps, the newest answer is still to come.
        self._outstanding: int | None = None
        self._lost: int | None = None  # largest `_outstanding` of the earlier seconds

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """Process a step; `lines` and `line_...` of the counters are readable and dropped lines."""
        received = self._now = _received(counters)
        if self._second is None:
            self._second, self._before, self._base = int(t), received, sum(received)
        elif int(t) != self._second:
            self._end(received)
            self._second = int(t)
        outstanding = self.sent.total + self._sent - (sum(received) - self._base)
        if self._outstanding is None or outstanding < self._outstanding:
            self._outstanding = outstanding
        self._sent += sent

    def _end(self, received: tuple[int, int]) -> None:
        # `received` is accepted and dropped.
        t = float(self._second or 0) + 0.5
        good, dropped = (now - then for now, then in zip(received, self._before, strict=True))
        outstanding = self._outstanding or 0
        lost = outstanding if self._lost is None else max(outstanding, self._lost)
        unanswered = 0 if self._lost is None else lost - self._lost
        self.sent.add(t, self._sent)
        self.good.add(t, good)
        self.dropped.add(t, dropped)
        self.unanswered.add(t, unanswered)
        self._sent, self._before, self._lost, self._outstanding = 0, received, lost, None

    def end(self) -> None:
        if self._second is not None:
            self._end(self._now)


def _received(counters: Mapping[str, int]) -> tuple[int, int]:
    # Implausible lines count as dropped.
    bad = sum(count for name, count in counters.items() if name.startswith("line_"))
    return counters.get("lines", 0) - counters.get("line_implausible", 0), bad


class ReportData:
    """Collects the data of a report: `step` for each step until `past_end`, then `end`."""

    def __init__(
        self,
        config: Config,
        begin: float = -math.inf,
        end: float = math.inf,
        robot_errors: RobotErrors = nullcontext,
    ) -> None:
        # `begin` and `end` are in s since 1970. Each use of the robot runs in `robot_errors`.
        self._window = (begin, end)
        self.config = config  # at the beginning
        self.path = Track()
        self.linear = {name: Curve() for name in ("commanded", "limited", "measured")}  # m/s
        self.angular = {name: Curve() for name in ("commanded", "limited", "measured")}  # rad/s
        # rad/s, by `WHEELS`.
        self.commanded_wheels, self.measured_wheels = (
            [Curve() for _ in range(4)],
            [Curve() for _ in range(4)],
        )
        self.modes, self.links = Band(MODES), Band(LINKS)
        self._reader = RobotReader(robot_errors)
        self.sources = CommandSources(config.commands.sources, self._reader)
        self.serial = SerialCounts()
        self.lateness = StepLateness(config.rate_hz)
        self.marks = Marks()
        self.began: float | None = None  # since 1970; times `t` of the report are since then
        self.ended = 0.0  # since 1970
        self.seconds = self.metres = 0.0  # of the report
        self.driven: dict[str, Driven] = {}  # by source
        self.fastest = Twist()  # largest measured speeds, without sign
        self.steps = self.missing = 0  # in the report, and missing between
        self._timeline = TimelineWriter(config)
        self._mono_ns = self._wall_ns = 0  # first step of the recording
        self._wall = -math.inf  # last step, since 1970, by the monotonic clock since the first
        self._number: int | None = None  # of the last step
        self._place: Place | None = None  # last pose
        self._jumps = True  # the next pose does not continue the path: it is the first, or was set
        # Since `began`: last sample of the status, last sent line.
        self._sampled = self._sent = -math.inf
        self._status: tuple[str, ...] = ()  # at the last sample

    @property
    def past_end(self) -> bool:
        """Whether the last step was after the end of the report."""
        return self._wall > self._window[1]

    def step(self, step: RecordedStep, outputs: Outputs, robot: Robot) -> None:
        """Add a step; one outside of the report changes only what later steps need."""
        now = step.inputs.now
        if self._number is None:
            self._mono_ns, self._wall_ns = now.mono_ns, now.wall_ns
        self._wall = wall = (self._wall_ns + now.mono_ns - self._mono_ns) / NS_PER_S
        inside = self._window[0] <= wall <= self._window[1]
        known = self._number is None or step.number == self._number + 1
        if inside and self.began is None:
            self.began = wall
        t = max(self.seconds, wall - (self.began or wall))
        self._drive(step, t, inside)
        refused = self.sources.take_commands(step, t, robot)
        entries = list(self._timeline.step(step))
        if inside:
            if not known:
                self.missing += step.number - (self._number or 0) - 1
            self.steps += 1
            self._reader.check(outputs)
            self._speeds(step, outputs, t)
            self._serial(step, outputs, robot, t, known)
            self._sample(step, t, robot, refused)
            for entry in entries:
                self.marks.add(self._mark(entry, t))
            self.seconds, self.ended = t, now.wall_ns / NS_PER_S
        self._number = step.number

    def end(self, ending: str = "") -> None:
        """Finish the data; `ending` says how the recording was cut off in the report."""
        t = self.seconds
        for entry in self._timeline.end(ending) if self.began is not None else ():
            self.marks.add(self._mark(entry, t))
        for band in (self.modes, self.links, *self.sources.bands.values()):
            band.end(t)
        self.serial.end()

    def _mark(self, entry: TimelineEntry, t: float) -> Mark:
        text, by = entry.text[:MAX_EVENT_TEXT], entry.by[:MAX_EVENT_TEXT]
        return Mark(t, entry.name, text, entry.level, by, entry.count, self._place, entry.seconds)

    # Distance and speeds.

    def _drive(self, step: RecordedStep, t: float, inside: bool) -> None:
        # `inside` the report.
        mode, _, _, source, _ = step.recorded.status
        driven = self._driven(source) if mode == "driving" and inside else None
        if driven is not None and t > self.seconds:
            driven.seconds += t - self.seconds
        for x, y, yaw in step.recorded.poses:
            place = Place(t, x / US_PER_S, y / US_PER_S, yaw / US_PER_S, self._jumps)
            if self._place is not None and not self._jumps and inside:
                metres = math.hypot(place.x - self._place.x, place.y - self._place.y)
                self.metres += metres
                if driven is not None:
                    driven.metres += metres
            self._place, self._jumps = place, False
            if inside:
                self.path.add(place)
        self._jumps = self._jumps or step.places

    def _driven(self, source: str) -> Driven:
        return self.driven.setdefault(self.sources.name(source), Driven())

    def _speeds(self, step: RecordedStep, outputs: Outputs, t: float) -> None:
        commanded = self.sources.commanded(outputs)
        for curves, axis in ((self.linear, "linear"), (self.angular, "angular")):
            curves["commanded"].add(t, None if commanded is None else getattr(commanded, axis))
            self._add_sent(curves["limited"], step, t, getattr(outputs.applied, axis))
        for wheel, speed in zip(self.commanded_wheels, outputs.speeds.as_tuple(), strict=True):
            self._add_sent(wheel, step, t, speed)
        if step.recorded.sent is not None:
            self._sent = t
        if step.recorded.status[2] != "up":
            for curve in (self.linear["measured"], self.angular["measured"], *self.measured_wheels):
                curve.add(t, None)
        for estimate in outputs.estimates:
            twist, most = estimate.twist, self.fastest
            self.linear["measured"].add(t, twist.linear)
            self.angular["measured"].add(t, twist.angular)
            for wheel, speed in zip(self.measured_wheels, estimate.speeds.as_tuple(), strict=True):
                wheel.add(t, speed)
            self.fastest = Twist(
                max(most.linear, abs(twist.linear)), max(most.angular, abs(twist.angular))
            )

    def _add_sent(self, curve: Curve, step: RecordedStep, t: float, speed: float) -> None:
        if step.recorded.sent is not None:
            curve.add(t, speed)
        elif t - self._sent > WATCHDOG_S:
            # The watchdog of the microcontroller stops the robot, so the curve has a gap.
            curve.add(t, None)

    # Serial port, control loop and modes.

    def _serial(
        self, step: RecordedStep, outputs: Outputs, robot: Robot, t: float, known: bool
    ) -> None:
        inputs, sent = step.inputs, step.recorded.sent is not None
        self.serial.step(t, sent, self._reader.lines(robot))
        if inputs.tick:
            self.lateness.tick(t, inputs.now.mono_ns, inputs.missed, known)
        elif outputs.due and sent:
            self.lateness.at_once()

    def _sample(self, step: RecordedStep, t: float, robot: Robot, refused: bool) -> None:
        mode, reason, link, _, _ = status = step.recorded.status
        if status == self._status and t - self._sampled < SAMPLE_PERIOD_S and not refused:
            return
        self._status, self._sampled = status, t
        self.modes.add(t, mode[:MAX_TEXT_LENGTH], reason[:MAX_TEXT_LENGTH])
        self.links.add(t, link[:MAX_TEXT_LENGTH])
        self.sources.sample(step, t, robot)
