"""Collects the inputs of `Robot.step`, calls it, and carries its outputs. It decides nothing.

The control loop is synchronous, so that the daemon can call `step` from one task and the tests can
call it in virtual time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from msgspec.structs import replace

from acsard.core.config.lowered import lowered
from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.config.wire_time import wire_ns
from acsard.core.guard import Guard
from acsard.core.incoming.bus_interface import GATEWAY_KEY as GATEWAY
from acsard.core.incoming.bus_interface import (
    NOTHING,
    Bus,
    BusInput,
    GatewayFollower,
    RouterFollower,
)
from acsard.core.incoming.commands import Receiver, caller_name, parts, sender
from acsard.core.incoming.imu import GyroFollower
from acsard.core.incoming.queries import Queries, Query, refused
from acsard.core.incoming.speed_limit import SpeedLimiter
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
)
from acsard.daemon.latch_rules import ANSWER_NS, Handover, LatchKeeper
from acsard.daemon.late_watch import LateWatch
from acsard.daemon.latencies import Stopwatch
from acsard.daemon.pacing import NO_PERIOD, Pace, Period
from acsard.daemon.settings_file import SettingsFile, keeps
from acsard.recording.recorded_steps import BlackBox, count_superseded

FEEDBACK = ("odom", "tf", "wheel_states")
"""Keys that are published from the feedback lines."""

QUERIES_PER_STEP = 8
"""Most queries that one step answers. The others wait, so that many of them cost no period."""

LATE_NS = 1_000_000
"""Time from the begin of a step until its line leaves, ns, from which on the robot is told of it.
Most steps take less, and nobody knows the time of a sample better."""

BUS_STUCK = Event("bus_stuck", "the bus accepts no messages; driving goes on", "warning")


class ControlLoop:
    """One robot between its port and its bus."""

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
        recorder: BlackBox | None = None,
        latches: Latches = Latches(),  # noqa: B008
        keeper: LatchKeeper | None = None,
        settings_file: SettingsFile | None = None,
        late_watch: LateWatch | None = None,
    ) -> None:
        """Make a robot with these latches, which `keeper` keeps over a restart.

        `others` are the events of the daemon's other parts. Each step takes them and empties the
        list. `beside` returns the present value of a key that another part publishes. `adopted` is
        called with a configuration that is in force from now on. `recorder` is the black box.
        `settings_file` is the configuration file.
        `late_watch` names the causes of late periods.
        """
        self.robot = Robot(config, latches)
        self.report = Report(config, start, certificate_ends)
        self.shutting_down = False
        """Set it to go down: the robot ramps to zero and stays there."""
        self.outputs: Outputs | None = None
        self._start_ns = start.mono_ns
        self._others = [] if others is None else others
        self._beside = beside
        self._config, self._adopted, self._settings_file = config, adopted, settings_file
        self._recorder, self._handover = recorder, Handover(latches, keeper)
        self._started, self._speed = config.limits, SpeedLimiter(self.robot.config)
        """The limits of the configuration file at the start, and the speed limit in force."""
        self._kept: tuple[Latches, LimitsConfig, LimitsConfig, Latches] | None = None
        """The last latches without a speed limit, with the objects that they were made of."""
        self._step_answers: tuple[Answer, ...] = ()
        """The answers of this step."""
        self._answers: deque[tuple[int, Answer]] = deque()
        """Answers that wait until the file has the latches, each with its monotonic time."""
        self._got = NOTHING
        """The input that this step took from the bus."""
        stop = self.robot.session.codec.stop
        self._guard = Guard(stop, config)
        if recorder is not None and latches != Latches():
            # A replay would otherwise start with a robot that nobody has stopped.
            recorder.begins(self.robot, self._guard)
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._queries = Queries(config, info)
        self._gateway, self._imu = GatewayFollower(), GyroFollower(config.mcu.simulated)
        self._routers = RouterFollower()
        self._turn_rates: list[GyroSample] = []
        """Samples of a gyro since the last step."""
        self._port, self._bus, self._log, self._mono_ns = port, bus, log, mono_ns
        self._superseded, self._trip, self._late_ns = False, "", 0
        """The fate of the last line, for the next step: superseded, replaced by the guard, and how
        much later than its step it left, ns."""
        # The longest line of either direction: answers must not queue in the MCU either.
        period_ns = int(NS_PER_S / config.rate_hz)
        self._pace = Pace(wire_ns(config.mcu.line_bytes, config.mcu.baud_rate), period_ns)
        self._stopwatch, self._late_watch = Stopwatch(), late_watch

    @property
    def at_rest(self) -> bool:
        """True if the last step commanded zero, as it does without a link."""
        outputs = self.outputs
        return outputs is not None and not any(outputs.speeds.as_tuple())

    def totals(self, now_ns: int) -> dict[str, float]:
        """Return the run time, s, the distance, m, and all counters, for the last log line."""
        seconds, metres = (now_ns - self._start_ns) / NS_PER_S, self.robot.travelled
        shot = self.robot.snapshot(now_ns)
        return {"seconds": round(seconds, 1), "metres": round(metres, 2), **shot.counters}

    @property
    def retry_ns(self) -> int | None:
        """Monotonic time of the extra step for a command that came too soon after the last line."""
        return self._pace.retry_ns(self._port.sent_ns) if self._pace.waits else None

    @property
    def listens(self) -> bool:
        """Whether a command that arrives now gets a step of its own, before the next period."""
        return self._pace.listens

    def step(self, now: Instant, period: Period = NO_PERIOD) -> Outputs:
        """Take one step at `now`, at the end of a period or between two."""
        self._got = NOTHING
        try:
            return self._step(now, period)
        except Exception:
            # A stop that this step took is lost otherwise: the bug may have come before it.
            self._handover.take_stops(self._to_keep(self.robot.latches), _stops(self._got), now)
            raise

    def _step(self, now: Instant, period: Period) -> Outputs:
        ended, missed = period.expired > 0, max(0, period.expired - 1)
        if ended:
            late_ns = now.mono_ns - period.due_ns
            self._stopwatch.period(now.mono_ns, late_ns, missed)
            if self._late_watch is not None:
                self._late_watch.period(now.mono_ns, late_ns, missed)
                # A line of the log has the text of its last event. In a late step that would be
                # the number of periods, not the cause.
                if not missed:
                    self._others += self._late_watch.news()
        commands, refusals, requests = self._from_bus(now)
        requests += self._keepable(now)
        requests, refused_sets = self._speed.requests(requests, now.mono_ns)
        self._others += self._handover.news()
        port, pace = self._port, self._pace
        # Take the bytes first: `take` closes the port when the computer was suspended.
        received = port.take(now if missed else None)
        # Pass by position: with seventeen names a struct takes three times as long.
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
        )
        if inputs.events:
            self._others.clear()
        if inputs.gyro:
            self._turn_rates.clear()
        before = self._config
        outputs, went = self._decided(inputs)
        self._step_answers = (*refused_sets, *self._step_answers)
        heard = bool(commands or refusals or requests)
        pace.note(inputs.tick, outputs.due, went, outputs.news, heard)
        self._publish(outputs)
        # Only now, after the log has the event.
        if self._config is not before and self._adopted:
            self._adopted(self._config)
        self._stopwatch.step(now.mono_ns, self._mono_ns())
        # Last, because the sending thread needs the interpreter, which is free when the loop waits.
        self._bus.flush()
        return outputs

    def _decided(self, inputs: Inputs) -> tuple[Outputs, bool]:
        """Return the outputs and whether their line left, and record the step in any case."""
        try:
            outputs = self.outputs = self.robot.step(inputs)
            self._step_answers = self._speed.settle(
                self.robot.config, outputs.answers, self._others
            )
            self._handover.take(self._to_keep(outputs.latches))
            if self.robot.config is not self._config:
                self._adopt(self.robot.config)
            went = self._send(outputs, inputs.now, inputs.tick)
        except Exception:
            if self._recorder is not None:
                self._recorder.died(inputs)
            raise
        if self._recorder is not None:
            self._recorder.step(inputs, outputs, went, self.robot, self._guard)
        return outputs, went is not None

    def _to_keep(self, latches: Latches) -> Latches:
        """Return the latches of the robot as the next start of the daemon needs them.

        The limits that a person has lowered are kept over a restart. A speed limit is not, because
        the program that would lift it may be gone.
        """
        now, file = self._speed.settings.limits, self._settings_file
        if file is not None:
            latches = file.latches(latches, now)
        if self._speed.lowers:
            limits, kept = self._started if file is None else file.limits, self._kept
            if kept is None or not (kept[0] is latches and kept[1] is now and kept[2] is limits):
                without = replace(latches, lowered=lowered(limits, now))
                kept = self._kept = latches, now, limits, without
            latches = kept[3]
        last = self._handover.latches
        # The file is written again for another object only.
        return last if latches == last else latches

    def finish(self, now: Instant) -> None:
        """Keep the stops that arrived after the last step, and give the last answers."""
        self.keep_last_stops(now)
        self._handover.wait()
        self._answer(now, last=True)
        self._bus.flush()

    def keep_last_stops(self, now: Instant) -> None:
        """Keep the stops that no step will serve, because they arrived after the last one."""
        self._handover.take_stops(self._handover.latches, _stops(self._bus.take(0)), now)

    def _adopt(self, config: Config) -> None:
        """Use the configuration that the robot has used since this step."""
        self._config = config
        self._guard.use(config)
        self.report.use(config)
        self._queries.use(config)
        if self._settings_file is not None:
            self._settings_file.use(self._speed.settings)

    def _from_bus(
        self, now: Instant
    ) -> tuple[tuple[Command, ...], tuple[Refusal, ...], tuple[Request, ...]]:
        # Before the first step there are no outputs to answer with.
        got = self._got = self._bus.take(QUERIES_PER_STEP if self.outputs else 0)
        if got is NOTHING:
            return (), (), ()
        commands: list[Command] = []
        refusals: list[Refusal] = []
        requests: list[Request] = []
        self._note(got)
        for arrival in got.arrivals:
            if arrival.key == GATEWAY:
                ends_ns = self._gateway.receive(arrival, self.robot.counters)
                if ends_ns:
                    self.report.certificate_ends[""] = ends_ns
                continue
            if arrival.key == IMU:
                heard = self._imu.receive(arrival, self.robot.counters, self._others)
                if heard is not None:
                    self._turn_rates.append(heard)
                continue
            if arrival.key == SPEED_LIMIT:
                file = self._settings_file
                limits = self._started if file is None else file.limits
                self._speed.receive(arrival, limits.linear_speed, refusals)
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
                refusals.append(
                    Refusal(
                        error.reason,
                        f"{arrival.key}: {error}",
                        parts(arrival.key)[1],
                        sender(arrival),
                        arrival.arrived_ns,
                    )
                )
        if superseded := count_superseded(commands):
            self.robot.counters["commands_superseded"] += superseded
        for source in got.overrun_sources:
            text = f"source {source}: too many commands came at once, and the oldest were dropped"
            refusals.append(Refusal("displaced", text, source))
        for query in got.queries:
            served = self._served(query, now, refusals)
            if served is not None:
                requests.append(served)
        return tuple(commands), tuple(refusals), tuple(requests)

    def _note(self, got: BusInput) -> None:
        """Count and report the troubles of the bus itself."""
        if got.overrun:
            self.robot.counters["bus_overrun"] += got.overrun
        if got.dropped:
            self.robot.counters["bus_dropped"] += got.dropped
        if got.routers is not None:
            self._routers.receive(got.routers, self.robot.counters, self._others)
        if got.stuck:
            self.robot.counters["bus_stuck"] += 1
            self._others.append(BUS_STUCK)

    def _served(self, query: Query, now: Instant, refusals: list[Refusal]) -> Request | None:
        """Answer a query and return None, or return the request that the robot must decide."""
        try:
            served = self._queries.serve(query, self._current, self.outputs)
        except DecodeError as error:
            refusals.append(Refusal(error.reason, f"{query.topic}: {error}"))
            reply = refused(query, str(error), now.wall_ns)
            served = [] if reply is None else [reply]
        if isinstance(served, Request):
            wants = query.via == "native" and served.verb == "set"
            if wants and keeps(query.encoding, query.payload):
                self._keep(served, now)
                return None
            return served
        for reply in served:
            self._bus.reply(reply)
        self._bus.retire(query.ticket)
        return None

    def _keep(self, request: Request, now: Instant) -> None:
        """Hand a `set` with `keep` to the configuration file, which says if it can be written."""
        if self._settings_file is None:
            text = "nothing is set: this daemon has no configuration file"
            self._answers.append((now.mono_ns, Answer(request.id, False, text)))
        else:
            self._settings_file.keep(request, now.mono_ns)

    def _keepable(self, now: Instant) -> tuple[Request, ...]:
        """Return the requests whose settings can be written, and queue the answers to others."""
        if self._settings_file is None:
            return ()
        results = self._settings_file.results(now.mono_ns, self._others)
        self._answers.extend((now.mono_ns, one) for one in results if isinstance(one, Answer))
        return tuple([one for one in results if isinstance(one, Request)])

    def _send(self, outputs: Outputs, now: Instant, tick: bool) -> bytes | None:
        """Offer the line, and return it if it left. The next step tells the robot its fate."""
        line, self._trip = self._guard.check(outputs)
        self._superseded, self._late_ns = False, 0
        if line is None:
            return None
        before_ns = self._port.sent_ns
        offered = self._port.offer(line, now)
        if offered == "sent":
            self._guard.left(line)
            self._stopwatch.line(outputs, self._port.sent_ns, before_ns)
            late_ns = self._port.sent_ns - now.mono_ns
            self._late_ns = late_ns if late_ns >= LATE_NS else 0
            self.robot.counters["lines_sent"] += 1
            return line
        self._superseded = True
        if offered == "superseded" and tick:
            # A line that could not go at once is not counted: its period's line follows.
            self.robot.counters["lines_superseded"] += 1
        return None

    def _publish(self, outputs: Outputs) -> None:
        bus, told_ns = self._bus, None
        for key, message in self.report.due(outputs, bus.wanted, self._look):
            bus.publish(key, message)
            if key in FEEDBACK:
                told_ns = self._mono_ns()
        for estimate in outputs.estimates:
            self._stopwatch.feedback(estimate, told_ns)
        if self._step_answers:
            file, now_ns = self._settings_file, outputs.now.mono_ns
            self._answers.extend(
                (now_ns, answer)
                for answer in self._step_answers
                if file is None or not file.obeyed(answer)
            )
        if self._answers:
            self._answer(outputs.now)
        for event in outputs.events:
            self._log(event)

    def _answer(self, now: Instant, *, last: bool = False) -> None:
        """Give each answer that has the file or has waited for its time; `last` gives them all."""
        held, before_ns = self._handover.held, now.mono_ns - ANSWER_NS
        trouble = "" if held else self._handover.trouble
        while self._answers and (held or last or self._answers[0][0] < before_ns):
            _, answer = self._answers.popleft()
            if trouble and answer.success:
                answer = replace(answer, message=f"{answer.message}; {trouble}")
            reply = self._queries.answered(answer, now.wall_ns)
            if reply is not None:
                self._bus.reply(reply)
                self._bus.retire(reply.ticket)

    def _current(self, key: str) -> Message | None:
        message = self.report.current(key, self._look)
        return self._beside(key) if message is None and self._beside else message

    def _look(self) -> Snapshot:
        outputs = self.outputs
        if self._settings_file is not None:
            self.report.settings_differ = self._settings_file.differ
        self.report.speed_limit = self._speed.text
        now_ns = 0 if outputs is None else outputs.now.mono_ns
        return replace(
            self.robot.snapshot(now_ns),
            figures=self._stopwatch.measured(now_ns),
            missed_last_minute=self._stopwatch.missed(now_ns),
            routers=self._routers.status,
            latch_file=self._handover.trouble,
            recording=Recording() if self._recorder is None else self._recorder.status,
        )


def _stops(got: BusInput) -> list[str]:
    """Return the names of those that stop the robot with this input."""
    puts = [one for one in got.arrivals if one.key == "stop" and one.put]
    calls = [query for query in got.queries if query.topic == "srv/stop"]
    names = [caller_name(put.via, put.attachment, put.sender) for put in puts]
    return names + [caller_name(call.via, call.attachment) for call in calls]
