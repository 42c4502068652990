"""The checked link with the whole daemon: new and old firmware, noise, losses, resets, counts.

pytest -m soak -s tests/scenarios/test_link_check.py
"""

from __future__ import annotations

import itertools
import math
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import repeat

import pytest
from msgspec import json
from msgspec.structs import replace

from acsard.core.config.settings import (
    Config,
    ControlConfig,
    LimitsConfig,
    McuConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.link.checked_line import unseal
from acsard.core.link.codec import Codec, FrameError
from acsard.core.link.lines import LineReader
from acsard.core.messages.schema import DiagnosticArray
from acsard.core.simulator import protocol
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S, Instant, Received
from tests.each import each
from tests.scenarios.world import VirtualPort, World
from tests.stepped import Outputs
from tests.unit.core.link.test_damage import drive as replies_of_a_drive

MS = 1_000_000
ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"


def config(check: str = "on", counts: int = 0, **mcu: object) -> Config:
    return Config(mcu=McuConfig(link_check=check, encoder_counts=counts, **mcu))  # type: ignore[arg-type]


def started(made: Config) -> World:
    world = World(made)
    world.run(0.3)
    return world


def moving(lines: list[bytes]) -> list[bytes]:
    return [line for line in lines if line.strip() and not line.startswith((ZERO, b"?"))]


def check_of(world: World) -> str:
    """Return the current check of the link, as the diagnostics report it."""
    message = world.loop.publication.current("diagnostics")
    assert isinstance(message, DiagnosticArray)
    (link,) = [status for status in message.status if status.name == "acsard: serial link"]
    return {pair.key: pair.value for pair in link.values}["check"]


def stopped(world: World) -> bool:
    return world.mcu.vehicle.set_points == [0.0] * 4


def texts(world: World, name: str) -> list[str]:
    return [event.text for event in world.events if event.name == name]


def off_by(world: World) -> float:
    """Return the distance between pose and simulated robot, as a share of the path length."""
    at, true = world.state, world.mcu.vehicle.pose
    return math.hypot(at.x - true.x, at.y - true.y) / math.hypot(true.x, true.y)


# the firmware at the other end


def test_a_new_mcu_is_driven_with_checked_lines() -> None:
    world = started(config())
    world.drive(0.5, seconds=2.0)
    assert world.state.mode == "driving"
    assert check_of(world) == "checked"
    assert texts(world, "link_check") == []
    lines = moving(world.lines())
    assert len(lines) > 150
    assert all(protocol.reference(line) and b"#" in line for line in lines)
    world.run(1.5)
    assert stopped(world)
    assert world.state.x == pytest.approx(world.mcu.vehicle.pose.x, abs=0.005)
    assert set(world.state.counters) <= {"lines", "lines_sent", "commands"}


def test_a_new_mcu_is_driven_with_samples_when_counts_are_configured() -> None:
    world = started(config(counts=3200))
    world.drive(0.5, seconds=1.0)
    assert check_of(world) == "checked with samples"
    assert all(b"S*" in line for line in moving(world.lines()))


def test_an_mcu_without_samples_is_driven_checked_and_the_log_says_what_is_missing() -> None:
    world = World(config(counts=3200))
    with world.mcu.no_sample():
        world.run(0.3)
        world.drive(0.5, seconds=1.0)
        assert check_of(world) == "checked"
        (text,) = texts(world, "link_check")
        assert "does not send encoder counts" in text
    assert world.state.mode == "driving"


OLD_FIRMWARE = pytest.mark.parametrize(
    ("firmware", "comma"), [("no_check", False), ("plain_only", False), ("comma_latched", True)]
)


@pytest.mark.variations(3)
@OLD_FIRMWARE
@pytest.mark.parametrize("counts", [0, 3200])
def test_old_firmware_is_driven_with_plain_lines_and_without_faults(
    firmware: str, comma: bool, counts: int
) -> None:
    world = World(config("off", counts=counts, trailing_comma=comma))
    with getattr(world.mcu, firmware)():
        world.run(0.3)
        world.drive(0.5, 0.2, seconds=2.0)
        assert world.state.mode == "driving"
        assert check_of(world) == "plain"
        assert not any(b"#" in line for line in moving(world.lines()))
        world.run(1.5)
        assert stopped(world)
        assert off_by(world) < 0.01
    assert not [name for name in world.state.counters if name.startswith("line_")]


@pytest.mark.parametrize("boots", [False, True])
@OLD_FIRMWARE
def test_old_firmware_is_never_driven_on_a_checked_link_and_the_reason_names_the_setting(
    firmware: str, comma: bool, boots: bool
) -> None:
    world = World(config("on", trailing_comma=comma))
    with getattr(world.mcu, firmware)():
        if boots:
            world.mcu.reset(world.now_ns)
        world.drive(0.5, seconds=9.0)
        assert not moving(world.lines())
        assert (world.state.mode, world.state.link) == ("waiting", "booting")
        silent = boots and firmware == "plain_only"  # all that it has heard is checked
        assert world.state.code == ("received_nothing" if silent else "no_checksum")
        assert "mcu.link_check" in world.state.reason
        assert len(texts(world, "link_check")) == (not silent)
    world.run(0.5)  # a person has installed new firmware
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


def test_an_mcu_that_boots_slowly_is_asked_when_it_answers() -> None:
    world = World(config("on"))
    world.mcu.reset(world.now_ns)
    world.run(2.4)
    assert world.state.link == "up"
    assert check_of(world) == "checked"


def test_a_slow_wire_carries_checked_lines_with_samples() -> None:
    world = World(
        Config(
            mcu=McuConfig(baud_rate=9600, link_check="on", encoder_counts=3200),
            control=ControlConfig(rate="auto"),
        )
    )
    assert world.config.rate_hz == 12
    world.run(2.0)
    world.drive(0.5, seconds=3.0, hz=10.0)
    world.send(0.0)
    world.run(1.5)
    assert off_by(world) < 0.001
    assert world.state.counters.get("lines_superseded", 0) == 0


# resets


@pytest.mark.variations(3)
@pytest.mark.parametrize("deaf_ms", [20, pytest.param(60, marks=pytest.mark.slow), 500, 2000])
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
def test_a_reset_mcu_does_not_move_before_commanders_are_neutral(
    check: str, counts: int, deaf_ms: int
) -> None:
    world = started(config(check, counts))
    world.drive(0.5, seconds=1.0)
    before = world.state.x
    world.mcu.reset(world.now_ns, deaf_ms * MS)
    world.hold(0.5, seconds=deaf_ms / 1000 + 0.02, hz=100.0)
    count = len(world.lines())
    world.hold(0.5, seconds=3.0)
    assert not moving(world.lines()[count + 1 :])
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"
    assert stopped(world)
    assert world.state.x - before < 0.08
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


def test_a_reset_is_found_by_the_clock_when_its_announcement_is_lost() -> None:
    world = started(config("on", 3200))
    world.drive(0.5, seconds=1.0)
    x = world.state.x
    world.mcu.reset(world.now_ns, 30 * MS)
    world.mcu._events.clear()  # neither noise nor identity gets through
    world.hold(0.5, seconds=2.0)
    assert any("its clock went back" in text for text in texts(world, "mcu_restarted"))
    assert world.state.mode == "ready"
    assert stopped(world)
    assert world.state.x - x < 0.05


def test_another_mcu_on_the_port_without_the_check_does_not_move() -> None:
    world = started(config(counts=3200))
    world.drive(0.5, seconds=1.0)
    x = world.state.x
    world.port.unplug()
    world.run(0.5)
    world.mcu = FakeMcu(world.config, world.now_ns)
    world.port.plug(world.mcu)
    with world.mcu.no_check():
        world.hold(0.5, seconds=1.0)
        assert not moving(world.lines())
        assert world.state.code == "no_checksum"
    assert world.state.x == pytest.approx(x, abs=0.02)


# damage


def test_a_burst_of_damaged_replies_stops_and_goes_on() -> None:
    world = started(config("on", 3200))
    world.drive(0.5, seconds=1.0)
    sent = len(world.port.sent)
    with world.mcu.noise(b"~"):
        world.hold(0.5, seconds=0.08, hz=100.0)
        assert world.state.link == "stale"
        assert world.state.code == "replies_damaged"
        world.hold(0.5, seconds=0.3)
        late = [line for _, line in list(world.port.sent)[sent + 8 :]]
        assert late
        assert not moving(late)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "driving"  # a short gap only ramps up again from rest
    assert check_of(world) == "checked with samples"
    assert world.state.counters["line_crc_error"] >= 5
    world.send(0.0)
    world.run(1.0)
    assert off_by(world) < 0.001


@pytest.mark.slow
def test_noise_never_talks_an_mcu_out_of_the_check() -> None:
    world = started(config())
    world.drive(0.5, seconds=1.0)
    for _ in range(5):
        with world.mcu.no_check():
            world.hold(0.5, seconds=2.0)
            assert stopped(world)
            assert world.state.code == "no_checksum"
        world.run(0.3)
        assert check_of(world) == "checked"


@pytest.mark.variations(3)
@pytest.mark.parametrize("every", [2, 3, 7])
def test_bit_errors_both_ways_change_no_speed(every: int) -> None:
    world = started(config("on", 3200))
    world.drive(0.4, seconds=0.5)
    set_points: set[float] = set()
    with world.mcu.bit_errors(every):
        for _ in range(200):
            world.hold(0.4, seconds=0.01, hz=100.0)
            set_points.update(world.mcu.vehicle.set_points)
            assert all(abs(speed) < 8.5 for speed in world.state.wheels)
    assert max(set_points) <= 8.0
    assert min(set_points) >= 0.0


def flips(line: bytes) -> Iterator[bytes]:
    for place in range(len(line)):
        for bit in range(8):
            yield b"%b%c%b" % (line[:place], line[place] ^ 1 << bit, line[place + 1 :])


def accepted_by_the_mcu(data: bytes, understand: object = protocol.reference) -> list[object]:
    """Return the commands that an MCU accepts from these bytes, if it splits them at line feeds.

    `understand` decodes one line.
    """
    assert callable(understand)
    commands = [understand(piece + b"\n") for piece in data.split(b"\n")[:-1]]
    return [command.values for command in commands if command is not None]


def accepted_by_the_host(data: bytes, codec: Codec, checked: bool) -> list[object]:
    speeds: list[object] = []
    for line, _ in LineReader().feed(data):
        try:
            speeds.append(codec.decode(unseal(line).plain if checked else line))
        except FrameError:
            continue
    return speeds


@pytest.mark.parametrize(
    "count",
    [10_000, pytest.param(1_000_000, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])],
)
def test_no_single_bit_error_changes_a_value_on_a_checked_link(count: int) -> None:
    codec, tried, wrong = Codec(WheelMap()), Counter[str](), Counter[str]()
    for number, plain in enumerate(itertools.cycle(replies_of_a_drive(random.Random(7), 5000))):
        if number * 8 * 41 >= count:
            break
        sequence = b"%02X" % (number % 256)
        sample = [number * 10, *(number * n for n in (3, 5, 7, 9))] if number % 2 else []
        text = plain[:-2]
        reply = text + protocol.suffix(text, sequence, sample) + b"\r\n"
        command = text + protocol.suffix(text, sequence, ()) + b"\r\n"
        reply_speeds, reference = codec.decode(text), protocol.reference(plain)
        assert reference is not None
        # There is one line end more, so that no damage reaches the next line.
        for data in flips(reply):
            tried["reply"] += 1
            results = accepted_by_the_host(data + b"\n", codec, checked=True)
            wrong["reply"] += any(speeds != reply_speeds for speeds in results)
        for data in flips(command):
            tried["command"] += 1
            results = accepted_by_the_mcu(data + b"\n")
            wrong["command"] += any(values != reference.values for values in results)
        for data in flips(plain) if number % 8 == 0 else ():
            tried["plain reply"] += 1
            results = accepted_by_the_host(data + b"\n", codec, checked=False)
            wrong["plain reply"] += any(speeds != reply_speeds for speeds in results)
            tried["plain command"] += 1
            results = accepted_by_the_mcu(data + b"\n", protocol.plain_only)
            wrong["plain command"] += any(values != reference.values for values in results)
    print()
    for name, number in tried.items():
        print(f"  {name:<13} {number:8} bit errors, {wrong[name] / number:7.3%} a wrong value")
    assert tried["command"] >= count <= tried["reply"]
    assert wrong["reply"] == wrong["command"] == 0
    assert 0.17 < wrong["plain reply"] / tried["plain reply"] < 0.25


# counts


def lossy_drive(check: str, counts: int) -> World:
    """Drive along curves while 20 % of the lines are lost in each direction. Return the world."""
    world = started(config(check, counts))
    with world.mcu.lost_replies(every=5), world.mcu.lost_commands(every=5):
        for turn in (0.0, 0.6, -0.6, 0.3, 0.0):
            world.drive(0.5, turn, seconds=4.0)
        world.send(0.0)
        world.run(1.5)
    assert "fault" not in {event.name for event in world.events}
    assert world.mcu.vehicle.pose.x > 5.0
    return world


@pytest.mark.slow
def test_with_counts_lost_lines_lose_no_distance() -> None:
    by_speeds, by_counts = off_by(lossy_drive("off", 0)), off_by(lossy_drive("on", 3200))
    print(f"\n  20 % lost: {by_speeds:.4%} off by speeds, {by_counts:.4%} by counts")
    assert by_counts < 0.001


class LatePort(VirtualPort):
    """A port whose bytes the daemon reads in batches and up to 60 ms late, as on a busy host."""

    world: World
    dice = random.Random(5)
    ready_ns = 0
    held: list[bytes]

    def feed(self, received: Received) -> None:
        self.held.append(received.data)

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        now = self.world.instant
        if now.mono_ns < self.ready_ns or not self.held:
            return ()
        chunk = Received(now, b"".join(self.held))
        self.held.clear()
        self.ready_ns = now.mono_ns + self.dice.choice((0, 3, 20, 60)) * MS
        return (chunk,)


def jittery_drive(check: str, counts: int) -> World:
    world = World(config(check, counts))
    port = LatePort(*world.port._opening)
    port.world, port.held = world, []
    port.plug(world.mcu)
    world.port = world.loop._port = port
    world.run(0.5)
    for turn in (0.8, -0.8, 1.5, -1.5, 0.4):
        world.drive(0.5, turn, seconds=3.0)
    world.send(0.0)
    world.run(1.5)
    assert "fault" not in {event.name for event in world.events}
    return world


@pytest.mark.slow
def test_with_counts_late_reads_of_the_host_do_not_bend_the_pose() -> None:
    by_speeds, by_counts = off_by(jittery_drive("off", 0)), off_by(jittery_drive("on", 3200))
    print(f"\n  late reads: {by_speeds:.4%} off by speeds, {by_counts:.4%} by counts")
    assert by_counts < min(0.001, by_speeds)


@pytest.mark.slow
def test_counts_and_clock_wrap_in_a_long_drive_without_a_jump_of_the_pose() -> None:
    fine = replace(config("on", 40_000), sim=SimConfig(encoder_counts=40_000))
    world = World(fine)
    world.mcu._on_ns -= 60 * NS_PER_S  # run for a minute: the clock wraps in 5 s
    world.run(0.3)
    last = (0.0, 0.0)
    for _ in range(15):
        world.drive(0.9, 0.9, seconds=1.0)
        here = (world.state.x, world.state.y)
        assert math.dist(here, last) < 1.3
        last = here
    world.send(0.0)
    world.run(1.5)
    true, state = world.mcu.vehicle.pose, world.state
    assert world.mcu._counted[0] > 20 * 65536
    assert math.dist((state.x, state.y), (true.x, true.y)) < 0.001
    assert math.remainder(state.yaw - true.yaw, math.tau) == pytest.approx(0.0, abs=0.001)
    assert world.state.counters.get("line_count_leap", 0) == 0


@pytest.mark.slow
def test_when_samples_stop_the_speeds_go_on_without_a_jump() -> None:
    world = started(config("on", 3200))
    for stop in (False, True, False):
        world.drive(0.5, seconds=1.0)
        x = world.state.x
        if stop:
            with world.mcu.no_sample():
                world.hold(0.5, seconds=0.3)
                assert check_of(world) == "checked"
                assert world.state.x == pytest.approx(x + 0.15, abs=0.02)
                world.hold(0.5, seconds=1.0)
    assert world.state.mode == "driving"
    world.send(0.0)
    world.run(1.0)
    assert off_by(world) < 0.01


@pytest.mark.slow
def test_a_stall_of_the_host_loses_no_distance_with_counts() -> None:
    world = started(config("on", 3200))
    world.drive(0.5, seconds=1.0)
    world.send(0.5)
    world.stall(0.2)
    world.hold(0.5, seconds=0.5)
    world.send(0.0)
    world.run(1.5)
    assert off_by(world) < 0.001


@pytest.mark.variations(3)
@pytest.mark.parametrize("motor", range(4))
def test_with_counts_a_dead_encoder_is_left_out_and_named(motor: int) -> None:
    world = started(config("on", 3200))
    world.drive(0.5, seconds=1.0)
    with world.mcu.stuck_encoder(motor):
        world.hold(0.5, seconds=1.5)
        assert world.state.mode == "driving"
        assert "wheel is blocked, or has no power" in world.state.wheel_fault


def test_one_impossible_line_costs_no_distance_with_counts() -> None:
    world = started(config("on", 3200))
    world.drive(0.5, seconds=1.0)
    with world.mcu.bias(1, 5.0):
        world.hold(0.5, seconds=0.011, hz=100.0)
    world.hold(0.5, seconds=1.0)
    world.send(0.0)
    world.run(1.0)
    assert world.state.counters["line_implausible"] >= 1
    assert world.state.mode == "ready"
    assert off_by(world) < 0.04  # that encoder did count too much


# anything

TROUBLE = ("mute", "noise", "partial_line", "slow_reply", "no_check", "no_sample", "lost_replies",
           "lost_commands", "bit_errors", "reset", "replug", "stall", "blocked")  # fmt: skip


def trouble(world: World, dice: random.Random) -> None:
    """Cause one random fault for a random time, while a commander sends speeds."""
    name, seconds = dice.choice(TROUBLE), dice.choice((0.03, 0.12, 0.4, 1.3))
    match name:
        case "reset":
            world.mcu.reset(world.now_ns, int(seconds * NS_PER_S))
        case "replug":
            world.port.unplug()
            world.hold(0.5, 0.3, seconds=seconds)
            world.mcu = FakeMcu(world.config, world.now_ns)
            world.port.plug(world.mcu)
        case "stall":
            world.stall(seconds)
        case "blocked":
            world.port.blocked = True
            world.hold(0.5, 0.3, seconds=seconds)
            world.port.blocked = False
        case _:
            with getattr(world.mcu, name)():
                world.hold(0.5, 0.3, seconds=seconds, hz=50.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stories", [2, pytest.param(1000, marks=[pytest.mark.soak, pytest.mark.timeout(3600)])]
)
def test_whatever_happens_no_unchecked_line_moves_a_wheel_and_the_pose_never_jumps(
    stories: int,
) -> None:
    for seed in range(stories):
        dice = random.Random(seed)
        world = started(config("on", 3200))
        last = [0.0, 0.0]

        def watch(outputs: Outputs, world: World = world, last: list[float] = last) -> None:
            line = outputs.line
            if line is not None and not line.startswith((ZERO, b"?")):
                assert outputs.linked
                assert protocol.reference(line)
                assert b"#" in line
            for estimate in outputs.estimates:
                here = [estimate.pose.x, estimate.pose.y]
                # the longest time that counts bridge, at 0.6 m/s, and the distance that the motors
                # run on
                assert math.dist(here, last) < 0.6
                last[:] = here

        world.watch = watch
        for _ in range(6):
            world.drive(0.5, 0.3, seconds=0.5)
            trouble(world, dice)
            world.hold(0.5, 0.3, seconds=0.4)
        world.run(3.0)
        assert stopped(world)
        assert world.state.link == "up", seed
        assert "fault" not in {event.name for event in world.events}, (seed, world.events)


class Echo(FakeMcu):
    """A port without a microcontroller, which returns all bytes after 5 ms and `extra_delay_ns`."""

    def receive(self, now_ns: int, data: bytes) -> None:
        self._schedule(now_ns + 5 * MS + self.extra_delay_ns, "sent", data)


@pytest.mark.variations(3)
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
@pytest.mark.parametrize(
    ("delay_ms", "latency_ms"),
    [pytest.param(0, 0, id="prompt"), pytest.param(0, 16, id="adapter"),
     pytest.param(30, 0, id="radio"), pytest.param(60, 0, id="slow radio")],
)  # fmt: skip
def test_a_serial_line_that_echoes_is_never_driven(
    check: str, counts: int, delay_ms: int, latency_ms: int
) -> None:
    world = World(config(check, counts), plugged=False)
    echo = Echo(world.config, world.now_ns)
    echo.extra_delay_ns, echo.latency_ns = delay_ms * MS, latency_ms * MS
    world.port.plug(echo)
    world.run(0.3)
    world.drive(0.5, seconds=5.0)
    assert world.state.link == "booting"
    assert world.state.code == "echo"
    assert moving([line for _, line in world.port.sent]) == []
    (event,) = [event for event in world.events if event.name == "link_check"]
    assert (event.level, event.text) == ("error", world.state.reason)
    world.port.unplug()
    world.run(0.1)
    world.port.plug(FakeMcu(world.config, world.now_ns))
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


class HalfDuplex(FakeMcu):
    """A board behind an adapter that also returns every line of the daemon to the daemon."""

    def receive(self, now_ns: int, data: bytes) -> None:
        super().receive(now_ns, data)
        self._schedule(self._in_free_ns, "sent", data)


@pytest.mark.parametrize(
    ("period", "latency_ms"),
    [pytest.param(0.0, 0, id="answers"), pytest.param(0.0, 16, id="answers by an adapter"),
     pytest.param(0.1, 0, id="reports at 10 Hz"), pytest.param(0.01, 0, id="reports at 100 Hz"),
     pytest.param(0.1, 16, id="reports at 10 Hz by an adapter")],
)  # fmt: skip
def test_an_echo_beside_a_board_is_never_driven(period: float, latency_ms: int) -> None:
    world = World(Config(mcu=McuConfig(reply_period=period)), plugged=False)
    board = HalfDuplex(world.config, world.now_ns)
    board.latency_ns = latency_ms * MS
    world.port.plug(board)
    with board.free_running(period) if period else nullcontext():
        world.run(0.5)
        world.drive(0.5, seconds=2.0)
        assert (world.state.link, world.state.code) == ("booting", "echo")
        assert moving([line for _, line in world.port.sent]) == []


@pytest.mark.slow
@each("lag", [0.01, 0.02, 0.03, 0.05])
@each("deceleration", [0.6, 1.0, 3.0])
def test_an_ideal_board_whose_motors_lag_by_whole_periods_keeps_its_link(
    lag: float, deceleration: float
) -> None:
    limits = replace(
        LimitsConfig(), linear_deceleration=deceleration, linear_stop_deceleration=deceleration
    )
    sim = SimConfig(motor_time_constant=lag, encoder_counts=1_000_000)
    world = World(Config(limits=limits, sim=sim))
    world.mcu._processing = repeat(1.3)  # type: ignore[assignment]
    world.run(0.3)
    for speed in (0.8, -0.4):
        # A command moves the times of the lines, so only the ramp down without one is steady.
        world.drive(speed, seconds=1.0)
        world.run(2.0)
    assert world.state.link == "up"
    assert "line_echo" not in world.state.counters


@pytest.mark.parametrize("kind", [Echo, HalfDuplex])
@pytest.mark.parametrize("acceleration", [1.0, 100.0])
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
def test_an_echo_that_begins_during_a_drive_ends_the_link_when_the_speed_changes(
    check: str, counts: int, acceleration: float, kind: type[FakeMcu]
) -> None:
    limits = replace(LimitsConfig(), linear_acceleration=acceleration)
    world = World(replace(config(check, counts), limits=limits))
    world.run(0.5)
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"
    world.mcu.__class__ = kind  # TX now touches RX
    world.drive(-0.5, seconds=1.2)
    assert world.state.link != "up"
    assert world.state.code == "echo"
    sent = len(world.port.sent)
    world.drive(0.5, seconds=10.0)
    assert world.state.code == "echo"
    assert moving([line for _, line in list(world.port.sent)[sent:]]) == []


@pytest.mark.parametrize("kind", [Echo, HalfDuplex])
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
def test_an_echo_that_begins_during_a_steady_drive_ends_the_link(
    check: str, counts: int, kind: type[FakeMcu]
) -> None:
    world = World(config(check, counts))
    world.run(0.5)
    world.drive(0.3, seconds=3.0)
    world.mcu.__class__ = kind  # TX now touches RX
    world.hold(0.3, seconds=1.5)
    assert (world.state.link, world.state.code) == ("stale", "echo")
    assert moving([world.port.sent[-1][1]]) == []


@pytest.mark.slow
@pytest.mark.parametrize("speeds", [4, pytest.param(40, marks=pytest.mark.nightly)])
@each("period", [0.0, 0.05])
@each(
    ("lag", "counts"),
    [(0.002, 3200), (0.002, 1_000_000), (0.05, 3200), (0.05, 1_000_000), (0.3, 3200),
     (0.3, 1_000_000)],
)  # fmt: skip
def test_a_board_whose_motors_lag_by_2_ms_keeps_its_link(
    lag: float, counts: int, period: float, speeds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.core.motion.sanity.MAX_WHEEL_ACCELERATION", 1e6)
    plain = Config(
        sim=SimConfig(motor_time_constant=lag, encoder_counts=counts),
        mcu=McuConfig(reply_period=period),
    )
    dice = random.Random(3)
    for acceleration in (1.0, 100.0):
        rates = {
            f"{axis}_{kind}": acceleration * (3 if "stop" in kind else 1)
            for axis in ("linear", "angular")
            for kind in ("acceleration", "deceleration", "stop_deceleration")
        }
        limits = replace(LimitsConfig(), angular_speed=1.0, **rates)
        world = World(replace(plain, limits=limits))
        with world.mcu.free_running(period) if period else nullcontext():
            world.mcu.unpadded_replies, world.mcu.ending = False, "\r\n"
            world.run(0.5)
            world.drive(0.3, seconds=0.5)
            for _ in range(speeds):
                world.hold(round(dice.uniform(-0.9, 0.9), 1), seconds=dice.uniform(0.2, 1.0))
        assert world.state.link == "up"
        assert "line_echo" not in world.state.counters


@pytest.mark.parametrize(("before", "after"), [(0.02, 0.3), (0.1, 0.2), (0.2, 0.2), (0.25, 0.1)])
def test_a_pose_that_is_set_in_a_silence_of_the_board_is_in_its_covariance(
    before: float, after: float
) -> None:
    """The counts that end the silence also have the motion from before the pose was set."""
    world = started(config(counts=3200))
    world.drive(0.8, 0.3, seconds=2.0)
    with world.mcu.mute():
        world.hold(0.8, 0.3, seconds=before)
        true = world.mcu.vehicle.pose
        assert world.call("set_pose", json.encode(true)).success
        world.run(after)
    world.run(1.0)
    pose, p = world.mcu.vehicle.pose, world.odom.pose.covariance
    for off, variance in (
        (pose.x - world.state.x, p[0]), (pose.y - world.state.y, p[7]),
        (math.remainder(pose.yaw - world.state.yaw, math.tau), p[35]),
    ):  # fmt: skip
        assert abs(off) < 2.0 * math.sqrt(variance)
