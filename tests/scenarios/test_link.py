"""The serial line fails in many ways. The robot stops, reports the reason, and recovers."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TypeVar

import pytest

from acsard.core.config.named_faults import named
from acsard.core.config.settings import Config, ControlConfig, McuConfig, SimConfig
from acsard.core.messages.schema import (
    DiagnosticArray,
    JointState,
    Message,
    Odometry,
    RobotState,
    Twist,
    Vector3,
)
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S, Instant, Received
from tests.scenarios.world import World

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


T = TypeVar("T", bound=Message)


def current(world: World, key: str, kind: type[T]) -> T:
    """Return the present value of this key, as a query would receive it."""
    message = world.loop.publication.current(key)
    assert isinstance(message, kind)
    return message


def moving(lines: list[bytes]) -> list[bytes]:
    return [line for line in lines if line not in (ZERO, b"\r\n", b"?\r\n")]


def test_unplugging_is_reported_immediately_and_commands_zero(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.port.unplug()
    world.run(0.01)
    state = world.state
    assert (state.mode, state.link) == ("waiting", "down")
    assert state.code == "port_closed"
    outputs = world.outputs
    assert outputs is not None
    assert outputs.speeds.as_tuple() == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.slow
def test_a_speed_is_not_reported_after_its_measurements_end(world: World) -> None:
    world.drive(1.0, seconds=3.0)
    moving_x = world.state.linear
    assert moving_x == pytest.approx(1.0, abs=0.05)
    sampled = world.odom
    world.port.unplug()
    world.run(60.0)
    state = world.state
    assert (state.linear, state.angular, state.wheels) == (None, None, [])
    assert state.feedback_age == pytest.approx(60.0, abs=0.02)
    (age,) = [
        value.value
        for row in current(world, "diagnostics", DiagnosticArray).status
        for value in row.values
        if value.key == "feedback_age_s"
    ]
    assert float(age) == pytest.approx(60.0, abs=0.02)
    odom = current(world, "odom", Odometry)
    assert (odom.header, odom.pose) == (sampled.header, sampled.pose)
    assert odom.twist.twist == Twist(Vector3(), Vector3())
    assert odom.twist.covariance[::7] == [1e6] * 6
    wheels = current(world, "wheel_states", JointState)
    assert (len(wheels.position), wheels.velocity) == (4, [])
    world.port.plug(world.mcu)
    world.run(0.5)
    assert world.state.linear == pytest.approx(0.0, abs=0.05)
    assert world.state.feedback_age == pytest.approx(0.0, abs=0.02)


def test_a_robot_that_never_received_feedback_reports_no_speed_and_no_age() -> None:
    world = World(plugged=False)
    world.run(1.0)
    state = world.state
    assert (state.linear, state.wheels, state.feedback_age) == (None, [], None)


def test_a_port_that_closes_while_it_is_read_is_down_in_the_same_step(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    outcomes: list[tuple[str, bytes | None]] = []

    def close(late: Instant | None = None) -> tuple[Received, ...]:
        world.port.unplug()
        world.watch = lambda outputs: outcomes.append((outputs.link, outputs.line))
        return ()

    world.port.take = close  # type: ignore[method-assign]
    world.run(0.011)
    assert outcomes[0] == ("down", ZERO)


def test_after_replugging_nothing_moves_before_a_zero(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.port.unplug()
    world.hold(0.5, seconds=1.0)
    fresh = FakeMcu(world.config, world.now_ns)
    world.mcu = fresh
    world.port.plug(fresh)
    world.hold(0.5, seconds=2.0)
    assert fresh.heard[0][1] == b"\r\n"
    assert not moving(world.lines())
    assert world.state.code == "neutral"
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"


def test_odometry_goes_on_without_a_jump_after_replugging(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.port.unplug()
    world.run(3.0)
    before = world.state.x
    world.mcu = FakeMcu(world.config, world.now_ns)
    world.port.plug(world.mcu)
    world.run(1.0)
    assert world.state.x == pytest.approx(before, abs=1e-9)


@pytest.mark.slow
def test_a_silent_mcu_gets_zeros_only_at_ten_hertz(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.hold(0.5, seconds=0.2)
        assert world.state.link == "stale"
        sent = len(world.port.sent)
        world.hold(0.5, seconds=2.0)
    lines = [line for _, line in list(world.port.sent)[sent:]]
    assert 19 <= len(lines) <= 21
    assert set(lines) == {ZERO}


def test_odometry_stands_while_the_mcu_is_silent_and_grows_less_certain(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.2)
        x, known = world.state.x, world.odom.pose.covariance[0]
        world.run(2.0)
        assert world.state.x == x
    world.run(0.5)
    assert world.odom.pose.covariance[0] > known


def test_a_short_silence_only_ramps_up_again(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.hold(0.5, seconds=0.5)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "driving"


def test_a_long_silence_requires_neutral_again(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.hold(0.5, seconds=1.5)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"


def test_a_zero_from_before_a_long_stall_is_not_neutral_after_it(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.send(0.0)
    world.stall(1.2)
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


@pytest.mark.parametrize("fault", ["spaces", "trailing_comma", "slow_reply"])
def test_a_lenient_form_of_reply_changes_nothing(world: World, fault: str) -> None:
    with getattr(world.mcu, fault)():
        world.drive(0.5, seconds=2.0)
        world.send(0.0)
        world.run(1.0)
    assert world.state.x == pytest.approx(1.0, rel=0.02)
    assert not [name for name in world.state.counters if name.startswith("line_")]


@pytest.mark.parametrize("fault", ["noise", "partial_line"])
def test_a_damaged_reply_is_no_feedback(world: World, fault: str) -> None:
    world.drive(0.5, seconds=1.0)
    with getattr(world.mcu, fault)():
        world.hold(0.5, seconds=0.5)
        assert world.state.link == "stale"
        assert world.lines()[-1] == ZERO
    world.hold(0.5, seconds=1.0)
    assert world.state.link == "up"
    assert sum(n for k, n in world.state.counters.items() if k.startswith("line_")) >= 1


def test_noise_costs_at_most_the_line_it_hits(world: World) -> None:
    before = world.state.counters["lines"]
    with world.mcu.noise(b"\x00\xff~\n"):
        world.run(1.0)
    assert world.state.link == "up"
    assert world.state.counters["lines"] - before >= 98


def test_an_mcu_that_speaks_unprompted_at_ten_hertz_can_drive() -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.1)))
    with world.mcu.free_running(0.1):
        world.run(1.0)
        assert world.state.link == "up"
        world.drive(0.5, seconds=4.0)
        world.send(0.0)
        world.run(1.5)
    assert world.state.x == pytest.approx(2.0, rel=0.03)


def test_a_comma_latched_mcu_keeps_its_last_wheel_without_the_trailing_comma(
    world: World,
) -> None:
    with world.mcu.comma_latched():
        world.drive(0.5, seconds=0.6)
        assert world.mcu.vehicle.set_points == [10.0, 10.0, 10.0, 0.0]
        world.hold(0.5, seconds=1.0)
        assert "rear_right wheel is blocked, or has no power" in world.state.wheel_fault


def test_the_trailing_comma_option_reaches_the_last_wheel_of_a_comma_latched_mcu() -> None:
    world = World(Config(mcu=McuConfig(trailing_comma=True)))
    latched: AbstractContextManager[None] = world.mcu.comma_latched()
    with latched:
        world.run(0.2)
        world.drive(0.5, seconds=1.0)
        assert world.mcu.vehicle.set_points == [10.0, 10.0, 10.0, 10.0]
        world.run(2.0)
        assert world.mcu.vehicle.set_points == [0.0, 0.0, 0.0, 0.0]


def test_blocked_output_is_superseded_and_never_delivered_late(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.port.blocked = True
    world.hold(0.5, seconds=0.2)
    # A zero that did not leave is sent again in the next period, and not with the next 10 Hz.
    # Four commands came between two periods.
    assert 19 <= world.state.counters["lines_superseded"] <= 26
    before = len(world.mcu.heard)
    world.port.blocked = False
    world.run(0.02)
    assert len(world.mcu.heard) - before <= 2


def test_after_a_long_block_the_robot_starts_over_from_rest(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.port.blocked = True
    with world.mcu.free_running(0.05):
        world.hold(0.5, seconds=0.5)
        sent = len(world.port.sent)
        world.port.blocked = False
        world.hold(0.5, seconds=0.05)
    first = list(world.port.sent)[sent][1]
    assert first == ZERO


@pytest.mark.parametrize("seconds", [2.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_a_blocked_output_is_not_driving_and_requires_neutral_after_a_second(
    seconds: float,
) -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.05)))
    with world.mcu.free_running(0.05):
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


def test_a_short_blocked_output_only_ramps_up_again() -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.05)))
    with world.mcu.free_running(0.05):
        world.run(0.5)
        world.drive(0.5, seconds=1.0)
        world.port.blocked = True
        world.hold(0.5, seconds=0.7)
        assert world.state.mode == "waiting"
        world.port.blocked = False
        world.hold(0.5, seconds=0.3)
        assert world.state.mode == "driving"


def test_an_output_that_is_blocked_from_the_opening_on_is_reported_before_the_link_is_up() -> None:
    world = World(Config(mcu=McuConfig(reply_period=0.2)), plugged=False)
    world.port.blocked = True
    with world.mcu.free_running(0.2):
        world.port.plug(world.mcu)
        world.run(4.0)
        assert (world.state.mode, world.state.link) == ("waiting", "booting")
        assert world.state.code == "port_blocked"
        (event,) = [event for event in world.events if event.code == "port_blocked"]
        assert (event.name, event.level) == ("link_booting", "warning")
        world.port.blocked = False
        world.run(1.0)
        assert world.state.link == "up"


def test_the_first_line_after_a_reopening_is_zero_even_when_the_output_was_blocked() -> None:
    world = World(plugged=False)
    world.run(0.1)
    world.port.blocked = True
    with world.mcu.free_running(0.02):
        world.port.plug(world.mcu)
        world.run(0.1)
        world.drive(0.5, seconds=0.1)
        world.port.blocked = False
        world.run(0.1)
        assert world.state.link == "up"
        world.drive(0.5, seconds=0.2)
    assert world.lines()[0] == ZERO
    assert moving(world.lines())


def test_a_line_that_a_stall_in_the_step_delays_is_superseded_by_the_next_one(
    world: World,
) -> None:
    world.drive(0.5, seconds=0.2)  # on the way up each line has another speed
    made: list[bytes | None] = []
    world.watch = lambda outputs: made.append(outputs.line) if outputs.due else None
    sent = len(world.port.sent)
    world.stall_in_step(0.015)
    world.run(0.1)
    old, *fresh = made
    assert [line for _, line in list(world.port.sent)[sent:]] == fresh
    assert len({old, *fresh}) == 1 + len(fresh) >= 8
    assert world.state.counters["lines_superseded"] == 1


def test_a_zero_line_is_sent_however_long_the_step_stalled(world: World) -> None:
    sent, begun_ns = len(world.port.sent), world.now_ns
    world.stall_in_step(0.2)
    world.run(0.2)
    (late_ns, line), *_ = list(world.port.sent)[sent:]
    assert line == ZERO
    assert late_ns >= begun_ns + NS_PER_S // 5
    assert world.state.counters.get("lines_superseded", 0) == 0


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


def test_a_slow_wire_drives_at_the_rate_it_carries() -> None:
    world = World(Config(mcu=McuConfig(baud_rate=9600), control=ControlConfig(rate="auto")))
    assert world.config.rate_hz == 23
    world.run(1.0)
    world.drive(0.5, seconds=2.0)
    world.send(0.0)
    world.run(1.5)
    assert world.state.x == pytest.approx(1.0, rel=0.05)
    assert world.state.counters.get("lines_superseded", 0) == 0


def test_a_stall_of_the_loop_causes_no_burst_of_lines_and_loses_no_distance(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    sent = len(world.port.sent)
    world.send(0.5)
    world.stall(0.08)
    world.hold(0.5, seconds=0.5)
    assert len(world.port.sent) - sent <= 52
    world.send(0.0)
    world.run(1.5)
    assert world.state.x == pytest.approx(world.mcu.vehicle.pose.x, abs=0.005)


def test_a_lost_link_is_reported_as_a_host_stall_or_as_a_silent_board(
    world: World,
) -> None:
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.05)
        world.stall(0.2)
        world.run(0.05)
        assert world.state.link == "stale"
        assert world.state.code == "host_late"
    assert world.state.counters["link_lost_host_stall"] == world.state.counters["link_lost"] == 1
    world.hold(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.2)
    assert world.state.counters["link_lost"] == 2
    assert world.state.counters["link_lost_host_stall"] == 1


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


def test_the_mcu_watchdog_is_fed_while_the_host_lives(world: World) -> None:
    world.drive(0.5, seconds=5.0)
    assert world.mcu.watchdog_trips == 0


def test_the_mcu_stops_the_motors_by_itself_when_the_host_dies(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.mcu.advance(world.now_ns + 400_000_000)
    assert world.mcu.vehicle.set_points == [0.0] * 4


@pytest.mark.slow
@pytest.mark.variations(9)
@pytest.mark.parametrize("fault", ["lost_replies", "lost_commands"])
def test_a_link_that_loses_lines_is_reported_once(fault: str) -> None:
    world = World()
    with world.mcu.switched_on(named(fault)):
        world.run(25.0)
    events = [event for event in world.events if event.name == "lines_lost"]
    assert [event.level for event in events] == ["warning"]
    assert "answered only" in events[0].text


@pytest.mark.slow
def test_a_sound_link_is_not_reported_to_lose_lines() -> None:
    world = World()
    world.drive(0.5, seconds=25.0)
    assert not [event for event in world.events if event.name == "lines_lost"]
    assert "link_lost" not in world.state.counters


def test_each_silence_of_a_board_is_counted() -> None:
    world = World()
    with world.mcu.switched_on(named("stalls=1:0.3")):
        world.run(5.5)
    assert world.state.counters["link_lost"] == 5


def test_a_simulator_that_is_configured_mute_never_brings_the_link_up() -> None:
    world = World(Config(sim=SimConfig(faults=("mute",))), wanted={"state"})
    world.run(10.0)
    states = [
        message for message in world.bus.published["state"] if isinstance(message, RobotState)
    ]
    assert {state.link for state in states} == {"booting"}
    assert world.mcu.valid_lines > 0


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("mute", "received_nothing"),
        ("noise", "received_foreign"),
        ("partial_line", "received_cut"),
    ],
)
def test_a_silent_or_garbled_board_is_diagnosed_by_the_received_bytes(
    fault: str, code: str
) -> None:
    world = World(wanted={"state"})
    with world.mcu.switched_on(named(fault)):
        world.run(2.9)
        assert world.state.code == "booting"
        states = len(world.bus.published["state"])
        world.run(6.5)
    assert world.state.code == code
    assert len(world.bus.published["state"]) - states < 80, "its figures are not news of their own"
    (event,) = [event for event in world.events if event.code == code]
    assert (event.name, event.level) == ("link_booting", "warning")
