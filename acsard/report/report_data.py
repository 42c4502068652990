"""Collects the data of a report from a recording, step by step.

The mode, the reasons, the path, the events and the driving source come from the recording. The
commanded, limited and measured speeds come from a replay of the recorded inputs. The data are
thinned while they arrive, so the data of a day need no more memory than the data of a minute.
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
from acsard.core.ros.shapes import how_often
from acsard.core.thinning import Band, Curve, Place, Point, Track
from acsard.core.values import NS_PER_S, Outputs, Twist
from acsard.recording.recorded_steps import US_PER_S, RecordedStep
from acsard.recording.timeline import TimelineEntry, TimelineWriter
from acsard.report.command_sources import MAX_TEXT_LENGTH, SAMPLE_PERIOD_S, CommandSources
from acsard.report.robot_reader import RobotErrors, RobotReader

NS_PER_MS = 1_000_000

MODES = ("fault", "stopped", "shutdown", "waiting", "inactive", "driving", "ready")
"""Modes of the robot, the most important mode first.

If spans of time with different modes are merged, the result has the most important mode.
"""

LINKS = ("down", "stale", "booting", "up")
"""States of the link to the board, the most important state first.

If spans of time with different states are merged, the result has the most important state.
"""

MAX_EVENT_TEXT = 1000
"""Maximum length of the text of an event, characters. The rest is cut off.

The daemon's longest text has 308 characters.
"""

FIRST, LAST = 30, 30
"""Numbers of events that are kept for each event name: the first `FIRST` events, and the last
`LAST` events."""


class Mark(Struct, frozen=True):
    """An event of a recording, with the position of the robot at that time."""

    t: float
    """Time since the first step of the report, s."""
    name: str
    text: str
    level: str
    by: str
    """The client that caused the event, or the sources that commanded a drive; "" if unknown."""
    count: int
    """Number of equal events that the log combined into this event."""
    place: Place | None
    """Pose of the robot according to odometry; None before the first pose."""
    seconds: float
    """Wall-clock time of the event, s since 1970. Later changes of the clock do not change it."""

    @property
    def text_with_count(self) -> str:
        """The text of the event, and the number of equal events that the log combined, if any."""
        return f"{self.text}{how_often(self.text, self.count)}"


class Marks:
    """The events of a recording. Only the first and the last events with each name are kept."""

    def __init__(self) -> None:
        self._first: dict[str, list[tuple[int, Mark]]] = {}
        self._last: dict[str, deque[tuple[int, Mark]]] = {}
        """`_first` maps each event name to the first events with this name, and `_last` maps it to
        the last events. An event is a pair: its number in the order of all events, and its mark."""
        self._count = 0
        """Number of marks that were added."""
        self.counts: Counter[str] = Counter()
        """Maps each event name to the number of events with this name. Events that are not kept
        count too. If the log combined several equal events, each of them counts."""
        self.left_out = 0
        """Number of marks that were added, but are not kept."""

    def add(self, mark: Mark) -> None:
        """Add an event.

        If `FIRST` + `LAST` events with this name are already kept, drop the oldest of the last
        `LAST` events.
        """
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
        """Return all events that are kept, in order."""
        rows = [
            row for groups in (self._first, self._last) for rows in groups.values() for row in rows
        ]
        return [mark for _, mark in sorted(rows, key=lambda row: row[0])]


class Driven(Struct):
    """The total time for which one source drove the robot, and the total distance."""

    seconds: float = 0.0
    metres: float = 0.0


class StepLateness:
    """Computes how late the daemon ran the step of each control period.

    The delays are relative: the smallest delay in the report counts as 0.
    """

    # The recording contains the number of missed periods, so the number of each step's period is
    # known. The times at which the periods were due follow from these numbers, except for a
    # constant offset. The offset is chosen so that the smallest delay is 0.

    def __init__(self, rate_hz: float) -> None:
        """Prepare for the first step. `rate_hz` is the number of control periods in a second."""
        self._period_ns = int(NS_PER_S / rate_hz)
        self._curve = Curve()
        """Delay of each period, relative to the delay of the first step, ms."""
        self._number = 0
        """Number of the last period. The period of the first step has the number 0."""
        self._ahead = 0
        """Number of early lines (`at_once`) since the last step of a control period."""
        self._began_ns: int | None = None
        """Monotonic time of the first step of a control period, ns; None before this step."""
        self._earliest = math.inf
        """Smallest delay of a step so far, relative to the delay of the first step, ns."""
        self.missed = 0
        """Number of control periods without a step."""

    def at_once(self) -> None:
        """Process an early line, which the daemon sent between two control periods.

        Such a line, for example for a fresh command, replaces the line of the next control period.
        """
        self._ahead += 1

    def tick(self, t: float, now_ns: int, missed: int, known: bool) -> None:
        """Process the step of a control period.

        Args:
            t: the time of the step, s since the first step of the report.
            now_ns: the monotonic time of the step, ns.
            missed: the number of control periods without a step since the last call.
            known: false if the recording lacks the steps just before this step. The number of the
                period is then computed from `now_ns`.
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
            # The line that was sent for a fresh command replaced the line of the missed period.
            self._number -= 1
            behind_ns += period_ns
        self._ahead = 0
        self.missed += missed
        self._earliest = min(self._earliest, behind_ns)
        self._curve.add(t, (behind_ns + missed * period_ns) / NS_PER_MS)

    def points(self) -> list[Point]:
        """Return the curve of the delays, ms, over the time since the first step of the report, s.

        The smallest delay is 0.
        """
        least = self._earliest / NS_PER_MS
        return [Point(t, value - least) for t, value in self._curve.points()]

    @property
    def most_ms(self) -> float:
        """Largest delay of a control period, ms."""
        return max([point.value for point in self.points()], default=0.0)


class LineCount:
    """Number of serial lines of one kind, in each second and in total."""

    def __init__(self) -> None:
        self.curve, self.total = Curve(), 0
        """`curve` contains the number of lines in each second. `total` is the sum of them."""

    def add(self, t: float, count: int) -> None:
        """Add `count`, the number of lines in one second.

        `t` is the middle of this second, s since the first step of the report.
        """
        self.curve.add(t, count)
        self.total += count


class SerialCounts:
    """Number of sent, accepted, dropped and unanswered serial lines in each second."""

    def __init__(self) -> None:
        self.sent, self.good = LineCount(), LineCount()
        """`sent` counts the lines that the daemon sent to the board. `good` counts the lines from
        the board that the daemon accepted."""
        self.dropped, self.unanswered = LineCount(), LineCount()
        """`dropped` counts the lines from the board that were unreadable or implausible.
        `unanswered` counts the sent lines that the board did not answer."""
        self._second: int | None = None
        """Number of the present second of the report; None before the first step."""
        self._sent = 0
        """Number of lines that the daemon has sent in the present second."""
        self._base = 0
        """Number of lines that the daemon had received at the first step of the report."""
        self._before = (0, 0)
        """Pair: the numbers of accepted and of dropped lines when the present second began, counted
        from the daemon's start."""
        self._now = (0, 0)
        """Pair: the numbers of accepted and of dropped lines at the last step, counted from the
        daemon's start."""
        self._outstanding: int | None = None
        """Smallest number of unanswered lines in the present second; None before its first step.

        In other steps of the second, the number is larger, because the answer to the newest line
        has not arrived yet.
        """
        self._lost: int | None = None
        """Number of answers that were lost before the present second.

        It is the largest value of `_outstanding` in the earlier seconds.
        """

    def step(self, t: float, sent: bool, counters: Mapping[str, int]) -> None:
        """Process a step.

        Args:
            t: the time of the step, s since the first step of the report.
            sent: true if the daemon sent a line in this step.
            counters: the robot's counters after the step. `lines` counts the readable lines from
                the board, and each `line_...` counts the lines that were dropped for one reason.
        """
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
        """Add the counts of the second that has just ended to the curves and totals.

        `received` is a pair: the numbers of accepted and of dropped lines since the daemon's start.
        """
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
    """Return the numbers of accepted and dropped lines. Implausible lines count as dropped."""
    bad = sum(count for name, count in counters.items() if name.startswith("line_"))
    return counters.get("lines", 0) - counters.get("line_implausible", 0), bad


class ReportData:
    """Collects the data of a report from the steps of a recording in a range of time.

    Call `step` for each step of the recording in order, until `past_end` is true. Then call `end`.
    """

    def __init__(
        self,
        config: Config,
        begin: float = -math.inf,
        end: float = math.inf,
        robot_errors: RobotErrors = nullcontext,
    ) -> None:
        """Prepare for the first step.

        Args:
            config: the configuration at the beginning of the recording.
            begin: wall-clock time at which the report begins, s since 1970; -inf for no limit.
            end: wall-clock time at which the report ends, s since 1970; inf for no limit.
            robot_errors: function that returns a context manager, in which each use of the replayed
                robot runs (see `RobotErrors`).
        """
        self._window = (begin, end)
        self.config = config
        """Configuration at the beginning of the recording."""
        self.path = Track()
        self.linear = {name: Curve() for name in ("commanded", "limited", "measured")}
        """The commanded, limited and measured forward speed, m/s."""
        self.angular = {name: Curve() for name in ("commanded", "limited", "measured")}
        """The commanded, limited and measured turn rate, rad/s."""
        self.commanded_wheels, self.measured_wheels = (
            [Curve() for _ in range(4)],
            [Curve() for _ in range(4)],
        )
        """Commanded speeds and measured speeds of the wheels, rad/s, in the order of `WHEELS`."""
        self.modes, self.links = Band(MODES), Band(LINKS)
        self._reader = RobotReader(robot_errors)
        self.sources = CommandSources(config.commands.sources, self._reader)
        self.serial = SerialCounts()
        self.lateness = StepLateness(config.rate_hz)
        self.marks = Marks()
        self.began: float | None = None
        """Wall-clock time of the first step of the report, s since 1970; None before this step.

        All times `t` of the report are in s since this time.
        """
        self.ended = 0.0
        """Wall-clock time of the last step of the report, s since 1970."""
        self.seconds = self.metres = 0.0
        """Duration of the report, s, and distance that the robot drove in this time, m."""
        self.driven: dict[str, Driven] = {}
        """Maps the name of each source to the total time and distance of its drives."""
        self.fastest = Twist()
        """Maximum absolute values of the measured forward speed, m/s, and of the measured turn
        rate, rad/s."""
        self.steps = self.missing = 0
        """Number of steps in the report, and number of steps that are missing between them."""
        self._timeline = TimelineWriter(config)
        self._mono_ns = self._wall_ns = 0
        """Monotonic and wall-clock time of the first step of the recording, ns."""
        self._wall = -math.inf
        """Time of the last step, s since 1970, without changes of the wall clock.

        It is the wall-clock time of the first step of the recording, plus the monotonic time since
        this step.
        """
        self._number: int | None = None
        """Number of the last step; None before the first step."""
        self._place: Place | None = None
        """The last pose; None before the first pose."""
        self._jumps = True
        """True if the next pose does not continue the path: it is the first pose, or a request has
        set the pose."""
        self._sampled = self._sent = -math.inf
        """Times of the last sample of the status and of the last sent line, s since `began`."""
        self._status: tuple[str, ...] = ()
        """Status of the robot at the last sample."""

    @property
    def past_end(self) -> bool:
        """True if the last step was after the end of the report."""
        return self._wall > self._window[1]

    def step(self, step: RecordedStep, outputs: Outputs, robot: Robot) -> None:
        """Add a step of the recording.

        A step outside of the report's range of time adds no data to the report. It changes only the
        state that later steps need, such as the last pose.

        Args:
            step: the recorded step.
            outputs: the replayed outputs of the step.
            robot: the robot, which has just replayed the step.
        """
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
        """Finish the data. Call this method after the last step.

        `ending` says how the recording was cut off. It is "" if the daemon ended normally, or if
        the report ends before the recording.
        """
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
        """Process the poses of a step. `inside` is true if the report covers this step."""
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
