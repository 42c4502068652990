"""The whole daemon in virtual time: control loop, simulated MCU and an in-memory bus.

`World.run` jumps from one event to the next and reads no real clock, so an hour takes seconds. The
port here delays lines by the same rule as the real one (`SerialOutput`). The simulated MCU sends
and receives bytes at the speed of the wire.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence

import msgspec
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.incoming.bus_interface import NO_INPUT, BusHealth, BusInput
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.imu import SIMULATOR_SENDER
from acsard.core.incoming.queries import Query, Reply
from acsard.core.link.codec import Codec
from acsard.core.link.serial_output import Offered, SerialOutput
from acsard.core.messages.encodings import encode
from acsard.core.messages.frames import FeedbackTopic
from acsard.core.messages.keys_and_roles import PUBLISHED
from acsard.core.messages.schema import Beat, Info, Message, Odometry, RobotState, ServiceReply
from acsard.core.messages.signature import Signature
from acsard.core.robot import Robot
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.simulated_robot import Observation, WatchedMcu
from acsard.core.simulator.true_messages import turn_rate
from acsard.core.values import (
    NS_PER_S,
    Announcement,
    Estimate,
    Event,
    Instant,
    Latches,
    Pose,
    Received,
)
from acsard.daemon.control_loop import ControlLoop
from acsard.daemon.latch_file import Keeper
from acsard.daemon.pacing import NO_PERIOD, Period
from acsard.daemon.publication import Publication
from acsard.recording.recorded_steps import StepRecorder
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.stepped import Outputs, outputs_of

START = Instant(5 * NS_PER_S, 1_800_000_000 * NS_PER_S)

EVERY_KEY = frozenset(topic.key for topic in PUBLISHED if not topic.latched)

LET_GO_NS = 4 * NS_PER_S // 10
"""Time after a speed in which a zero does not arm, for senders of 5 Hz and more."""

SIGNED = Signature("somebody").pack()
"""Sender attachment of the commands of `World.send`."""


class VirtualPort:
    """A serial port to the simulated MCU.

    Tests can unplug it, block it, delay it, and let it accept only part of a line.
    """

    def __init__(self, baud_rate: int, stop: bytes, period_ns: int) -> None:
        self.is_open = False
        self.opened = 0
        self.blocked = False
        self.pause: Callable[[], int] | None = None
        """Runs before the next line is handed over, and returns the time then."""
        self.takes: int | None = None
        """Number of bytes of the next line that the kernel takes; None for all."""
        self.trouble = ""
        self.released = False
        self._lent: FakeMcu | None = None
        self.sent: deque[tuple[int, bytes]] = deque(maxlen=100_000)
        self.mcu: FakeMcu | None = None
        self._opening = (baud_rate, stop, period_ns)
        self._output = SerialOutput(*self._opening)
        self._received: list[Received] = []
        self.sent_ns = 0

    def plug(self, mcu: FakeMcu) -> None:
        self.mcu, self.is_open = mcu, True
        self.opened += 1
        self._output, self.sent_ns = SerialOutput(*self._opening), 0

    def unplug(self) -> None:
        self.mcu, self.is_open = None, False
        self._received.clear()

    def feed(self, received: Received) -> None:
        self._received.append(received)

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        if not self._received:
            return ()
        batch = tuple(self._received)
        self._received.clear()
        return batch

    def release(self, released: bool) -> None:
        if released and self.mcu is not None:
            self._lent = self.mcu
            self.unplug()
        elif not released and self._lent is not None:
            self.plug(self._lent)
            self._lent = None
        self.released = released

    def offer(self, line: bytes, now: Instant) -> Offered:
        if self.mcu is None:
            return "down"
        pause, self.pause = self.pause, None
        now_ns = now.mono_ns if pause is None else pause()
        data = self._output.prepare(line, now.mono_ns, now_ns, int(self.blocked))
        if data is None:
            return "superseded"
        part, self.takes = data[: self.takes], None
        self.mcu.receive(now_ns, part)
        self.sent.append((now_ns, part.removeprefix(b"\r\n")))
        offered = self._output.record_write(line, data, len(part), now_ns)
        self.sent_ns = self._output.sent_ns
        return offered


class MemoryBus:
    """A bus in memory: it stores the daemon's messages, and delivers a test's samples and queries.

    It stores only messages on the keys in `wanted`.
    """

    def __init__(self, wanted: Collection[str]) -> None:
        self.output, self.wanted_keys = self, set(wanted)
        self.published: dict[str, deque[Message]] = {}
        self.feedback_sent: Callable[[int], object] = list[int]().append
        self.replies: dict[int, list[Reply]] = {}
        self.finished: set[int] = set()
        self.arrivals: list[Arrival] = []
        self.displaced: list[Arrival] = []
        self.announced: list[Announcement] = []
        self.queries: list[Query] = []

    def take(self, queries: int) -> BusInput:
        if not (self.arrivals or self.queries or self.announced):
            return NO_INPUT
        batch = BusInput(
            tuple(self.arrivals),
            tuple(self.queries[:queries]),
            displaced=tuple(self.displaced),
            announced=tuple(self.announced),
        )
        self.arrivals.clear()
        self.announced.clear()
        self.displaced.clear()
        del self.queries[:queries]
        return batch

    def look(self) -> BusHealth:
        return BusHealth()

    def publish(self, key: str, message: Message) -> None:
        self.published.setdefault(key, deque(maxlen=100_000)).append(message)

    def publish_feedback(self, topic: FeedbackTopic, estimate: Estimate) -> None:
        self.publish(topic.key, topic.build(estimate))

    def publish_beat(self, beat: Beat) -> None:
        self.publish("beat", beat)

    def flush(self) -> None: ...

    def reply(self, reply: Reply) -> None:
        self.replies.setdefault(reply.ticket, []).append(reply)

    def retire(self, ticket: int) -> None:
        self.finished.add(ticket)


def naming(numbers: Collection[int] | None) -> bytes:
    """Return the payload of a `clear` or `activate` that names these causes, or of a plain one."""
    return b"" if numbers is None else msgspec.json.encode({"numbers": list(numbers)})


class World:
    """A simulated robot and its daemon in virtual time."""

    def __init__(
        self,
        config: Config | None = None,
        *,
        plugged: bool = True,
        recorder: StepRecorder | None = None,
        latches: Latches = Latches(),  # noqa: B008
        keeper: Keeper | None = None,
        wanted: Collection[str] = (),
        gyro: ImperfectGyro | None = None,
    ) -> None:
        """Start the daemon. It encodes messages only for the keys in `wanted`.

        `state` and `odom` are always available as properties.
        """
        self.config = config or Config()
        self.now_ns = START.mono_ns
        self.wall_offset_ns = START.wall_ns - START.mono_ns
        self.period_ns = int(NS_PER_S / self.config.rate_hz)
        self.next_period_ns = self.now_ns
        self.truth = Pose()
        """True pose, updated every 10 ms, but only with a gyro."""
        self.gyro, self.gyro_dead = gyro or ImperfectGyro(), False
        watched = self.config.odometry.gyro
        self.mcu = (
            WatchedMcu(self.config, self.now_ns, self._see)
            if watched
            else FakeMcu(self.config, self.now_ns)
        )
        self.port = VirtualPort(
            self.config.mcu.baud_rate,
            Codec(self.config.mcu.wheels, self.config.mcu.trailing_comma).stop,
            self.period_ns,
        )
        if plugged:
            self.port.plug(self.mcu)
        self.bus = MemoryBus(wanted)
        self.events: list[Event] = []
        self.watch: Callable[[Outputs], None] = lambda outputs: None
        info = Info("acsar", "0", 1, "sim", True, self.config.rate_hz, [], [])
        robot, keeper = Robot(self.config, latches), keeper or Keeper(latches)
        start, log = self.instant, self.events.append
        publication = Publication(
            robot, self.bus, info, start, log, keeper, recorder, boot_ns=lambda: self.now_ns
        )
        self.loop = ControlLoop(
            robot, self.port, publication, keeper, start, lambda: self.now_ns, recorder
        )
        self.outputs: Outputs | None = None
        """Those of the last step."""
        self._queries = 0
        self._moved_ns: dict[str, int] = {}
        """Maps each source to the time of its last speed."""
        self.steps = 0
        self._alarm_ns: int | None = None
        """Time to which the alarm was last set. It may have rung since then."""
        self._missed = 0

    def _see(self, sight: Observation) -> None:
        self.truth = sight.pose
        if not self.gyro_dead:
            wall_ns = sight.at_ns + self.wall_offset_ns - self.gyro.delay_ns
            made = turn_rate(replace(sight, gyro=self.gyro.rate(sight.gyro)), "base_link", wall_ns)
            variance = [self.gyro.noise**2 if cell % 4 == 0 else 0.0 for cell in range(9)]
            message = replace(made, angular_velocity_covariance=variance)
            payload, signed = encode(message, "msgpack"), Signature(SIMULATOR_SENDER).pack()
            self.bus.arrivals.append(
                Arrival("imu", True, payload, "", sight.at_ns, None, "", "native", signed)
            )

    @property
    def _listens(self) -> bool:
        """Whether the daemon handles a command that arrives now immediately, in an extra step."""
        return self.steps > 0 and self.loop.pace.early

    @property
    def instant(self) -> Instant:
        return Instant(self.now_ns, self.now_ns + self.wall_offset_ns)

    def run(self, seconds: float) -> None:
        """Advance the time by `seconds`, with a step in each control period.

        Bytes from the MCU arrive at their due times.
        """
        end_ns = self.now_ns + int(seconds * NS_PER_S)
        while True:
            alarm_ns, at_ns = self._alarm_ns, self.next_period_ns
            rings = alarm_ns is not None and alarm_ns <= at_ns
            if alarm_ns is not None and rings:
                at_ns = alarm_ns
            # Of two things at the same time the alarm is first, then the period, then the bytes.
            if self._bytes_came(min(at_ns - 1, end_ns)):
                self._step()
                continue
            if at_ns > end_ns:
                self.now_ns = max(self.now_ns, end_ns)
                return
            self.now_ns = max(self.now_ns, at_ns)
            if rings:
                self._alarm_ns = None
                self._step()
                continue
            missed, self._missed = self._missed, 0
            due_ns = self.next_period_ns - missed * self.period_ns
            self.next_period_ns += self.period_ns
            self._step(Period(1 + missed, due_ns))

    def _bytes_came(self, until_ns: int) -> bool:
        """Advance the MCU until it sends bytes, and deliver them to the port.

        Returns False if it sends none by `until_ns`.
        """
        mcu = self.port.mcu
        if mcu is None:
            return False
        while (due_ns := mcu.next_ns()) is not None and due_ns <= until_ns:
            data = mcu.advance(due_ns)
            if data:
                self.now_ns = max(self.now_ns, due_ns)
                self.port.feed(Received(self.instant, data))
                return True
        return False

    def stall(self, seconds: float) -> None:
        """Let time pass without a step of the loop."""
        self.now_ns += int(seconds * NS_PER_S)
        if self.port.mcu is not None:
            data = self.port.mcu.advance(self.now_ns)
            if data:
                self.port.feed(Received(self.instant, data))
        self._missed = max(0, (self.now_ns - self.next_period_ns) // self.period_ns)
        self.next_period_ns += self._missed * self.period_ns

    def stall_in_step(self, seconds: float) -> None:
        """Stall the next step after it has built its line and before the port gets the line."""

        def pause() -> int:
            self.stall(seconds)
            return self.now_ns

        self.port.pause = pause

    def _step(self, period: Period = NO_PERIOD) -> None:
        now_ns = self.now_ns
        now, news, due, line = self.loop.step(Instant(now_ns, now_ns + self.wall_offset_ns), period)
        outputs = self.outputs = outputs_of(now, self.loop.robot, news, due, line)
        self.steps += 1
        self._alarm_ns = self.loop.pace.retry_ns
        self.watch(outputs)

    # actions of clients

    def send(
        self, linear: float, angular: float = 0.0, source: str = "app", stamp_ns: int | None = None
    ) -> None:
        """Send one Twist as JSON, with a sender id. `speakers.py` has other kinds of senders."""
        if linear or angular:
            self._moved_ns[source] = self.now_ns
        payload = msgspec.json.encode({"linear": {"x": linear}, "angular": {"z": angular}})
        self.put(f"cmd/{source}", payload, stamp_ns=stamp_ns, attachment=SIGNED)

    def send_together(self, speeds: Sequence[float], source: str = "app") -> None:
        """Send Twists that the next step of the control loop reads together."""
        for speed in speeds:
            payload = msgspec.json.encode({"linear": {"x": speed}, "angular": {"z": 0.0}})
            self.bus.arrivals.append(
                Arrival(
                    f"cmd/{source}", True, payload, "", self.now_ns, None, "", attachment=SIGNED
                )
            )

    def put(
        self,
        key: str,
        payload: bytes,
        put: bool = True,
        stamp_ns: int | None = None,
        attachment: bytes = b"",
        session: str = "peer",
    ) -> None:
        peer = session if stamp_ns else ""
        self.bus.arrivals.append(
            Arrival(key, put, payload, "", self.now_ns, stamp_ns, peer, attachment=attachment)
        )
        if self._listens or key == "stop":
            self._step()

    def drive(
        self,
        linear: float,
        angular: float = 0.0,
        seconds: float = 1.0,
        source: str = "app",
        hz: float = 20.0,
    ) -> None:
        """Send the zeros that arm the source, and then the twist at `hz` for `seconds`."""
        let_go_ns = self._moved_ns.get(source, 0) + LET_GO_NS
        while self.now_ns < let_go_ns:
            self.send(0.0, 0.0, source)
            self.run(1 / hz)
        self.send(0.0, 0.0, source)
        self.run(1 / hz)
        self.hold(linear, angular, seconds, source, hz)

    def hold(
        self,
        linear: float,
        angular: float = 0.0,
        seconds: float = 1.0,
        source: str = "app",
        hz: float = 20.0,
    ) -> None:
        """Send the twist at `hz` for `seconds`, without a zero first."""
        for _ in range(round(seconds * hz)):
            self.send(linear, angular, source)
            self.run(1 / hz)

    def ask(
        self,
        key: str,
        asked: str | None = None,
        fmt: str = "",
        payload: bytes = b"",
        attachment: bytes = b"",
    ) -> list[Reply]:
        """Send a query and return the replies that came within two periods."""
        self._queries += 1
        name = key if asked is None else asked
        at_ns = self.now_ns
        if name == "srv/stop":
            # The real bus adds an arrival for each call of this service.
            stop = Arrival("stop", True, b"", "", at_ns, None, "", attachment=attachment)
            self.bus.arrivals.append(stop)
        query = Query(self._queries, key, name, fmt, payload, "", at_ns, attachment=attachment)
        self.bus.queries.append(query)
        self.run(2 / self.config.rate_hz)
        return self.bus.replies.get(query.ticket, [])

    def call(self, service: str, payload: bytes = b"") -> ServiceReply:
        """Call a service and return its answer.

        A `clear` or `activate` without a payload names the causes in `state`, as acsard's tools do.
        """
        if service in ("clear", "activate") and not payload:
            payload = naming(self.numbers)
        (reply,) = self.ask(f"srv/{service}", payload=payload)
        return msgspec.json.decode(reply.payload, type=ServiceReply)

    # observations

    @property
    def state(self) -> RobotState:
        message = self.loop.publication.current("state")
        assert isinstance(message, RobotState)
        return message

    @property
    def numbers(self) -> list[int]:
        """The numbers of the causes in `state`, the newest last."""
        return [cause.number for cause in self.state.causes]

    @property
    def newest(self) -> int:
        """The number of the newest cause; 0 without one."""
        return max(self.numbers, default=0)

    @property
    def odom(self) -> Odometry:
        message = self.loop.publication.current("odom")
        assert isinstance(message, Odometry)
        return message

    def lines(self) -> list[bytes]:
        """Return the lines that the MCU has received, oldest first, without empty lines."""
        return [line for _, line in self.mcu.heard if line != b"\r\n"]
