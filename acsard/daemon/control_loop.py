"""Runs a wake-up: hear, drive, guard, port, sent, recorder, bus, in this order.

The robot makes all decisions about the motion, and the guard checks each line. The loop is
synchronous, so that the daemon can call `step` from one task, and the tests in virtual time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping

from msgspec.structs import replace

from acsard.core.codes import RefusalCode
from acsard.core.config.live import Difference
from acsard.core.config.settings import Config
from acsard.core.config.wire_time import wire_ns
from acsard.core.formatting import listed
from acsard.core.guard import Guard
from acsard.core.incoming.bus_interface import GATEWAY_KEY as GATEWAY
from acsard.core.incoming.bus_interface import (
    NO_INPUT,
    Bus,
    BusInput,
    GatewayFollower,
    RouterFollower,
)
from acsard.core.incoming.commands import (
    Arrival,
    Receiver,
    caller_name,
    claimed_identity,
    parts,
)
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
    Heard,
    Instant,
    Latches,
    Ns,
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
from acsard.recording.recorded_steps import StepRecorder
from acsard.recording.stepped_robot import LineOutcome, inputs_of, outputs_of

# Queries that a step takes, beside one slow one (`set`, ROS parameters). More wait, so that a flood
# costs no period.
QUERIES_PER_STEP = 8

# Least delay of a line; less is reported as 0, as the estimated sample times are less exact.
MIN_WRITE_DELAY_NS = 1_000_000

MAX_NAMED = 3  # settings in `settings_differ`

# Added to an answer while a slow disk lacks the newest latches.
NOT_STORED = (
    "the new state is not on the disk yet; if the daemon restarts before the disk has this state, "
    "it may lose a stop"
)

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
        # `others` collects events of other parts, which each step logs. `beside` returns the newest
        # message of a key of another part, such as the simulator. `adopted` gets each new
        # configuration. `latches` are those at the start, which `keeper` stores over a restart.
        self.robot = Robot(config, latches)
        self.report = Report(config, start, certificate_ends, info.version)
        self.shutting_down = False  # the robot ramps to zero and stays at rest
        self.outputs: Outputs | None = None
        self._start_ns = start.mono_ns
        self._others = [] if others is None else others
        self._beside = beside
        self._config, self._adopted = config, adopted
        # Highest speed at the start; settings that differ from then, and their values then.
        self._top_speed = config.limits.linear_speed
        self._differing: dict[str, Difference] = {}
        self._recorder, self._handover = recorder, Handover(latches, keeper)
        self._speed_cap: SpeedCap | None = None
        # Answers, with the time at which each was queued, until the latches are in their file.
        self._answers: deque[tuple[int, Answer]] = deque()
        self._bus_input = NO_INPUT  # of the present step
        stop = self.robot.session.codec.stop
        self._guard = Guard(stop, config)
        if recorder is not None and latches != Latches():
            # Without this record, a replay would start with a robot that has no latches.
            recorder.begins(self.robot, self._guard)
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._queries = Queries(config, info)
        self._gateway, self._imu = GatewayFollower(), GyroFollower(config.mcu.simulated)
        self._routers = RouterFollower()
        # Of the bus, beside those of the robot.
        self._counters: Counter[str] = Counter()
        self._turn_rates: list[GyroSample] = []  # since the last step
        self._port, self._bus, self._log, self._mono_ns = port, bus, log, mono_ns
        self._outcome = LineOutcome()  # of the last line
        # Use the longest line of both directions, because answers must not queue in the MCU either.
        line_ns = wire_ns(config.mcu.line_bytes, config.mcu.baud_rate)
        self.pace = Pace(line_ns, config.period_ns)
        self._stopwatch = Stopwatch()
        bus.feedback_sent = self._stopwatch.figures["feedback_to_bus"].add

    @property
    def at_rest(self) -> bool:
        """Whether the last step commanded zero, as every step with a closed port does."""
        outputs = self.outputs
        return outputs is not None and not any(outputs.speeds.as_tuple())

    def totals(self, now_ns: Ns) -> dict[str, float]:
        """Return the fields of the event `ended`: run time in s, distance in m, counters."""
        seconds, metres = (now_ns - self._start_ns) / NS_PER_S, self.robot.travelled
        counters = self._snapshot().counters
        return {"seconds": round(seconds, 1), "metres": round(metres, 2), **counters}

    def step(self, now: Instant, period: Period = NO_PERIOD) -> Outputs:
        """Run one control step, and return the robot's outputs.

        `period` says how many periods have ended; `NO_PERIOD` is for an extra step.
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
        # Call `take` before reading `is_open`: in a late step it may find the port lost.
        received = port.take(now if missed else None)
        # Pass the fields by position: creating a struct by its names takes three times as
        # long.
        heard = Heard(
            port.is_open,
            port.opened,
            port.trouble,
            received,
            commands,
            refusals,
            requests,
            tuple(self._turn_rates),
            tuple(self._others),
            missed,
            self._speed_cap,
            self.shutting_down,
        )
        self._speed_cap = None
        if heard.events:
            self._others.clear()
        if heard.gyro:
            self._turn_rates.clear()
        before = self._config
        has_input = bool(commands or refusals or requests)
        outputs = self._act(now, heard, ended and pace.period_ended(missed), has_input)
        self._publish(outputs, outputs.answers)
        # `adopted` may change the log's level, so call it after logging this step's events.
        if self._config is not before and self._adopted:
            self._adopted(self._config)
        self._stopwatch.figures["step_time"].add(self._mono_ns() - now.mono_ns)
        # Flush last, because the threads that send need this core and Python's interpreter lock,
        # which are free only while this loop waits.
        self._bus.flush()
        return outputs

    def _act(self, now: Instant, heard: Heard, tick: bool, has_input: bool) -> Outputs:
        robot, recorder, before = self.robot, self._recorder, self._outcome
        at_once = self.pace.at_once(now.mono_ns, self._port.sent_ns)
        line: bytes | None = None
        sent: bytes | None = None
        self._outcome = LineOutcome()
        try:
            news = robot.hear(now, heard)
            self._handover.take(robot.latches)
            if robot.config is not self._config:
                self._adopt(robot.config, news.answers)
            due = tick or (at_once and news.urgent)
            if due:
                line = robot.drive(now)
                if line is not None:
                    sent = self._send(line, now)
        except Exception:
            if recorder is not None:
                recorder.died(inputs_of(now, heard, tick, at_once, before))
            raise
        self.pace.record_step(
            tick, due, sent is not None, news.urgent, has_input, self._port.sent_ns
        )
        outputs = self.outputs = outputs_of(now, robot, news, due, line)
        if recorder is not None:
            inputs = inputs_of(now, heard, tick, at_once, before)
            recorder.step(inputs, outputs, sent, robot, self._guard)
        return outputs

    def _send(self, line: bytes, now: Instant) -> bytes | None:
        # None: not written.
        robot, port, status = self.robot, self._port, self.robot.status
        line, trip = self._guard.check(line, now.mono_ns, status, robot.command_ns)
        before_ns, late_ns = port.sent_ns, 0
        was_written = port.offer(line, now) == "sent"
        if was_written:
            self._guard.record_written(line)
            sent_ns = port.sent_ns
            if status.mode == "driving":
                self._stopwatch.line(robot.command_ns, sent_ns, before_ns)
            late_ns = sent_ns - now.mono_ns
            late_ns = late_ns if late_ns >= MIN_WRITE_DELAY_NS else 0
        sent = line if was_written else None
        robot.sent(now.mono_ns + late_ns, sent, trip)
        self._outcome = LineOutcome(trip, not was_written, late_ns)
        return sent

    def finish(self, now: Instant) -> None:
        """Store the stops that arrived after the last step, and send the waiting answers."""
        self.keep_last_stops(now)
        self._handover.wait()
        self._answer(now, last=True)
        self._bus.flush()

    def keep_last_stops(self, now: Instant) -> None:
        """Store the stops that arrived after the last step, which no step will process."""
        self._handover.take_stops(self._handover.latches, _stops(self._bus.take(0)), now)

    def _adopt(self, config: Config, answers: tuple[Answer, ...]) -> None:
        self._config = self._queries.config = self.report.config = config
        self._guard.use(config)
        for answer in answers:
            for key, (old, new) in answer.changes.items():
                earlier = self._differing.pop(key, None)
                ours = old if earlier is None else earlier.ours
                if new != ours:
                    self._differing[key] = Difference(new, ours)

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
                ends_ns = self._gateway.receive(arrival, self._counters)
                if ends_ns:
                    self.report.certificate_ends[""] = ends_ns
                continue
            if arrival.key == IMU:
                sample = self._imu.receive(arrival, self._counters, self._others)
                if sample is not None:
                    self._turn_rates.append(sample)
                continue
            if arrival.key == SPEED_LIMIT:
                try:
                    self._speed_cap = decode_limit(arrival, self._top_speed)
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
                refusals.append(_refusal(arrival, error.reason, f"{arrival.key}: {error}"))
        for arrival in batch.displaced:
            source = parts(arrival.key)[1]
            text = f"source {source}: too many commands came at once, and the oldest were dropped"
            refusals.append(_refusal(arrival, "displaced", text))
        for query in batch.queries:
            served = self._served(query, now, refusals)
            if served is not None:
                requests.append(served)
        return tuple(commands), tuple(refusals), tuple(requests)

    def _note(self, batch: BusInput) -> None:
        if batch.overrun:
            self._counters["bus_overrun"] += batch.overrun
        if batch.dropped:
            self._counters["bus_dropped"] += batch.dropped
        if batch.routers is not None:
            self._routers.receive(batch.routers, self._counters, self._others)
        if batch.stuck:
            self._counters["bus_stuck"] += 1
            self._others.append(BUS_STUCK)

    def _served(self, query: Query, now: Instant, refusals: list[Refusal]) -> Request | None:
        # None: answered here.
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

    def _publish(self, outputs: Outputs, answers: tuple[Answer, ...]) -> None:
        bus, report, wanted = self._bus, self.report, self._bus.wanted_keys
        for estimate in outputs.estimates:
            for topic in report.feedback_due(estimate, wanted):
                bus.publish_feedback(topic, estimate)
            self._stopwatch.feedback(estimate)
        for key, message in report.others_due(outputs, wanted, self._snapshot):
            bus.publish(key, message)
        for answer in answers:
            self._answers.append((outputs.now.mono_ns, answer))
        if self._answers:
            self._answer(outputs.now)
        for event in outputs.events:
            self._log(event)

    def _answer(self, now: Instant, *, last: bool = False) -> None:
        # Unless `last`, an answer waits until the latches are stored, for `MAX_ANSWER_DELAY_NS`.
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
        shot = self.robot.snapshot(now_ns)
        return replace(
            shot,
            counters=shot.counters | self._counters,
            figures=self._stopwatch.measured(now_ns),
            missed_last_minute=self._stopwatch.missed(now_ns),
            routers=self._routers.status,
            latch_file=self._handover.trouble,
            recording=Recording() if self._recorder is None else self._recorder.status,
            settings_differ=listed(
                [one.describe(key) for key, one in self._differing.items()], MAX_NAMED
            ),
        )


def _refusal(arrival: Arrival, code: RefusalCode, text: str) -> Refusal:
    sender = claimed_identity(arrival).sender
    return Refusal(code, text, parts(arrival.key)[1], sender, arrival.arrived_ns)


def _stops(batch: BusInput) -> list[str]:
    # A call of `srv/stop` counts, because the inbox adds a stop for it.
    return [
        caller_name(arrival.via, arrival.attachment, arrival.sender)
        for arrival in batch.arrivals
        if arrival.key == "stop" and arrival.put
    ]
