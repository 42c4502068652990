"""The interface of the simulator to the product. No other module here imports the product.

Everything that the simulator needs of the product is a method here, with plain data as arguments
and results.

Time is in ns of the robot's monotonic clock. `Product.see` is called after every control step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import repeat
from typing import Any

import msgspec
from msgspec.structs import replace

import acsard
from acsard.core.config.parsing import ConfigError, parse
from acsard.core.guard import Guard
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Query
from acsard.core.messages.encodings import encode as encode_message
from acsard.core.robot import Robot
from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.simulated_robot import WatchedMcu
from acsard.core.values import Estimate as Measured
from acsard.core.values import Heard, Instant, Latches, Received, Recording
from acsard.daemon.latch_file import (
    Keeper,
    LatchFileError,
    decode,
    encode,
    not_writable,
    unreadable,
    unwritable,
)
from acsard.daemon.pacing import Period
from acsard.recording.file import Steps, encode_steps, steps_of
from acsard.recording.recorded_steps import PlainStep
from acsard.recording.replay import Replay
from acsard.recording.state import freeze, thaw
from tests.scenarios.world import START, World
from tests.simulate.gyro_faults import FaultyGyro, GyroFaults
from tests.stepped import Outputs

START_NS = START.mono_ns
WALL_OFFSET_NS = START.wall_ns - START.mono_ns

HELD = 16
"""Samples of one key that wait for a step, as the real inbox holds them."""

BATCH = 200
"""Steps that a recording encodes together."""

FILE = 5 * BATCH
"""Steps of a file of the recording. The next file begins with the robot's state."""

Estimate = tuple[int, float, float, float, tuple[float, ...], tuple[float, ...]]
"""Time of the sample, x, y, yaw, the upper triangle of the covariance, and the wheel angles."""


NONE: Sequence[Estimate] = ()


class StepResult(msgspec.Struct, frozen=True, gc=False):
    """The externally visible results of one control step."""

    at_ns: int
    decided_ns: int
    """When the step began: a stall may lie between this and `at_ns`."""
    mode: str
    code: str
    reason: str
    source: str
    causes: frozenset[str]
    """The codes of all latched causes of a fault or a stop."""
    followed_ns: int | None
    """Arrival of the command that is followed, None if none is."""
    link: str
    lines: list[tuple[int, bytes]]
    """Lines that went to the board since the step before, each with its time."""
    estimates: Sequence[Estimate]
    events: Sequence[tuple[str, str, str]] = ()
    """Name, level and text of each line of the log."""
    latched: Sequence[tuple[int, str, tuple[str, str, str]]] = ()
    """Number and kind of each cause that holds the robot, with its code, part and client."""


def problems(config: dict[str, Any]) -> list[str]:
    """Return the problems of this configuration, in words; none if it is legal."""
    try:
        parse(b"", config)
    except ConfigError as error:
        return error.problems
    return []


def _causes(latches: Latches) -> frozenset[str]:
    return frozenset(cause.code for cause in latches.of("fault", "stop"))


def _plain(estimate: Measured) -> Estimate:
    pose, spread = estimate.pose, estimate.covariance
    return (
        estimate.at.mono_ns,
        pose.x,
        pose.y,
        pose.yaw,
        (spread.xx, spread.xy, spread.xyaw, spread.yy, spread.yyaw, spread.yawyaw),
        estimate.positions,
    )


class CrashError(Exception):
    """An exception that simulates a bug in the daemon."""


class Disk(Keeper):
    """The latch file, from which the next daemon starts."""

    trouble = ""

    def __init__(self) -> None:
        super().__init__(Latches())
        self.full = False
        self._running = True
        self._written = self.latches
        """The latches in the file."""
        self.behind = False
        """The disk was full when the daemon last wrote, so the file lacks the newest latches."""
        self._data = encode("acsar", self._written)

    def fill(self, full: bool) -> None:
        """Fill the disk, so that nothing can be written, or make space again.

        The daemon then writes its newest latches.
        """
        self.full = full
        if self._running:
            self.keep(self.latches)

    def keep(self, latches: Latches) -> None:
        self.latches = latches
        self.trouble = unwritable("FILE", "no space left on device") if self.full else ""
        self.behind = self.full and self._written != latches
        if not self.full:
            self._data, self._written = encode("acsar", latches), latches

    def damage(self, how: str) -> None:
        """Damage the file: `cut` it, fill it with `zeros`, or give it another `version`."""
        match how:
            case "cut":
                self._data = self._data[: len(self._data) * 2 // 3]
            case "zeros":
                self._data = bytes(len(self._data))
            case "version":
                self._data = self._data.replace(b'"format": 3', b'"format": 2')

    def end(self) -> None:
        """Note that the daemon has ended: it writes nothing any more."""
        self._running = False

    @property
    def is_stored(self) -> bool:
        return not self.full

    def read(self, now: Instant) -> Latches:
        """Return the latches that the next start of the daemon uses."""
        try:
            latches = decode("acsar", self._data)
        except LatchFileError as error:
            latches = unreadable("FILE", str(error), now)
        self._running, self.trouble = True, ""
        self.latches = self._written = latches
        if not self.full:
            self._data = encode("acsar", latches)  # the daemon tries out whether it can write
        if self.full:
            self.trouble = unwritable("FILE", "no space left on device")
            self.latches = not_writable(latches, "FILE", "no space left on device", now)
        self.behind = self.full
        return self.latches


class Tape:
    """Records the steps of one daemon as the black box does, and replays them."""

    def __init__(self, robot: Robot, guard: Guard) -> None:
        self.difference = ""
        """The first step whose replay has another result, and the outputs that differ."""
        self.status = Recording()
        self._steps: list[PlainStep] = []
        self._number = 0
        self._replay = Replay(*thaw(freeze(robot, guard.memory)))

    def begins(self, robot: Robot, guard: Guard) -> None: ...

    def step(self, step: PlainStep, robot: Robot, guard: Guard) -> None:
        self._steps.append(step)
        if len(self._steps) == BATCH:
            self.replay()
            if self._number % FILE == 0:
                self._replay.resume(*thaw(freeze(robot, guard.memory)))

    def died(self, now: Instant, heard: Heard) -> None: ...

    def replay(self) -> None:
        """Replay the steps that have not been replayed yet."""
        if not self._steps or self.difference:
            self._steps.clear()
            return
        data = msgspec.msgpack.encode(encode_steps(self._number, self._steps))
        for step in steps_of(msgspec.msgpack.decode(data, type=Steps)):
            self._replay.step(step)
        self._number += len(self._steps)
        self._steps.clear()
        comparison = self._replay.comparison
        if comparison.first is not None:
            what = ", ".join(comparison.first.what)
            self.difference = f"the step at {comparison.first.at.mono_ns / 1e9:.3f} s: {what}"
        elif not comparison.exact:
            self.difference = f"an estimate in the {BATCH} steps before step {self._number}"


class Product:
    """One robot with its computer and its board. Its daemon may end and start several times."""

    def __init__(self, config: dict[str, Any], see: Callable[[StepResult], None]) -> None:
        self._config, self._see = parse(b"", config), see
        first = self._config.mcu.wheels.letters[0].encode()
        self.reply_starts = first + b"p", first + b"n"
        """The first bytes of a reply with speeds."""
        self._faults: list[tuple[str, tuple[Any, ...]]] = []
        self._lasting = ExitStack()
        self._kept: dict[int, float] = {}
        """The set points of the motors that run away, by the place of their wheels."""
        self.disk = Disk()
        self.alive = True
        self.fed: Callable[[int, bytes], None] = lambda at_ns, data: None
        self.dropped = 0
        """Samples that the inbox had no room for, of this daemon."""
        self.drops: Callable[[str], None] = lambda key: None
        """Called with the key of each sample that the inbox drops: the oldest unread one of it."""
        self.echo = False
        self.gyro = GyroFaults()
        self._imperfect = FaultyGyro(self.gyro)
        self.unplugged_ns = self.plugged_ns = START_NS
        """When the board was last unplugged, and plugged in: a daemon that starts finds it so."""
        self._world = World(self._config, keeper=self.disk, gyro=self._imperfect)
        self._latches: Latches | None = None
        self._latched: list[tuple[int, str, tuple[str, str, str]]] = []
        self._tapes: list[Tape] | None = None
        self._began()

    def _began(self) -> None:
        world = self._world
        world.bus.wanted_keys = set()
        world.watch = self._watch
        self.dropped = 0
        if self._tapes is not None:
            self.record()
        feed = world.port.feed

        def noticed(received: Received) -> None:
            self.fed(received.at.mono_ns, received.data)
            feed(received)

        world.port.feed = noticed  # type: ignore[method-assign]

    def _watch(self, outputs: Outputs) -> None:
        world = self._world
        lines: list[tuple[int, bytes]] = []
        if world.port.sent:
            lines = list(world.port.sent)
            world.port.sent.clear()
            if self.echo:
                for _, line in lines:
                    world.port.feed(Received(world.instant, line))
        events: list[tuple[str, str, str]] = []
        if world.events:
            events = [(event.name, event.level, event.text) for event in world.events]
            world.events.clear()
        estimates = (
            [_plain(estimate) for estimate in outputs.estimates] if outputs.estimates else NONE
        )
        self._see(
            StepResult(
                world.now_ns,
                outputs.now.mono_ns,
                outputs.mode,
                outputs.code,
                outputs.reason,
                outputs.source,
                _causes(outputs.latches),
                outputs.command_ns,
                outputs.link,
                lines,
                estimates,
                events,
                self._latched_of(outputs.latches),
            )
        )

    def _latched_of(self, latches: Latches) -> Sequence[tuple[int, str, tuple[str, str, str]]]:
        if latches is not self._latches:
            self._latches = latches
            self._latched = [(c.number, c.kind, (c.code, c.part, c.by)) for c in latches.causes]
        return self._latched

    # the recording

    def record(self) -> None:
        """Record this daemon and each later one, and replay their steps."""
        loop = self._world.loop
        tape = Tape(loop.robot, loop._guard)
        loop._recorder = tape
        self._tapes = [*(self._tapes or []), tape]

    def replayed(self) -> str:
        """Return the first difference between the recorded steps and their replay, or ""."""
        tapes = self._tapes or []
        for tape in tapes:
            tape.replay()
        return next((tape.difference for tape in tapes if tape.difference), "")

    # time

    @property
    def now_ns(self) -> int:
        return self._world.now_ns

    @property
    def wall_ns(self) -> int:
        """The time of the robot's wall clock."""
        return self._world.instant.wall_ns

    def run_until(self, at_ns: int) -> None:
        """Advance to this time. If no daemon runs, only the board is simulated."""
        world = self._world
        if at_ns <= world.now_ns:
            return
        if self.alive:
            world.run((at_ns - world.now_ns) / 1e9)
        else:
            world.mcu.advance(at_ns)
        world.now_ns = max(world.now_ns, at_ns)

    # the bus

    def begin_run(self, number: int) -> None:
        """Give the daemon that has started this number, which its beats have."""
        self._world.loop.publication.intake._receiver._run = number

    def deliver(
        self,
        at_ns: int,
        key: str,
        payload: bytes,
        *,
        put: bool = True,
        encoding: str = "",
        stamp_ns: int | None = None,
        session: str = "",
        via: Any = "native",
        attachment: bytes = b"",
        boot_ns: int = 0,
    ) -> None:
        """Deliver a sample to the daemon's inbox. It arrived at `at_ns`, now or earlier.

        `boot_ns` is the same time by the clock of the beats.
        """
        world = self._world
        arrivals = world.bus.arrivals
        received = None if session else self.wall_ns
        arrival = Arrival(
            key, put, payload, encoding, at_ns, stamp_ns, session, via, attachment, received,
            boot_ns,
        )  # fmt: skip
        if key == "stop":
            arrivals.insert(0, arrival)
        else:
            arrivals.append(arrival)
            if len(arrivals) > HELD:
                same = [waiting for waiting in arrivals if waiting.key == key]
                if len(same) > HELD:
                    arrivals.remove(same[0])
                    world.bus.displaced.append(same[0])
                    self.dropped += 1
                    self.drops(key)
        if at_ns == world.now_ns and (world._listens or key == "stop"):
            world._step()

    def stop_unseen(self) -> None:
        """Deliver a stop without letting a step read it."""
        arrival = Arrival("stop", True, b"", "", self.now_ns, None, "", "native", b"", self.wall_ns)
        self._world.bus.arrivals.insert(0, arrival)

    def call_service(
        self, at_ns: int, service: str, ticket: int, payload: bytes, via: Any, attachment: bytes
    ) -> None:
        """Deliver a service call. As on the real bus, a sample on the key `stop` precedes a stop.

        `service` is a service name, or a ROS parameter service, which has "/" in its name.
        """
        key = service if "/" in service else f"srv/{service}"
        if service == "stop":
            self.deliver(at_ns, "stop", b"", via=via, attachment=attachment)
        query = Query(ticket, key, key, "", payload, "", at_ns, via, attachment)
        self._world.bus.queries.append(query)

    def replies(self) -> list[tuple[int, bytes]]:
        """Return the answers since the last call, each with the ticket of its query."""
        bus = self._world.bus
        if not bus.replies:
            return []
        payloads = [
            (ticket, reply.payload) for ticket, all_ in bus.replies.items() for reply in all_
        ]
        bus.replies.clear()
        bus.finished.clear()
        return payloads

    @property
    def shows_state(self) -> bool:
        """Whether the daemon runs and has made its first step, before which it has no `state`."""
        loop = self._world.loop
        return self.alive and loop.publication.current("state") is not None

    def state(self) -> dict[str, Any]:
        """Return the present `state`, as a client reads it."""
        state: dict[str, Any] = msgspec.json.decode(encode_message(self._world.state, "json"))
        return state

    # the board

    def board(self, faults: list[tuple[str, tuple[Any, ...]]]) -> None:
        """Set the faults of the board. They replace all earlier ones."""
        self._lasting.close()
        self._faults = faults
        mcu, bauds = self._world.mcu, [values[0] for name, values in faults if name == "wrong_baud"]
        for name, values in faults:
            if name == "endless":
                self._lasting.enter_context(mcu.switched(partial(replace, ending="")))
                continue
            if name == "constant_answers":
                self._lasting.callback(setattr, mcu, "_processing", mcu._processing)
                vars(mcu)["_processing"] = repeat(values[0])
                continue
            if name in ("half_duplex", "runaway", "set_points", "gain", "replies_twice"):
                continue
            # The daemon's TX is joined to its RX, so nothing of the board arrives.
            fault = "mute" if name == "echo" else name
            self._lasting.enter_context(mcu.fault(fault, *values))
        self._garble(mcu, bauds[-1] if bauds else self._config.mcu.baud_rate)
        self.echo = any(name == "echo" for name, _ in faults)
        for name, values in faults:
            if name == "half_duplex":
                self._half_duplex(mcu, *values)
            if name == "set_points":
                self._report_set_points(mcu)
            if name == "replies_twice":
                self._reply_twice(mcu)
            if name == "gain":
                drives = (values[0],) * len(mcu.letters)
                self._lasting.enter_context(mcu.switched(partial(replace, drives=drives)))
        self._run_away(mcu, [values[0] for name, values in faults if name == "runaway"])

    def _garble(self, mcu: FakeMcu, baud_rate: int) -> None:
        """Connect this board by a serial line on which the board uses another baud rate."""
        ours, kind = self._config.mcu.baud_rate, type(mcu)
        vars(mcu).pop("receive", None)
        vars(mcu).pop("advance", None)
        if baud_rate == ours:
            return

        def receive(at_ns: int, data: bytes) -> None:
            kind.receive(mcu, at_ns, garbled(data, ours, baud_rate))

        def advance(at_ns: int) -> bytes:
            return garbled(kind.advance(mcu, at_ns), baud_rate, ours)

        vars(mcu).update(receive=receive, advance=advance)

    def _half_duplex(self, mcu: FakeMcu, load: float) -> None:
        """Send each line of the daemon back to it, beside the replies, and load the motors."""
        receive = mcu.receive

        def both(at_ns: int, data: bytes) -> None:
            receive(at_ns, data)
            if data.strip():
                mcu._schedule(mcu._in_free_ns, "sent", data)

        vars(mcu)["receive"] = both
        mcu.vehicle.load = load
        self._lasting.callback(vars(mcu).pop, "receive", None)
        self._lasting.callback(setattr, mcu.vehicle, "load", 0.0)

    def _run_away(self, mcu: FakeMcu, motors: list[int]) -> None:
        """Let these motors keep their set points, whatever the board commands."""
        vehicle, before = mcu.vehicle, self._kept
        places = [place for motor in motors for place in mcu._wiring[motor][0]]
        kept = {place: before.get(place) or vehicle.set_points[place] for place in places}
        self._kept = kept

        def advance(dt: float, push: float | None = None) -> None:
            for place, speed in kept.items():
                # A motor at rest runs away with its next command.
                kept[place] = speed = speed or vehicle.set_points[place]
                vehicle.set_points[place] = speed
            type(vehicle).advance(vehicle, dt, push)

        vars(vehicle).pop("advance", None)
        if kept:
            vars(vehicle)["advance"] = advance

    def _report_set_points(self, mcu: FakeMcu) -> None:
        """Let the board report its set points as speeds, as one without encoders does."""

        def speeds(now_ns: int) -> list[float]:
            return [mcu.vehicle.set_points[wheels[0]] * forward for wheels, forward in mcu._wiring]

        vars(mcu)["_speeds"] = speeds
        self._lasting.callback(vars(mcu).pop, "_speeds", None)

    def _reply_twice(self, mcu: FakeMcu) -> None:
        """Send each reply with speeds twice, as a faulty repeater does."""
        send = type(mcu)._send

        def twice(at_ns: int, data: bytes) -> None:
            send(mcu, at_ns, data)
            if data.startswith(self.reply_starts):
                send(mcu, at_ns, data)

        vars(mcu)["_send"] = twice
        self._lasting.callback(vars(mcu).pop, "_send", None)

    def flip(self, place: int, mask: int, behind: int) -> None:
        """Invert bits of one character in a reply with speeds.

        `behind` is the number of replies that stay intact before the damaged one.
        """
        mcu = self._world.mcu
        send, left = type(mcu)._send, behind

        def flipped(at_ns: int, data: bytes) -> None:
            nonlocal left
            speeds = data.startswith(self.reply_starts)
            left -= speeds
            if speeds and left < 0:
                vars(mcu).pop("_send", None)
                data = data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :]
            send(mcu, at_ns, data)

        vars(mcu)["_send"] = flipped

    def reset(self, deaf_ns: int) -> None:
        self._world.mcu.reset(self.now_ns, deaf_ns)

    def unplug(self) -> None:
        self.unplugged_ns = self.now_ns
        self._world.port.unplug()
        self._world.port.trouble = "the device is gone"

    def plug(self, new: bool = False) -> None:
        """Plug the board in again, or another one."""
        world = self._world
        if new:
            self._lasting.close()
            pose = world.mcu.vehicle.pose
            other = World(self._config, plugged=False).mcu
            other._now_ns = other._in_free_ns = other._out_free_ns = self.now_ns
            other._replied_ns = other._fed_ns = self.now_ns
            other.reset(self.now_ns, 0)
            other.vehicle.pose = pose
            if isinstance(other, WatchedMcu):
                other._look_ns = self.now_ns + 10_000_000
                other._see = self._world._see
            world.mcu = other
            self.board(self._faults)
        else:
            world.mcu.advance(self.now_ns)
        world.port.trouble = ""
        world.port.plug(world.mcu)
        self.plugged_ns = self.now_ns

    def truth(self) -> tuple[int, float, float, float, float]:
        """Return the board's time, the true pose (m, m, rad) and the fastest wheel (rad/s)."""
        mcu = self._world.mcu
        vehicle = mcu.vehicle
        pose, fastest = vehicle.pose, max(map(abs, vehicle.speeds))
        return mcu._now_ns, pose.x, pose.y, pose.yaw, fastest

    def wheels(self) -> list[float]:
        """Return the true speeds of the wheels, rad/s, in the order of the configuration."""
        return list(self._world.mcu.vehicle.speeds)

    def angles(self) -> list[float]:
        """Return the true angles of the wheels, rad, in the same order."""
        return list(self._world.mcu.vehicle.angles)

    @property
    def plugged(self) -> bool:
        return self._world.port.mcu is not None

    # the computer

    def stall(self, seconds: float) -> None:
        if self.alive:
            self._world.stall(seconds)

    def stall_in_step(self, seconds: float) -> None:
        self._world.stall_in_step(seconds)

    def block(self, blocked: bool) -> None:
        self._world.port.blocked = blocked

    def tear(self, count: int) -> None:
        """Let the kernel accept only this many bytes of the next line."""
        self._world.port.takes = count

    def step_wall(self, seconds: float) -> None:
        self._world.wall_offset_ns += int(seconds * 1e9)

    def end(self, way: str) -> None:
        """End the daemon: by SIGTERM (`term`), a bug in a step (`crash ...`), or a `kill`."""
        world = self._world
        if way.startswith("crash"):
            self._crash(way)
        if way == "term":
            world.loop.shutting_down = True
            for _ in range(60):
                self.run_until(world.now_ns + 10_000_000)
                if world.loop.at_rest:
                    break
            world.loop.finish(world.instant)
        if world.port.mcu is not None:
            # The unit sends zeros when the process has ended.
            stop = world.loop.robot.link_setup.codec.stop
            world.port.mcu.receive(world.now_ns + 50_000_000, b"\r\n" + stop)
        self.disk.end()
        self.alive = False

    def _crash(self, way: str) -> None:
        """Run a step in which the robot raises an exception, or the port after the robot's step."""
        loop, port = self._world.loop, self._world.port

        def broken(*_: Any) -> Any:
            raise CrashError

        if way == "crash before the robot":
            vars(loop.robot)["hear"] = broken
        else:
            vars(port)["offer"] = broken
        with suppress(CrashError):
            loop.step(self._world.instant, Period(1, self.now_ns))
        loop.finish(self._world.instant)

    def start(self) -> None:
        """Start the daemon again, on the same board."""
        old = self._world
        latches = self.disk.read(old.instant)
        world = World(
            self._config, plugged=False, latches=latches, keeper=self.disk, gyro=self._imperfect
        )
        world.now_ns = world.next_period_ns = old.now_ns
        world.wall_offset_ns = old.wall_offset_ns
        world.mcu = old.mcu
        if old.port.mcu is not None:
            world.port.plug(world.mcu)
        self.plugged_ns = self.now_ns
        world.port.blocked = old.port.blocked
        self._world, self.alive = world, True
        self._began()

    def largest(self) -> tuple[int, str, int, int]:
        """Return the length and the type of the largest container that the daemon holds.

        The last two numbers are the lengths of its longest text and its longest byte buffer.
        """
        visited: set[int] = set()
        todo: deque[object] = deque([self._world.loop])
        best, text, buffer = (0, ""), 0, 0
        while todo:
            item = todo.pop()
            if id(item) in visited:
                continue
            visited.add(id(item))
            if isinstance(item, Arrival):
                continue  # only the messages of the last step are kept, as they came
            if isinstance(item, str):
                text = max(text, len(item))
            elif isinstance(item, bytes | bytearray):
                buffer = max(buffer, len(item))
            elif isinstance(item, dict):
                best = max(best, (len(item), "dict"))
                todo.extend(item.values())
            elif isinstance(item, list | tuple | set | deque):
                best = max(best, (len(item), type(item).__name__))
                todo.extend(item)
            elif type(item).__module__.startswith(acsard.__name__):
                slots = getattr(type(item), "__struct_fields__", ())
                todo.extend(getattr(item, name) for name in slots)
                todo.extend(getattr(item, "__dict__", {}).values())
        return *best, text, buffer
