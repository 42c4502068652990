"""The serial line fails in many ways. The robot stops, reports the reason, and recovers."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import partial

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import (
    MAX_REPLY_PERIOD_S,
    Config,
    ControlConfig,
    McuConfig,
    WheelMap,
)
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import Received
from tests.each import each
from tests.scenarios.world import World
from tests.wheels import FOUR, TWO

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def moving(lines: list[bytes]) -> list[bytes]:
    return [line for line in lines if line not in (ZERO, b"\r\n", b"?\r\n")]


@pytest.mark.slow
def test_a_silent_mcu_gets_zeros_only_at_ten_hertz(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.fault("mute"):
        world.hold(0.5, seconds=0.2)
        assert world.state.link == "stale"
        sent = len(world.port.sent)
        world.hold(0.5, seconds=2.0)
    lines = [line for _, line in list(world.port.sent)[sent:]]
    assert 19 <= len(lines) <= 21
    assert set(lines) == {ZERO}


def test_a_short_silence_only_ramps_up_again(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.fault("mute"):
        world.hold(0.5, seconds=0.5)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "driving"


@pytest.mark.parametrize("fault", ["mute", "partial_line", "noise"])
def test_a_board_that_is_silent_or_cannot_be_read_for_long_requires_neutral_again(
    world: World, fault: str
) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.fault(fault):
        world.hold(0.5, seconds=1.5)
        assert world.state.mode == "waiting"
        assert world.state.link == "stale"
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"


def test_a_reset_mcu_does_not_move_before_neutral(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    x = world.state.x
    world.mcu.reset(world.now_ns)
    valid = world.mcu.valid_lines
    world.hold(0.5, seconds=4.0)
    assert world.mcu.valid_lines > valid
    assert world.state.mode == "ready"
    assert world.mcu.vehicle.set_points == [0.0] * 4
    assert world.state.x == pytest.approx(x, abs=0.1)
    assert world.state.counters["line_malformed"] >= 1


def test_an_mcu_that_speaks_unprompted_at_ten_hertz_can_drive() -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.1)))
    with world.mcu.fault("free_running", 0.1):
        world.run(1.0)
        assert world.state.link == "up"
        world.drive(0.5, seconds=4.0)
        world.send(0.0)
        world.run(1.5)
    assert world.state.x == pytest.approx(2.0, rel=0.03)


def test_the_trailing_comma_option_reaches_the_last_wheel_of_a_comma_latched_mcu() -> None:
    world = World(Config(mcu=McuConfig(trailing_comma=True)))
    latched: AbstractContextManager[None] = world.mcu.fault("comma_latched")
    with latched:
        world.run(0.2)
        world.drive(0.5, seconds=1.0)
        assert world.mcu.vehicle.set_points == [10.0, 10.0, 10.0, 10.0]
        world.run(2.0)
        assert world.mcu.vehicle.set_points == [0.0, 0.0, 0.0, 0.0]


@each("period_s", [0.2, 0.24, MAX_REPLY_PERIOD_S])
def test_a_board_whose_seldom_lines_look_like_zeros_of_the_host_gets_a_link(
    period_s: float,
) -> None:
    world = World(Config(mcu=McuConfig(reply_period=period_s)))
    padded = world.mcu.switched(partial(replace, unpadded_replies=False, ending="\r\n"))
    with world.mcu.fault("free_running", period_s), padded:
        world.run(4 * period_s + 0.3)
        assert world.state.link == "up", world.state.reason


@pytest.mark.parametrize("seconds", [2.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_a_blocked_output_is_not_driving_and_requires_neutral_after_a_second(
    seconds: float,
) -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.05)))
    with world.mcu.fault("free_running", 0.05):
        world.run(0.5)
        world.drive(0.5, seconds=1.0)
        world.events.clear()
        world.port.blocked = True
        world.hold(0.5, seconds=0.35)
        state = world.state
        assert (state.mode, state.link) == ("waiting", "stale")
        assert state.code == "port_blocked"
        world.hold(0.5, seconds=seconds)
        assert world.state.code == "port_blocked"
        (event,) = [event for event in world.events if event.name == "link_stale"]
        assert event.code == "port_blocked"
        x, sent = world.mcu.vehicle.pose.x, len(world.port.sent)
        world.port.blocked = False
        world.hold(0.5, seconds=2.0)
        assert world.mcu.vehicle.pose.x == x
        assert not moving([line for _, line in list(world.port.sent)[sent:]])
        assert (world.state.mode, world.state.link) == ("ready", "up")
        world.drive(0.5, seconds=0.5)
        assert world.state.mode == "driving"


def test_a_torn_line_moves_nothing_and_spoils_no_later_line(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.run(0.005)  # the last one arrives
    valid, count = world.mcu.valid_lines, len(world.mcu.heard)
    world.port.takes = 10
    world.run(0.1)
    torn, *behind = [line for _, line in list(world.mcu.heard)[count:]]
    assert torn == b"ap10.00,bp\r\n"
    assert len(behind) >= 8
    assert world.mcu.valid_lines == valid + len(behind)
    assert world.mcu.vehicle.set_points == [10.0] * 4
    assert world.state.counters["lines_superseded"] == 1


BOOT_TEXT = (
    b"\r\nBrownout detector was triggered\r\n\r\nets Jul 29 2019 12:21:46\r\n\r\n"
    b"rst:0xf (RTCWDT_BROWN_OUT_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)\r\nentry 0x400805e4\r\n"
)


def test_a_board_that_prints_its_boot_text_has_restarted_and_says_why(world: World) -> None:
    """It starts in 0.4 s: as a silence alone, that would only ramp down and up."""
    world.drive(0.5, seconds=1.0)
    for _ in range(2):
        world.port.feed(Received(world.instant, BOOT_TEXT))
        with world.mcu.fault("mute"):
            world.hold(0.5, seconds=0.4)
        world.hold(0.5, seconds=1.0)
    told = [event.text for event in world.events if event.name == "mcu_restarted"]
    cause = "because its supply voltage was too low: it sent `Brownout detector was triggered`"
    assert told == [f"the microcontroller has restarted {cause}"] * 2
    assert world.state.linear == 0.0, "each sender must be neutral again"


def test_a_slow_wire_drives_at_the_rate_it_carries() -> None:
    world = World(Config(mcu=McuConfig(baud_rate=9600), control=ControlConfig(rate="auto")))
    assert world.config.rate_hz == 23
    world.run(1.0)
    world.drive(0.5, seconds=2.0)
    world.send(0.0)
    world.run(1.5)
    assert world.state.x == pytest.approx(1.0, rel=0.05)
    assert world.state.counters.get("lines_superseded", 0) == 0


@pytest.mark.slow
@pytest.mark.variations(3)
@pytest.mark.parametrize("stall", [0.105, 0.15, 0.22])
def test_a_stall_of_this_computer_does_not_stop_the_robot_without_a_ramp(stall: float) -> None:
    """A short stall of the daemon must not cause an abrupt line of zeros.

    A command arrives before the stall, so its line leaves early, and the reply to it waits.
    """
    for wait_ms in range(10, 24):
        world = World()
        world.run(0.5)
        world.drive(0.8, seconds=1.5)
        world.run(0.05)
        world.send(0.8)
        world.run(wait_ms / 1000)
        lines = len(world.port.sent)
        world.stall(stall)
        world.hold(0.8, seconds=0.3)
        assert b"ap00.00" not in b"".join(line for _, line in list(world.port.sent)[lines:])


@pytest.mark.parametrize(
    ("wheels", "motors"), [(TWO, FOUR), (FOUR, TWO), (TWO, WheelMap(left="+a", right="+b"))]
)
@pytest.mark.parametrize(
    ("reports", "code"),
    [(0.01, "received_letters"), (0.0, "received_nothing"), (0.0, "received_identity")],
)
def test_a_board_with_other_motors_is_never_driven_and_the_advice_names_the_setting(
    wheels: WheelMap, motors: WheelMap, reports: float, code: str
) -> None:
    """It answers no line of other motors, but may report by its own clock."""
    config = Config(mcu=McuConfig(wheels=wheels, reply_period=reports))
    world = World(config, plugged=False)
    board = FakeMcu(Config(mcu=McuConfig(wheels=motors)), world.now_ns)
    world.port.plug(board)
    if code == "received_identity":
        board.reset(world.now_ns)
    with board.fault("free_running", 0.01) if reports else nullcontext():
        world.run(0.5)
        world.drive(0.5, seconds=8.0)
    assert (world.state.link, world.state.code) == ("booting", code)
    assert "mcu.wheels" in world.state.reason
    assert board.vehicle.set_points == [0.0] * 4


def test_a_board_that_answers_seldom_is_answered_with_the_setting() -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyUSB0")))
    with world.mcu.fault("sparse_replies"):
        world.run(3.0)
    assert world.state.code == "reply_period"
    assert "set mcu.reply_period = 0." in world.state.reason
