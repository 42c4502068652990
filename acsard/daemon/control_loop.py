"""Runs a wake-up: hear, drive, guard, port, sent, recorder, bus, in this order.

The robot makes all decisions about the motion, and the guard checks each line. The loop is
synchronous, so that the daemon can call `step` from one task, and the tests in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable

from acsard.core.config.wire_time import wire_ns
from acsard.core.guard import Guard
from acsard.core.link.serial_output import Port
from acsard.core.motion.latches import stopped
from acsard.core.robot import QUIET, Robot
from acsard.core.values import (
    NS_PER_S,
    STILL,
    Event,
    Heard,
    Instant,
    Latches,
    News,
    Ns,
    Trip,
)
from acsard.daemon.latch_file import Keeper
from acsard.daemon.pacing import NO_PERIOD, Pace, Period
from acsard.daemon.publication import Publication
from acsard.recording.recorded_steps import StepRecorder

# Least delay of a line; less is reported as 0, as the estimated sample times are less exact.
MIN_WRITE_DELAY_NS = 1_000_000

# Between two looks at the latch file and the health of the bus, too slow for each period.
LOOK_NS = NS_PER_S // 10

# The line on the port, why the guard replaced the robot's, and how late it was written.
Written = tuple[bytes | None, Trip, Ns]

NOTHING_WRITTEN: Written = None, "", 0


# The result of a wake-up: its time, what the robot makes of it, whether a line was due (the period
# has ended, or `News.urgent`), and the line that the robot decided to send.
Step = tuple[Instant, News, bool, bytes | None]


class ControlLoop:
    """The control loop of one robot. It connects the robot to the serial port and to the bus."""

    def __init__(
        self,
        robot: Robot,
        port: Port,
        publication: Publication,
        keeper: Keeper,
        start: Instant,
        mono_ns: Callable[[], Ns],
        recorder: StepRecorder | None = None,
    ) -> None:
        self.robot, self.publication = robot, publication
        self.shutting_down = False  # the robot ramps to zero and stays at rest
        self._port, self._keeper, self._recorder = port, keeper, recorder
        self._guard, self._config = Guard(robot.link_setup.codec.stop, robot.config), robot.config
        # Use the longest line of both directions, because answers must not queue in the MCU either.
        mcu = robot.config.mcu
        self.pace = Pace(wire_ns(mcu.line_bytes, mcu.baud_rate), robot.config.period_ns)
        self._start_ns, self._mono_ns = start.mono_ns, mono_ns
        self._look_ns = start.mono_ns
        self._changed = False  # another speed or mode is in no written line yet
        if recorder is not None and robot.latches != Latches():
            # Without this record, a replay would start with a robot that has no latches.
            recorder.begins(robot, self._guard)

    @property
    def at_rest(self) -> bool:
        """Whether the last line commanded zero, as every line for a closed port does."""
        return self.robot.speeds == STILL

    def totals(self, now_ns: Ns) -> dict[str, float]:
        """Return the fields of the event `ended`: run time in s, distance in m, counters."""
        seconds, metres = (now_ns - self._start_ns) / NS_PER_S, self.robot.travelled
        return {
            "seconds": round(seconds, 1),
            "metres": round(metres, 2),
            **self.publication.counters(),
        }

    def step(self, now: Instant, period: Period = NO_PERIOD) -> Step:
        """Run one wake-up. `period` says how many periods have ended."""
        robot, publication, pace = self.robot, self.publication, self.pace
        port, keeper, recorder = self._port, self._keeper, self._recorder
        heard: Heard | None = None
        tick, line, written = False, None, NOTHING_WRITTEN
        publication.now = now
        try:
            heard = self._heard(now, period)
            if period is not NO_PERIOD:
                tick = pace.period_ended(heard.missed)
            news = robot.hear(now, heard)
            due = tick
            self._changed = self._changed or news.urgent
            if news is not QUIET:
                if heard.requests:
                    port.release(robot.port_released)
                if robot.latches is not keeper.latches:
                    keeper.keep(robot.latches)
                due = tick or (news.urgent and pace.at_once(now.mono_ns, port.sent_ns))
            if due:
                line = robot.drive(now)
                if line is not None:
                    written = self._write(line, now)
        except Exception:
            # Store the stops that this wake-up has taken from the bus. The exception may have come
            # before the robot processed them.
            self._keep_stops(robot.latches, publication.intake.taken_stops(), now)
            if recorder is not None and heard is not None:
                recorder.died(now, heard)
            raise
        had_input = bool(heard.commands or heard.refusals or heard.requests)
        if had_input or news.urgent or period is not NO_PERIOD or pace.waiting:
            pace.record_step(
                tick, due, written[0] is not None, news.urgent, had_input, port.sent_ns
            )
        if recorder is not None:
            step = now, heard, due, line, *written, news, robot.status
            recorder.step(step, robot, self._guard)
        publication.stopwatch.step_time(self._mono_ns() - now.mono_ns)
        # Publish last, because the threads that send need this core and Python's interpreter lock,
        # which are free only while this loop waits.
        if due or news is not QUIET:
            publication.publish(news, robot.applied if due else None)
        publication.bus.output.flush()
        return now, news, due, line

    def _heard(self, now: Instant, period: Period) -> Heard:
        port, publication, missed = self._port, self.publication, 0
        intake = publication.intake
        if period is not NO_PERIOD:
            missed = period.expired - 1
            publication.stopwatch.period(now.mono_ns, now.mono_ns - period.due_ns, missed)
            if now.mono_ns >= self._look_ns:
                self._look_ns = now.mono_ns + LOOK_NS
                intake.events += self._keeper.take_events()
                intake.look()
        # Call `take` before reading `is_open`: in a late wake-up it may find the port lost.
        taken, received = intake.take(publication.serve), port.take(now if missed else None)
        events: tuple[Event, ...] = ()
        if intake.events:
            events = tuple(intake.events)
            intake.events.clear()
        # Pass the fields by position: creating a struct by its names takes three times as long.
        return Heard(
            port.is_open,
            port.opened,
            port.trouble,
            received,
            *taken[:-1],
            events,
            missed,
            self.shutting_down,
            taken.announced,
        )

    def _write(self, line: bytes, now: Instant) -> Written:
        # The guard may replace the line, and the port may drop it.
        robot, port, guard = self.robot, self._port, self._guard
        status, command_ns = robot.status, robot.command_ns
        if robot.config is not self._config:
            self._config = robot.config
            guard.use(robot.config)
        line, trip = guard.check(line, now.mono_ns, status, command_ns)
        before_ns = port.sent_ns
        if port.offer(line, now) != "sent":
            robot.sent(now.mono_ns, None, trip)
            return None, trip, 0
        guard.record_written(line)
        changed, self._changed = self._changed, False
        if status.mode == "driving":
            self.publication.stopwatch.line(command_ns, port.sent_ns, before_ns, changed)
        late_ns = port.sent_ns - now.mono_ns
        late_ns = late_ns if late_ns >= MIN_WRITE_DELAY_NS else 0
        robot.sent(now.mono_ns + late_ns, line, trip)
        return line, trip, late_ns

    def finish(self, now: Instant) -> None:
        """Store the stops that arrived after the last wake-up, and send the waiting answers."""
        self.keep_last_stops(now)
        self._keeper.wait()
        self.publication.now = now
        self.publication.answer(last=True)
        self.publication.bus.output.flush()

    def keep_last_stops(self, now: Instant) -> None:
        """Store the stops that arrived after the last wake-up, which none will process."""
        self._keep_stops(self._keeper.latches, self.publication.intake.last_stops(), now)

    def _keep_stops(self, latches: Latches, by: list[str], now: Instant) -> None:
        # Of each client one; their new numbers keep a `clear` of earlier stops from releasing them.
        for name in by:
            latches = stopped(latches, name, now.wall_ns)
        if latches is not self._keeper.latches:
            self._keeper.keep(latches)
