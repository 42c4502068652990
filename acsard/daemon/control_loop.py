"""Collects the inputs of a control step, calls `Robot.step`, and delivers the outputs of the step.

All decisions about the motion are made in `Robot.step`, not in the control loop. The control loop
is synchronous, so that the daemon can call `ControlLoop.step` from one task and the tests can call
it in virtual time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from msgspec.structs import replace

from acsard.core.config.live import differences
from acsard.core.config.settings import Config
from acsard.core.config.wire_time import wire_ns
from acsard.core.formatting import listed
from acsard.core.guard import Guard, Trip
from acsard.core.incoming.bus_interface import GATEWAY_KEY as GATEWAY
from acsard.core.incoming.bus_interface import (
    NO_INPUT,
    Bus,
    BusInput,
    GatewayFollower,
    RouterFollower,
)
from acsard.core.incoming.commands import Receiver, caller_name, claimed_identity, parts
from acsard.core.incoming.imu import GyroFollower
from acsard.core.incoming.queries import Queries, Query, refused
from acsard.core.incoming.speed_limit import decode_limit
from acsard.core.link.serial_output import Port
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import IMU, SPEED_LIMIT
from acsard.core.messages.report import Report
from acsard.core.messages.schema import Info, Message
from acsard.core.motion.kinematics import Kinematics
from acsard.core.robot import Robot
from acsard.core.values import (
    NS_PER_S,
    Answer,
    Command,
    Event,
    GyroSample,
    Inputs,
    Instant,
    Latches,
    Outputs,
    Recording,
    Refusal,
    Request,
    Snapshot,
    SpeedCap,
)
from acsard.daemon.latch_rules import MAX_ANSWER_DELAY_NS, Handover, LatchKeeper
from acsard.daemon.latencies import Stopwatch
from acsard.daemon.pacing import NO_PERIOD, Pace, Period
from acsard.recording.recorded_steps import StepRecorder, count_superseded

FEEDBACK_TOPICS = ("odom", "tf", "wheel_states")
"""Topics whose messages are made from the feedback lines of the board."""

QUERIES_PER_STEP = 8
"""Largest number of queries that one control step takes from the bus. In addition, a step may take
one slow query: a `set` request or a query for ROS parameters. Further queries wait for the next
step, so that a flood of queries does not make the control loop miss a period."""

MIN_WRITE_DELAY_NS = 1_000_000
"""Smallest write delay that the control loop reports to the robot, ns. The write delay is the time
from the start of a step to the write of its line. A smaller delay is reported as 0, because the
error of the estimated sample times is larger."""

MAX_NAMED = 3
"""Largest number of settings that `settings_differ` of the message `state` names."""

NOT_STORED = (
    "the new state is not on the disk yet; if the daemon restarts before the disk has this state, "
    "it may lose a stop"
)
"""Text that the daemon adds to the answer to a successful request if a slow disk has not stored the
newest latches yet."""

BUS_STUCK = Event(
    "bus_stuck",
    "the Zenoh bus accepts no messages from the daemon; the daemon goes on driving the robot",
    "warning",
)


class ControlLoop:
    """The control loop of one robot. It connects the robot to the serial port and to the bus."""

    def __init__(
        self,
        config: Config,
        info: Info,
        port: Port,
        bus: Bus,
        start: Instant,
        log: Callable[[Event], None],
        mono_ns: Callable[[], int],
        certificate_ends: Mapping[str, int] | None = None,
        others: list[Event] | None = None,
        beside: Callable[[str], Message | None] | None = None,
        adopted: Callable[[Config], None] | None = None,
        recorder: StepRecorder | None = None,
        latches: Latches = Latches(),  # noqa: B008
        keeper: LatchKeeper | None = None,
    ) -> None:
        """Create the robot and the parts that convert its inputs and outputs.

        Args:
            config: the configuration at the start of the daemon.
            info: the answer to queries of the key `info`.
            port: the serial port to the board.
            bus: the robot's keys on the Zenoh bus.
            start: the time at which the daemon started.
            log: function that writes an event to the log.
            mono_ns: function that returns the monotonic time, ns.
            certificate_ends: maps the name of each TLS certificate to the time at which the
                certificate expires, ns since 1970. None or empty without TLS.
            others: list to which other parts of the daemon append events. Each step passes these
                events to the robot and empties the list.
            beside: function that returns the newest message of a key that another part of the
                daemon, such as the simulator, publishes. It returns None for any other key.
            adopted: function that is called with each new configuration that comes into force after
                the start.
            recorder: the black box, which records each step. With None, nothing is recorded.
            latches: the latches (stop, fault, "inactive") with which the robot starts.
            keeper: stores the latches, so that they survive a restart of the daemon. With None, the
                latches are not stored.
        """
        self.robot = Robot(config, latches)
        self.report = Report(config, start, certificate_ends)
        self.shutting_down = False
        """True once the shutdown has begun. The robot then ramps to zero and stays at rest."""
        self.outputs: Outputs | None = None
        self._start_ns = start.mono_ns
        self._others = [] if others is None else others
        self._beside = beside
        self._config, self._adopted = config, adopted
        self._started, self._changed_settings = config, ""
        self._recorder, self._handover = recorder, Handover(latches, keeper)
        self._speed_cap: SpeedCap | None = None
        self._answers: deque[tuple[int, Answer]] = deque()
        """Answers that wait until the latch file contains the newest latches. Each answer is paired
        with the monotonic time at which it was queued, ns."""
        self._bus_input = NO_INPUT
        """The input that the present step has taken from the bus."""
        stop = self.robot.session.codec.stop
        self._guard = Guard(stop, config)
        if recorder is not None and latches != Latches():
            # Without this record, a replay would start with a robot that has no latches.
            recorder.begins(self.robot, self._guard)
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._queries = Queries(config, info)
        self._gateway, self._imu = GatewayFollower(), GyroFollower(config.mcu.simulated)
        self._routers = RouterFollower()
        self._turn_rates: list[GyroSample] = []
        """Gyro samples that have arrived since the last step."""
        self._port, self._bus, self._log, self._mono_ns = port, bus, log, mono_ns
        self._superseded, self._late_ns = False, 0
        self._trip: Trip = ""
        """Three facts about the last line to the board. `_superseded` is true if the port did not
        send the line, so that a newer line must replace it. `_trip` is the reason why the guard
        replaced the line with zeros, or "". `_late_ns` is the time from the start of the step to
        the write of the line, ns. It is 0 if this time is below `MIN_WRITE_DELAY_NS`."""
        # Use the longest line of both directions, because answers must not queue in the MCU either.
        line_ns = wire_ns(config.mcu.line_bytes, config.mcu.baud_rate)
        self.pace = Pace(line_ns, config.period_ns)
        self._stopwatch = Stopwatch()

    @property
    def at_rest(self) -> bool:
        """True if the last control step commanded zero speed; False before the first step.

        While the serial port is closed, every step commands zero speed.
        """
        outputs = self.outputs
        return outputs is not None and not any(outputs.speeds.as_tuple())

    def totals(self, now_ns: int) -> dict[str, float]:
        """Return the fields of the log event `ended`: run time in s, distance in m, and counters.

        `now_ns` is the present monotonic time, ns.
        """
        seconds, metres = (now_ns - self._start_ns) / NS_PER_S, self.robot.travelled
        shot = self.robot.snapshot(now_ns)
        return {"seconds": round(seconds, 1), "metres": round(metres, 2), **shot.counters}

    @property
    def retry_ns(self) -> int | None:
        """Monotonic time at which a step between two periods can send the waiting command, ns.

        A command waits if it arrived too soon after the last line to the board. None means that no
        command waits.
        """
        return self.pace.retry_ns(self._port.sent_ns)

    def step(self, now: Instant, period: Period = NO_PERIOD) -> Outputs:
        """Run one control step at the time `now`, and return the robot's outputs.

        `period` says how many periods have ended since the last step. For an extra step between the
        ends of two periods, it is `NO_PERIOD`.
        """
        self._bus_input = NO_INPUT
        try:
            return self._step(now, period)
        except Exception:
            # Store the stops that this step has taken from the bus. The exception may have come
            # before the robot processed them.
            self._handover.take_stops(self.robot.latches, _stops(self._bus_input), now)
            raise

    def _step(self, now: Instant, period: Period) -> Outputs:
        ended = period.expired > 0
        missed = period.expired - 1 if ended else 0
        if ended:
            self._stopwatch.period(now.mono_ns, now.mono_ns - period.due_ns, missed)
            self._others += self._handover.take_events()
        commands, refusals, requests = self._from_bus(now)
        port, pace = self._port, self.pace
        # Call `take` before reading `is_open`. After a suspend of the computer, `take` closes the
        # port.
        received = port.take(now if missed else None)
        # Pass the fields by position: creating a struct by its names takes three times as
        # long.
        inputs = Inputs(
            now,
            ended and pace.period_ended(missed),
            port.is_open,
            port.opened,
            port.trouble,
            received,
            commands,
            requests,
            tuple(self._turn_rates),
            refusals,
            self._trip,
            self._superseded,
            missed,
            tuple(self._others),
            pace.at_once(now.mono_ns, port.sent_ns),
            self.shutting_down,
            self._late_ns,
            self._speed_cap,
        )
        self._speed_cap = None
        if inputs.events:
            self._others.clear()
        if inputs.gyro:
            self._turn_rates.clear()
        before = self._config
        outputs, was_written = self._decided(inputs)
        has_input = bool(commands or refusals or requests)
        pace.record_step(inputs.tick, outputs.due, was_written, outputs.news, has_input)
        self._publish(outputs, outputs.answers)
        # `adopted` may change the log's level, so call it after logging this step's events.
        if self._config is not before and self._adopted:
            self._adopted(self._config)
        self._stopwatch.figures["step_time"].add(now.mono_ns, self._mono_ns() - now.mono_ns)
        # Flush last, because the sending thread needs Python's interpreter lock, which is free only
        # while this loop waits.
        self._bus.flush()
        return outputs

    def _decided(self, inputs: Inputs) -> tuple[Outputs, bool]:
        """Run the robot's step. Return its outputs, and whether the port wrote the line."""
        try:
            outputs = self.outputs = self.robot.step(inputs)
            self._handover.take(outputs.latches)
            if self.robot.config is not self._config:
                self._adopt(self.robot.config)
            line = self._send(outputs, inputs.now, inputs.tick)
        except Exception:
            if self._recorder is not None:
                self._recorder.died(inputs)
            raise
        if self._recorder is not None:
            self._recorder.step(inputs, outputs, line, self.robot, self._guard)
        return outputs, line is not None

    def finish(self, now: Instant) -> None:
        """Store the stops that arrived after the last step, and send the waiting answers."""
        self.keep_last_stops(now)
        self._handover.wait()
        self._answer(now, last=True)
        self._bus.flush()

    def keep_last_stops(self, now: Instant) -> None:
        """Store the stops that arrived after the last step, which no step will process."""
        self._handover.take_stops(self._handover.latches, _stops(self._bus.take(0)), now)

    def _adopt(self, config: Config) -> None:
        self._config = config
        self._guard.use(config)
        self.report.use(config)
        self._queries.use(config)
        changes = differences(config, self._started)
        texts = [change.describe(key) for key, change in changes.items()]
        self._changed_settings = listed(texts, MAX_NAMED)

    def _from_bus(
        self, now: Instant
    ) -> tuple[tuple[Command, ...], tuple[Refusal, ...], tuple[Request, ...]]:
        # Before the first step there are no outputs with which to answer queries. The bus then
        # returns at most one slow query, whose answer needs no outputs.
        batch = self._bus_input = self._bus.take(QUERIES_PER_STEP if self.outputs else 0)
        if batch is NO_INPUT:
            return (), (), ()
        commands: list[Command] = []
        refusals: list[Refusal] = []
        requests: list[Request] = []
        self._note(batch)
        for arrival in batch.arrivals:
            if arrival.key == GATEWAY:
                ends_ns = self._gateway.receive(arrival, self.robot.counters)
                if ends_ns:
                    self.report.certificate_ends[""] = ends_ns
                continue
            if arrival.key == IMU:
                sample = self._imu.receive(arrival, self.robot.counters, self._others)
                if sample is not None:
                    self._turn_rates.append(sample)
                continue
            if arrival.key == SPEED_LIMIT:
                try:
                    self._speed_cap = decode_limit(arrival, self._started.limits.linear_speed)
                except DecodeError as error:
                    refusals.append(Refusal(error.reason, f"{SPEED_LIMIT}: {error}"))
                continue
            if arrival.key == "stop":
                if arrival.put:
                    by = caller_name(arrival.via, arrival.attachment, arrival.sender)
                    requests.append(Request("stop", asked_ns=arrival.arrived_ns, by=by))
                else:
                    refusals.append(Refusal("not_a_put", "stop: send a PUT, not a DELETE"))
                continue
            try:
                commands.append(self._receiver.command(arrival))
            except DecodeError as error:
                identity = claimed_identity(arrival)
                refusals.append(
                    Refusal(
                        error.reason,
                        f"{arrival.key}: {error}",
                        parts(arrival.key)[1],
                        identity.sender,
                        arrival.arrived_ns,
                        identity.shared,
                    )
                )
        if superseded := count_superseded(commands):
            self.robot.counters["commands_superseded"] += superseded
        for source in batch.overrun_sources:
            text = f"source {source}: too many commands came at once, and the oldest were dropped"
            refusals.append(Refusal("displaced", text, source))
        for query in batch.queries:
            served = self._served(query, now, refusals)
            if served is not None:
                requests.append(served)
        return tuple(commands), tuple(refusals), tuple(requests)

    def _note(self, batch: BusInput) -> None:
        if batch.overrun:
            self.robot.counters["bus_overrun"] += batch.overrun
        if batch.dropped:
            self.robot.counters["bus_dropped"] += batch.dropped
        if batch.routers is not None:
            self._routers.receive(batch.routers, self.robot.counters, self._others)
        if batch.stuck:
            self.robot.counters["bus_stuck"] += 1
            self._others.append(BUS_STUCK)

    def _served(self, query: Query, now: Instant, refusals: list[Refusal]) -> Request | None:
        """Answer a query, or return it as a request if the robot must process it.

        Return None if this method has answered the query.
        """
        try:
            served = self._queries.serve(query, self._current, self.outputs)
        except DecodeError as error:
            refusals.append(Refusal(error.reason, f"{query.topic}: {error}"))
            reply = refused(query, str(error), now.wall_ns)
            served = [] if reply is None else [reply]
        if isinstance(served, Request):
            return served
        for reply in served:
            self._bus.reply(reply)
        self._bus.retire(query.ticket)
        return None

    def _send(self, outputs: Outputs, now: Instant, tick: bool) -> bytes | None:
        """Write the line of a step to the port. Return the line, or None if it was not written.

        `tick` is false for a line between two control periods.
        """
        line, self._trip = self._guard.check(outputs)
        self._superseded, self._late_ns = False, 0
        if line is None:
            return None
        before_ns = self._port.sent_ns
        offered = self._port.offer(line, now)
        if offered == "sent":
            self._guard.record_written(line)
            sent_ns = self._port.sent_ns
            self._stopwatch.line(outputs, sent_ns, before_ns)
            late_ns = sent_ns - now.mono_ns
            self._late_ns = late_ns if late_ns >= MIN_WRITE_DELAY_NS else 0
            self.robot.counters["lines_sent"] += 1
            return line
        self._superseded = True
        if offered == "superseded" and tick:
            # Count the lines of periods only. If a line between two periods is superseded, the line
            # of the period still follows.
            self.robot.counters["lines_superseded"] += 1
        return None

    def _publish(self, outputs: Outputs, answers: tuple[Answer, ...]) -> None:
        bus, queued_ns = self._bus, None
        for key, message in self.report.due(outputs, bus.wanted_keys, self._snapshot):
            bus.publish(key, message)
            if key in FEEDBACK_TOPICS:
                queued_ns = self._mono_ns()
        for estimate in outputs.estimates:
            self._stopwatch.feedback(estimate, queued_ns)
        for answer in answers:
            self._answers.append((outputs.now.mono_ns, answer))
        if self._answers:
            self._answer(outputs.now)
        for event in outputs.events:
            self._log(event)

    def _answer(self, now: Instant, *, last: bool = False) -> None:
        """Send the queued answers.

        Unless `last` is true, an answer waits until the latches are stored, but at most for
        `MAX_ANSWER_DELAY_NS`.
        """
        is_stored, before_ns = self._handover.is_stored, now.mono_ns - MAX_ANSWER_DELAY_NS
        trouble = "" if is_stored else self._handover.trouble or NOT_STORED
        while self._answers and (is_stored or last or self._answers[0][0] < before_ns):
            _, answer = self._answers.popleft()
            if trouble and answer.success:
                answer = replace(answer, message=f"{answer.message}; {trouble}")
            reply = self._queries.answered(answer, now.wall_ns)
            if reply is not None:
                self._bus.reply(reply)
                self._bus.retire(reply.ticket)

    def _current(self, key: str) -> Message | None:
        message = self.report.current(key, self._snapshot)
        return self._beside(key) if message is None and self._beside else message

    def _snapshot(self) -> Snapshot:
        outputs = self.outputs
        now_ns = 0 if outputs is None else outputs.now.mono_ns
        return replace(
            self.robot.snapshot(now_ns),
            figures=self._stopwatch.measured(now_ns),
            missed_last_minute=self._stopwatch.missed(now_ns),
            routers=self._routers.status,
            latch_file=self._handover.trouble,
            recording=Recording() if self._recorder is None else self._recorder.status,
            settings_differ=self._changed_settings,
        )


def _stops(batch: BusInput) -> list[str]:
    """Return the name of the sender of each stop in the inputs of a step.

    A call of `srv/stop` counts, too, because the inbox adds a stop for each such call.
    """
    return [
        caller_name(arrival.via, arrival.attachment, arrival.sender)
        for arrival in batch.arrivals
        if arrival.key == "stop" and arrival.put
    ]
