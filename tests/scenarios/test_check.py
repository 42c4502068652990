"""The checked link: new and old firmware, damage, resets, counts, and a line that echoes."""

from __future__ import annotations

import math
import re
from collections import deque
from contextlib import nullcontext
from functools import partial

import pytest
from msgspec import json
from msgspec.structs import replace

from acsard.core.config.settings import (
    Config,
    LimitsConfig,
    McuConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.messages.schema import DiagnosticArray
from acsard.core.simulator import protocol
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S
from tests.scenarios.world import World
from tests.wheels import four_and_two

MS = 1_000_000


def config(check: str = "on", counts: int = 0, **mcu: object) -> Config:
    return Config(mcu=McuConfig(link_check=check, encoder_counts=counts, **mcu))  # type: ignore[arg-type]


def started(made: Config) -> World:
    world = World(made)
    world.run(0.3)
    return world


def moving(lines: list[bytes]) -> list[bytes]:
    return [line for line in lines if re.search(rb"[1-9]", line.partition(b"#")[0])]


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


# the firmware at the other end


@four_and_two
def test_a_new_mcu_is_driven_with_checked_lines(wheels: WheelMap) -> None:
    world = started(config(wheels=wheels))
    world.drive(0.5, seconds=2.0)
    assert world.state.mode == "driving"
    assert check_of(world) == "checked"
    assert texts(world, "link_check") == []
    lines = moving(world.lines())
    assert len(lines) > 150
    assert all(protocol.reference(line, wheels.letters) and b"#" in line for line in lines)
    world.run(1.5)
    assert stopped(world)
    assert world.state.x == pytest.approx(world.mcu.vehicle.pose.x, abs=0.005)
    assert set(world.state.counters) <= {"lines", "lines_sent", "commands"}


OLD_FIRMWARE = pytest.mark.parametrize(
    ("firmware", "comma"), [("no_check", False), ("plain_only", False), ("comma_latched", True)]
)


@pytest.mark.parametrize("boots", [False, True])
@OLD_FIRMWARE
def test_old_firmware_is_never_driven_on_a_checked_link_and_the_reason_names_the_setting(
    firmware: str, comma: bool, boots: bool
) -> None:
    world = World(config("on", trailing_comma=comma))
    with world.mcu.fault(firmware):
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


# damage


@pytest.mark.variations(3)
@pytest.mark.parametrize("every", [2, 3, 7])
@four_and_two
def test_bit_errors_both_ways_change_no_speed(every: int, wheels: WheelMap) -> None:
    world = started(config("on", 3200, wheels=wheels))
    world.drive(0.4, seconds=0.5)
    set_points: set[float] = set()
    with world.mcu.fault("bit_errors", every):
        for _ in range(200):
            world.hold(0.4, seconds=0.01, hz=100.0)
            set_points.update(world.mcu.vehicle.set_points)
            assert all(abs(speed) < 8.5 for speed in world.state.wheels)
    assert max(set_points) <= 8.0
    assert min(set_points) >= 0.0


# counts


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


# anything


@pytest.mark.parametrize(("before", "after"), [(0.02, 0.3), (0.1, 0.2), (0.2, 0.2), (0.25, 0.1)])
def test_a_pose_that_is_set_in_a_silence_of_the_board_is_in_its_covariance(
    before: float, after: float
) -> None:
    """The counts that end the silence also have the motion from before the pose was set."""
    world = started(config(counts=3200))
    world.drive(0.8, 0.3, seconds=2.0)
    with world.mcu.fault("mute"):
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


# A serial line that echoes, alone or beside a board, is found and never driven


class Echo(FakeMcu):
    """A port without a microcontroller, which returns all bytes after 5 ms and `extra_delay_ns`."""

    def receive(self, now_ns: int, data: bytes) -> None:
        self._schedule(now_ns + 5 * MS + self.switches.extra_delay_ns, "sent", data)


@pytest.mark.variations(3)
@pytest.mark.parametrize(("check", "counts"), [("off", 0), ("on", 0), ("on", 3200)])
@pytest.mark.parametrize(
    ("delay_ms", "latency_ms"),
    [pytest.param(0, 0, id="prompt"), pytest.param(0, 16, id="adapter"),
     pytest.param(30, 0, id="radio"), pytest.param(60, 0, id="slow radio")],
)  # fmt: skip
@four_and_two
def test_a_serial_line_that_echoes_is_never_driven(
    check: str, counts: int, delay_ms: int, latency_ms: int, wheels: WheelMap
) -> None:
    world = World(config(check, counts, wheels=wheels), plugged=False)
    echo = Echo(world.config, world.now_ns)
    echo.switches.extra_delay_ns, echo.switches.latency_ns = delay_ms * MS, latency_ms * MS
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


@four_and_two
def test_a_line_that_begins_to_echo_in_a_steady_drive_is_found_before_the_command_changes(
    wheels: WheelMap,
) -> None:
    """Every reply repeats a line, and the speeds of the lines do not change."""
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.run(0.5)
    world.drive(0.3, seconds=2.0)
    x = world.state.x
    world.port.mcu = Echo(world.config, world.now_ns)
    world.hold(0.3, seconds=1.5)
    assert (world.state.link, world.state.code) == ("stale", "echo")
    assert world.state.x - x < 0.4


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
    board.switches.latency_ns = latency_ms * MS
    world.port.plug(board)
    with board.fault("free_running", period) if period else nullcontext():
        world.run(0.5)
        world.drive(0.5, seconds=2.0)
        assert (world.state.link, world.state.code) == ("booting", "echo")
        assert moving([line for _, line in world.port.sent]) == []


# Motors that follow exactly are no board without encoders


@pytest.mark.variations(10)
@pytest.mark.parametrize(
    # 0.2 m/s2 are 4 rad/s2: the ramps are steeper than `STEEP`.
    ("lag_s", "acceleration"),
    [(0.001, 1.0), (0.005, 0.22), (0.01, 0.22), (0.01, 1.0), (0.02, 0.22)],
)
@four_and_two
def test_servo_drives_that_follow_each_ramp_to_the_hundredth_keep_the_link(
    lag_s: float, acceleration: float, wheels: WheelMap
) -> None:
    limits = LimitsConfig(linear_acceleration=acceleration, linear_deceleration=acceleration)
    sim = SimConfig(motor_time_constant=lag_s, encoder_counts=300_000)
    world = World(Config(limits=limits, mcu=McuConfig(wheels=wheels), sim=sim))
    for _ in range(15):
        world.drive(0.1)
        world.hold(0.0)
    assert [event.text for event in world.events if event.name == "link_check"] == []
    assert world.state.link == "up"


@pytest.mark.variations(3)
@pytest.mark.parametrize("check", ["off", "on"])
@pytest.mark.parametrize(("separator", "late"), [(",", 0), (",", 1), (", ", 0)])
@pytest.mark.parametrize("jerk", [0.0, 3.0])
def test_a_board_that_reports_its_set_points_in_any_form_is_found_within_six_ramps(
    check: str, separator: str, late: int, jerk: float
) -> None:
    world = World(
        Config(mcu=McuConfig(link_check=check), limits=LimitsConfig(linear_jerk=jerk))  # type: ignore[arg-type]
    )
    board = world.mcu
    set_points = deque([[0.0] * 4] * (1 + late), 1 + late)

    def speeds(now_ns: int) -> list[float]:
        every = board.vehicle.set_points
        set_points.append([every[wheels[0]] * forward for wheels, forward in board._wiring])
        return set_points[0]

    board._speeds = speeds  # type: ignore[method-assign]
    with board.switched(partial(replace, separator=separator)):
        for _ in range(3):
            world.drive(0.5)
            world.hold(0.0)
    assert (world.state.link, world.state.code) == ("stale", "set_points")
    assert abs(world.mcu.vehicle.pose.x) < 2.0
