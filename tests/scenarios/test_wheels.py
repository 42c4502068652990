"""An encoder or motor of one wheel fails; the robot stops and names the wheel."""

from __future__ import annotations

import itertools
import math
from itertools import product

import pytest

from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import (
    Config,
    ControlConfig,
    FeedbackConfig,
    LimitsConfig,
    McuConfig,
    SimConfig,
)
from acsard.core.motion.wheels import (
    BLOCK_S,
    FAULT_ANGLE,
    FAULT_COUNTS,
    FAULT_RESPONSES,
    count_angle,
)
from acsard.core.simulator.faults import Fault
from acsard.core.values import NS_PER_S, WHEELS, Received
from tests.scenarios.world import World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def stopped(world: World) -> bool:
    return world.mcu.vehicle.set_points == [0.0] * 4


@pytest.mark.variations(6)
@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("kind", ["reversed", "runaway"])
def test_a_faulty_encoder_stops_the_robot_and_is_named(world: World, wheel: int, kind: str) -> None:
    world.drive(0.5, seconds=1.5)
    faults: dict[str, Fault] = {
        "reversed": world.mcu.bias(wheel, -1.0),
        "runaway": world.mcu.bias(wheel, 2.0),
    }
    with faults[kind]:
        world.hold(0.5, seconds=2.0)
        assert world.state.mode == "fault"
        assert WHEELS[wheel] in world.state.reason
        assert stopped(world)
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "fault"
    assert world.call("clear").success
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "driving"


def test_repeated_impossible_lines_are_a_fault_within_thirty_milliseconds(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    x = world.state.x
    with world.mcu.bias(3, 9.0):
        world.hold(0.5, seconds=0.05, hz=20.0)
        assert world.state.mode == "fault"
        assert "rear_right" in world.state.reason
        world.run(1.0)
    assert stopped(world)
    assert world.state.x == pytest.approx(x, abs=0.2)


@pytest.mark.parametrize(
    ("counts", "known", "rate", "bound"),
    [
        (16, False, 100.0, 5.0),
        (96, False, 100.0, 5.0),
        (400, False, 300.0, 4.5),
        (96, True, 100.0, 5.0),
    ],
)
def test_one_count_is_no_impossible_speed_although_it_looks_faster_than_the_bound(
    counts: int, known: bool, rate: float, bound: float
) -> None:
    """At 100 Hz and 96 counts per turn, one count in a line looks like 6.5 rad/s.

    The daemon must not treat that as an impossible speed.
    """
    world = World(
        Config(
            mcu=McuConfig(encoder_counts=counts if known else 0),
            control=ControlConfig(rate=rate),
            limits=LimitsConfig(linear_speed=0.2, angular_speed=1.0, wheel_speed=4.0),
            feedback=FeedbackConfig(wheel_speed=bound),
            sim=SimConfig(encoder_counts=counts),
        )
    )
    assert contradictions(world.config) == []
    world.run(1.0)
    for speed in (0.2, -0.2, 0.2):
        world.drive(speed, seconds=2.0)
        assert (world.state.mode, event_texts(world, "fault")) == ("driving", [])
        world.send(0.0)
        world.run(0.5)
    assert world.state.counters.get("line_implausible", 0) <= 10


# damage


def damage(world: World, silence: float, number: int, place: int, bits: int) -> None:
    """Lose all replies for `silence` seconds, and damage one later reply.

    Args:
        world: The robot with its board.
        silence: The time in which all replies are lost, s.
        number: The number of the damaged reply after the silence, from 1.
        place: The index of the damaged byte.
        bits: A mask of the bits to invert.
    """
    feed, begun_ns, replies = world.port.feed, world.now_ns, itertools.count(1)

    def through_the_wire(received: Received) -> None:
        if received.at.mono_ns < begun_ns + silence * NS_PER_S:
            return
        data = bytearray(received.data)
        if next(replies) == number:
            data[place] ^= bits
        feed(Received(received.at, bytes(data)))

    world.port.feed = through_the_wire  # type: ignore[method-assign]


def off_by(world: World) -> tuple[float, float]:
    """Return the error of the pose in m and in rad."""
    pose, true = world.state, world.mcu.vehicle.pose
    turned = math.remainder(pose.yaw - true.yaw, math.tau)
    return math.dist((pose.x, pose.y), (true.x, true.y)), abs(turned)


TENS, ONES = (2, 10, 18, 26), (3, 11, 19, 27)
"""Places of the tens and of the ones digits of the four speeds in a reply."""

FLIPS = [(TENS[0], 8), (TENS[1], 1), (ONES[2], 8), (ONES[3], 2)]


@pytest.mark.variations(6)
@pytest.mark.parametrize("drives", [False, True])
@pytest.mark.parametrize("silence", [0.06, 0.2, 0.3, 0.6, 0.9])
def test_a_bit_flipped_in_the_first_line_after_a_silence_is_in_the_covariance(
    drives: bool, silence: float
) -> None:
    for place, bits in [(0, 0), *FLIPS]:
        world = World()
        world.run(1.0)
        if drives:
            world.drive(0.5, 0.8, seconds=1.0)
        damage(world, silence, 1, place, bits)
        for _ in range(20):
            if drives:
                world.send(0.5, 0.8)
            world.run(0.1)
        assert event_texts(world, "fault") == []
        metres, turned = off_by(world)
        p = world.odom.pose.covariance
        assert metres < max(0.03, 3.0 * math.sqrt(p[0] + p[7]))
        assert turned < max(0.06, 3.0 * math.sqrt(p[35]))


# hands


def event_texts(world: World, name: str) -> list[str]:
    return [event.text for event in world.events if event.name == name]


@pytest.mark.parametrize("verb", ["", "deactivate", "stop"])
def test_wheels_turned_by_hand_are_reported_at_most_once_a_second_and_counted(
    world: World, verb: str
) -> None:
    if verb:
        world.call(verb)
    world.run(2.0)
    mode = world.state.mode
    with world.mcu.pushed(0.12):
        world.run(4.0)
    assert world.state.mode == mode
    reports = len(event_texts(world, "uncommanded_motion"))
    assert 3 <= reports == world.state.counters["uncommanded_motion"] <= 4


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("linear", "way"), list(product((0.2, 0.5, -1.0), ("stop", "zero", "silence")))
)
def test_a_robot_that_does_not_obey_a_stop_is_a_fault_as_soon_as_it_is_evident(
    world: World, linear: float, way: str
) -> None:
    """Hands push the robot on at its speed during a stop. The daemon latches a fault.

    To the daemon this looks like motors that do not obey. It is evident after the ramp of the stop
    (and the timeout of the silent source), when the wheels rolled on without an approach for three
    response times and for 1 rad and 3 counts; the law looks at whole blocks.
    """
    config = world.config
    slowing = {"stop": config.limits.linear_stop_deceleration}
    ramp = abs(linear) / slowing.get(way, config.limits.linear_deceleration)
    if way == "silence":
        ramp += next(s.timeout for s in config.commands.sources if s.name == "app")
    rolling = max(FAULT_ANGLE, FAULT_COUNTS * count_angle(config.mcu.encoder_counts))
    rolls = rolling * config.drive.wheel_radius / abs(linear)
    within = ramp + max(FAULT_RESPONSES * config.feedback.response_time, rolls) + 2 * BLOCK_S
    world.drive(linear, seconds=2.0)
    began_ns = world.now_ns
    with world.mcu.pushed(linear):
        if way == "stop":
            world.put("stop", b"")
        while world.state.mode != "fault" and world.now_ns - began_ns < 3 * NS_PER_S:
            if way == "zero":
                world.send(0.0)
            world.run(0.02)
    took = (world.now_ns - began_ns) / NS_PER_S
    assert world.state.code == "wheel_runaway"
    assert took <= within + 0.021


def test_a_robot_that_still_rolls_after_a_lost_link_is_a_runaway(world: World) -> None:
    """The robot was driving when the link was lost, and still moves when the link returns.

    An MCU without a watchdog behaves like this, so the daemon latches a fault.
    """
    world.drive(0.5, seconds=1.0)
    mcu = world.mcu
    with mcu.no_watchdog(), mcu.pushed(0.5):
        world.port.unplug()
        world.run(0.5)
        world.port.plug(mcu)
        world.run(2.0)
    assert world.state.code == "wheel_runaway"


def test_a_computer_that_stutters_makes_no_fault_of_a_sound_wheel_with_counts() -> None:
    """A line that ends a silence has the counts of all of it."""
    world = World(
        Config(mcu=McuConfig(link_check="on", encoder_counts=20), sim=SimConfig(encoder_counts=20))
    )
    world.run(0.2)
    world.drive(0.6, seconds=1.5)
    for number in range(120):
        world.stall(0.1 + 0.005 * (number % 8))
        world.send(0.6)
        world.run(0.001 + 0.002 * (number % 7))
        assert world.state.mode != "fault", world.state.reason
