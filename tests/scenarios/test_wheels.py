"""An encoder or motor of one wheel fails; the robot stops and names the wheel."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from itertools import product

import pytest
from msgspec.structs import replace

from acsard.core.config.contradictions import MOST_ASKED_HZ
from acsard.core.config.settings import (
    Config,
    ControlConfig,
    FeedbackConfig,
    LimitsConfig,
    McuConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.motion.obedience import DEAD_TIME_S
from acsard.core.motion.wheel import TIMING_S
from acsard.core.motion.wheels import (
    BLOCK_S,
    FAULT_ANGLE,
    FAULT_COUNTS,
    count_angle,
)
from acsard.core.simulator.protocol import speeds_text
from acsard.core.values import NS_PER_S, Received
from tests.scenarios.world import World
from tests.wheels import FOUR, TWO, four_and_two


@pytest.fixture
def wheels() -> WheelMap:
    return FOUR


@pytest.fixture
def world(wheels: WheelMap) -> World:
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.run(0.2)
    return world


def damage(world: World, every: int, speeds: tuple[float, ...]) -> list[int]:
    """Replace each so-many-th line by one with these speeds; return a list of their number."""
    feed, seen, damaged = world.port.feed, 0, [0]
    letters = world.mcu.letters
    text = speeds_text(letters, speeds[: len(letters)], world.mcu.switches.separator, False)
    text += b"\r\n"

    def fed(received: Received) -> None:
        nonlocal seen
        data = b""
        for line in received.data.splitlines(keepends=True):
            seen += 1
            hit = seen % every == 0 and not line.startswith((b"!", b"?"))
            damaged[0] += hit
            data += text if hit else line
        feed(Received(received.at, data))

    world.port.feed = fed  # type: ignore[method-assign]
    return damaged


def stopped(world: World) -> bool:
    return world.mcu.vehicle.set_points == [0.0] * 4


@pytest.mark.variations(4)
@pytest.mark.parametrize(
    ("wheels", "wheel"), [(wheels, n) for wheels in (FOUR, TWO) for n in range(len(wheels.names))]
)
@pytest.mark.parametrize("kind", ["reversed", "runaway"])
def test_a_faulty_encoder_stops_the_robot_and_is_named(
    world: World, wheels: WheelMap, wheel: int, kind: str
) -> None:
    world.drive(0.5, seconds=1.5)
    motor = wheels.letters.index(wheels.motors[wheel][1])
    faults: dict[str, AbstractContextManager[None]] = {
        "reversed": world.mcu.fault("bias", motor, -1.0),
        "runaway": world.mcu.fault("bias", motor, 2.0),
    }
    with faults[kind]:
        world.hold(0.5, seconds=2.0)
        assert world.state.mode == "fault"
        assert world.state.reason.startswith(f"{wheels.names[wheel]} wheel ")
        assert stopped(world)
    causes = [event.text for event in world.events if event.name == "fault"]
    assert len(causes) == 1
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "fault"
    assert world.call("clear").success
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


@pytest.mark.variations(5)
@pytest.mark.parametrize(("counts", "period", "limit"), [(20, 0.02, 22.0), (16, 0.01, 25.0)])
@pytest.mark.parametrize("rolls_on", [False, True])
def test_a_limit_below_one_count_of_an_encoder_hides_neither_the_way_nor_a_runaway(
    counts: int, period: float, limit: float, rolls_on: bool
) -> None:
    limits = LimitsConfig(wheel_speed=20.0, linear_speed=1.0)
    mcu = McuConfig(reply_period=period, baud_rate=250000)
    feedback, sim = FeedbackConfig(wheel_speed=limit), SimConfig(encoder_counts=counts)
    world = World(Config(mcu=mcu, sim=sim, feedback=feedback, limits=limits))
    with world.mcu.fault("free_running", period):
        world.run(0.5)
        world.drive(0.9, seconds=5.0)
        true = world.mcu.vehicle.pose.x
        assert world.state.x == pytest.approx(true, abs=0.1)
        if rolls_on:
            with world.mcu.fault("pushed", 0.4):
                world.hold(0.0, seconds=5.0)
            assert world.state.code == "wheel_runaway"


@pytest.mark.variations(5)
@pytest.mark.parametrize(("configured", "real"), [(0, 20), (20, 20), (0, 3200)])
@pytest.mark.parametrize("drives", [False, True])
@pytest.mark.parametrize(("speed", "wheels"), [(95.0, FOUR), (99.99, FOUR), (95.0, TWO)])
def test_lasting_impossible_speeds_are_a_fault_although_one_count_is_excused(
    configured: int, real: int, drives: bool, speed: float, wheels: WheelMap
) -> None:
    mcu = McuConfig(encoder_counts=configured, wheels=wheels)
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=real)))
    world.run(0.5)
    world.drive(0.5, seconds=2.0)
    world.hold(0.5 if drives else 0.0, seconds=2.0)
    began = world.state.x
    damage(world, every=1, speeds=(speed,) * 4)
    world.hold(0.5 if drives else 0.0, seconds=0.15)
    assert world.state.code == "impossible_speeds"
    assert abs(world.state.x - began) < 0.3


@pytest.mark.variations(5)
@pytest.mark.parametrize(("speed", "wheels"), [(95.0, FOUR), (99.99, FOUR), (95.0, TWO)])
@pytest.mark.parametrize("drives", [False, True])
@pytest.mark.parametrize("every", [20, 50])
def test_impossible_lines_do_not_teach_that_the_encoders_are_coarse(
    world: World, speed: float, drives: bool, every: int
) -> None:
    world.run(0.3)
    world.drive(0.3 if drives else 0.0, seconds=1.0)
    damaged = damage(world, every=every, speeds=(speed, 6.0, 6.0, speed))
    world.hold(0.3 if drives else 0.0, seconds=12.0)
    assert world.state.counters["line_implausible"] == damaged[0] > 20
    assert abs(world.state.yaw) < 0.05


@pytest.mark.variations(7)
@four_and_two
@pytest.mark.parametrize("speeds_up", [False, True])
def test_wheels_with_few_counts_are_a_fault_only_if_they_are_too_fast(
    speeds_up: bool, wheels: WheelMap
) -> None:
    """The board is asked as often as possible without its counts."""
    control, sim = ControlConfig(rate=MOST_ASKED_HZ), SimConfig(encoder_counts=16)
    world = World(Config(control=control, sim=sim, mcu=McuConfig(wheels=wheels)))
    world.run(0.3)
    world.drive(0.1, seconds=2.0)
    with ExitStack() as faster:
        for wheel in range(len(wheels.names) * speeds_up):
            faster.enter_context(world.mcu.fault("bias", wheel, 1.6))
        world.hold(0.1, seconds=8.0)
    assert world.state.code == ("wheel_too_fast" if speeds_up else "commanded")


# hands


def event_texts(world: World, name: str) -> list[str]:
    return [event.text for event in world.events if event.name == name]


@pytest.mark.parametrize(
    ("verb", "wheels"), [("", FOUR), ("deactivate", FOUR), ("stop", FOUR), ("", TWO)]
)
def test_wheels_turned_by_hand_are_reported_at_most_once_a_second_and_counted(
    world: World, verb: str
) -> None:
    if verb:
        world.call(verb)
    world.run(2.0)
    mode = world.state.mode
    with world.mcu.fault("pushed", 0.12):
        world.run(4.0)
    assert world.state.mode == mode
    reports = len(event_texts(world, "uncommanded_motion"))
    assert 3 <= reports == world.state.counters["uncommanded_motion"] <= 4


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("linear", "way"), list(product((0.2, 0.5, -1.0), ("stop", "zero", "silence")))
)
@four_and_two
def test_a_robot_that_does_not_obey_a_stop_is_a_fault_as_soon_as_it_is_evident(
    world: World, linear: float, way: str
) -> None:
    """Hands push the robot on at its speed during a stop. The daemon latches a fault.

    To the daemon this looks like motors that do not obey. It is evident after the ramp of the stop
    (and the timeout of the silent source), the longest dead time and the response time, when the
    wheels rolled on for 1 rad, 3 counts and 0.2 s. The law looks at whole steps: by their phase, it
    takes up to 4 of them longer.
    """
    config = world.config
    slowing = {"stop": config.limits.linear_stop_deceleration}
    ramp = abs(linear) / slowing.get(way, config.limits.linear_deceleration)
    if way == "silence":
        ramp += next(s.timeout for s in config.commands.sources if s.name == "app")
    rolling = max(FAULT_ANGLE, FAULT_COUNTS * count_angle(config.mcu.encoder_counts))
    rolls = rolling * config.drive.wheel_radius / abs(linear)
    lags = 1.3 * config.feedback.response_time
    within = ramp + DEAD_TIME_S + lags + rolls + TIMING_S + 4 * BLOCK_S
    world.drive(linear, seconds=2.0)
    began_ns = world.now_ns
    with world.mcu.fault("pushed", linear):
        if way == "stop":
            world.put("stop", b"")
        while world.state.mode != "fault" and world.now_ns - began_ns < 3 * NS_PER_S:
            if way == "zero":
                world.send(0.0)
            world.run(0.02)
    took = (world.now_ns - began_ns) / NS_PER_S
    assert world.state.code == "wheel_runaway"
    assert took <= within + 0.021


@four_and_two
def test_a_robot_that_still_rolls_after_a_lost_link_is_a_runaway(world: World) -> None:
    """The robot was driving when the link was lost, and still moves when the link returns.

    An MCU without a watchdog behaves like this, so the daemon latches a fault.
    """
    world.drive(0.5, seconds=1.0)
    mcu = world.mcu
    with mcu.fault("no_watchdog"), mcu.fault("pushed", 0.5):
        world.port.unplug()
        world.run(0.5)
        world.port.plug(mcu)
        world.run(2.0)
    assert world.state.code == "wheel_runaway"


@four_and_two
def test_a_computer_that_stutters_makes_no_fault_of_a_sound_wheel_with_counts(
    wheels: WheelMap,
) -> None:
    """A line that ends a silence has the counts of all of it."""
    mcu = McuConfig(link_check="on", encoder_counts=20, wheels=wheels)
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=20)))
    world.run(0.2)
    world.drive(0.6, seconds=1.5)
    for number in range(120):
        world.stall(0.1 + 0.005 * (number % 8))
        world.send(0.6)
        world.run(0.001 + 0.002 * (number % 7))
        assert world.state.mode != "fault", world.state.reason


@four_and_two
def test_two_swapped_motors_are_one_cause_whichever_wheel_shows_it(wheels: WheelMap) -> None:
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    with world.mcu.fault("swapped_motors", 0, 1):
        world.drive(0.0, 1.5, seconds=4.0)
    assert [cause.code for cause in world.state.causes].count("wheels_swapped") == 1


@pytest.mark.variations(5)
@four_and_two
@pytest.mark.parametrize("counts", [48, 400, 3200])
def test_encoders_that_die_all_at_once_stop_the_robot_within_a_second_by_one_fault(
    wheels: WheelMap, counts: int
) -> None:
    config = Config(mcu=McuConfig(wheels=wheels), sim=SimConfig(encoder_counts=counts))
    world = World(config)
    world.drive(0.5, 0.3, seconds=3.0)
    way = world.mcu.vehicle.pose
    dead = partial(replace, gains=(0.0,) * len(wheels.letters))
    with world.mcu.switched(dead):
        world.hold(0.5, 0.3, seconds=3.0)
        assert world.state.mode == "fault"
        assert [cause.code for cause in world.state.causes] == ["no_wheel_moves"]
        assert "wheel_blocked" not in {event.code for event in world.events}
        there = world.mcu.vehicle.pose
        assert math.hypot(there.x - way.x, there.y - way.y) < 0.5 * (1.0 + 0.2) + 0.3


@four_and_two
def test_encoders_that_die_under_a_stick_that_moves_to_and_fro_stop_the_robot(
    wheels: WheelMap,
) -> None:
    """Neither a change of the command nor its end is evidence that a wheel moved."""
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.drive(0.5, seconds=2.0)
    way = world.mcu.vehicle.pose.x
    with world.mcu.switched(partial(replace, gains=(0.0,) * len(wheels.letters))):
        for _ in range(20):
            world.hold(0.5, seconds=0.5)
            world.hold(-0.2, seconds=0.5)
        assert world.state.code in ("neutral", "no_wheel_moves")
    assert world.mcu.vehicle.pose.x - way < 2.0


@four_and_two
def test_motors_that_do_not_turn_wait_for_a_zero_and_the_third_time_for_a_clear(
    wheels: WheelMap,
) -> None:
    """They lose their power, slow down, and do not begin again: a kerb looks the same."""
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.drive(0.5, seconds=2.0)
    with world.mcu.switched(partial(replace, drives=(0.0,) * len(wheels.letters))):
        world.hold(0.5, seconds=2.0)
        assert world.state.mode == "driving"
        assert world.state.wheel_fault.startswith("no wheel has begun to move")
        world.hold(0.5, seconds=3.0)
        assert world.state.code == "neutral"
    world.hold(0.5, seconds=2.0)
    assert world.state.code == "neutral"
    world.drive(0.5, seconds=1.0)
    assert (world.state.code, world.state.wheel_fault) == ("commanded", "")
    with world.mcu.switched(partial(replace, drives=(0.0,) * len(wheels.letters))):
        for code in ("neutral", "no_wheel_begins"):
            world.hold(0.0, seconds=0.5)
            world.hold(0.5, seconds=5.0)
            assert world.state.code == code


@four_and_two
def test_a_way_that_dead_encoders_do_not_show_is_in_the_covariance(wheels: WheelMap) -> None:
    """It may be a robot that stands: nothing tells them apart."""
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    with world.mcu.switched(partial(replace, gains=(0.0,) * len(wheels.letters))):
        world.drive(0.08, seconds=20.0)
    assert world.state.x == 0.0
    true = world.mcu.vehicle.pose
    assert 1.4 < true.x < 1.7
    assert true.x < 2.3 * math.sqrt(world.odom.pose.covariance[0])


@pytest.mark.variations(5)
@four_and_two
@pytest.mark.parametrize("fault", ["reversed_encoder", "frozen_encoder"])
def test_what_a_wheel_with_a_latched_fault_falsified_is_in_the_covariance(
    fault: str, wheels: WheelMap
) -> None:
    """All encoders of the right side lie; then the robot stands for some seconds."""
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.drive(0.3, seconds=2.0)
    right = [
        wheels.letters.index(motor[1]) for motor in wheels.motors if motor in ("+a", "+d", "+r")
    ]
    with ExitStack() as lies:
        for motor in right[: 1 if fault == "frozen_encoder" else 2]:
            lies.enter_context(world.mcu.fault(fault, motor))
        world.hold(0.3, seconds=2.0)
        world.hold(0.0, seconds=6.0)
    assert world.state.mode == "fault"
    true, odom = world.mcu.vehicle.pose, world.odom
    covariance, position = odom.pose.covariance, odom.pose.pose.position
    off = position.x - true.x, position.y - true.y, world.mcu.vehicle.turned - odom.yaw
    for error, variance in zip(off, (covariance[0], covariance[7], covariance[35]), strict=True):
        assert min(abs(error), 7.0) <= 4.0 * math.sqrt(variance) + 0.01
