"""A link that is lost and found many times a second hides no runaway and no lie, and makes none."""

from __future__ import annotations

import math
import random
from contextlib import nullcontext
from functools import partial

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, ControlConfig, McuConfig, SimConfig, WheelMap
from acsard.core.values import NS_PER_S
from tests.scenarios.pose_faults import judged
from tests.scenarios.world import World
from tests.wheels import four_and_two

COUNTS = 16, 20, 48, 400, 3200


def flickering(
    counts: int, wheels: WheelMap, *, declared: bool = True, checked: bool = False
) -> World:
    mcu = McuConfig(
        encoder_counts=counts if declared else 0, link_check="on" if checked else "off",
        wheels=wheels,
    )  # fmt: skip
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=counts)))
    world.run(0.2)
    return world


def faults(world: World) -> list[str]:
    return [cause.code for cause in world.state.causes if cause.code.startswith("wheel")]


def lose(world: World, seconds: float, *, unplug: bool) -> None:
    """Lose the lines of the board, or its port."""
    if unplug:
        mcu = world.mcu
        world.port.unplug()
        world.run(seconds)
        world.port.plug(mcu)
    else:
        with world.mcu.fault("mute"):
            world.run(seconds)


@pytest.mark.variations(13)
@pytest.mark.parametrize("unplug", [False, True])
@pytest.mark.parametrize("counts", [20, 400])
@pytest.mark.parametrize("lines_s", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("silent_s", [0.13, 0.2, 0.5])
@four_and_two
def test_a_runaway_behind_silences_is_found_within_two_metres(
    silent_s: float, lines_s: float, counts: int, unplug: bool, wheels: WheelMap
) -> None:
    """Time passes without lines, too: what was due before a stop is not due for ever."""
    world = flickering(counts, wheels)
    world.drive(0.5, seconds=2.0)
    mcu = world.mcu
    began = mcu.vehicle.pose.x
    with mcu.fault("pushed", 0.5):
        world.call("stop")
        while not faults(world) and mcu.vehicle.pose.x - began < 2.0:
            lose(world, silent_s, unplug=unplug)
            world.run(lines_s)
    assert faults(world)[0] == "wheel_runaway"


@pytest.mark.parametrize("unplug", [False, True])
@four_and_two
def test_time_passes_in_long_silences(unplug: bool, wheels: WheelMap) -> None:
    """Nobody knows what the wheels do in them: only the lines between them are evidence."""
    world = flickering(400, wheels)
    world.drive(0.5, seconds=2.0)
    seen_s = 0.0
    with world.mcu.fault("pushed", 0.5):
        world.call("stop")
        while not faults(world) and seen_s < 1.5:
            lose(world, 1.5, unplug=unplug)
            world.run(0.15)
            seen_s += 0.15
    assert faults(world)[0] == "wheel_runaway"


def slower_than_declared(wheels: WheelMap, period: float, each: float) -> World:
    """Return a world whose board reports so rarely that each line ends a silence."""
    mcu = McuConfig(wheels=wheels, encoder_counts=400, reply_period=period)
    world = World(
        Config(mcu=mcu, control=ControlConfig(rate=25.0), sim=SimConfig(encoder_counts=400))
    )
    world.mcu.fault("free_running", period).__enter__()
    world.run(0.5)
    world.mcu.fault("sparse_replies", each).__enter__()
    return world


@pytest.mark.variations(5)
@pytest.mark.parametrize("to_and_fro", [False, True])
@pytest.mark.parametrize(("period", "each"), [(0.02, 0.1), (0.1, 0.2), (0.2, 0.4)])
@four_and_two
def test_lines_of_which_each_ends_a_silence_show_a_runaway(
    period: float, each: float, to_and_fro: bool, wheels: WheelMap
) -> None:
    world = slower_than_declared(wheels, period, each)
    for _ in range(5):
        world.drive(0.5, seconds=2.0)
        if to_and_fro:
            world.drive(-0.5, 0.5, seconds=2.0)
    assert not faults(world), world.state.reason
    vehicle = world.mcu.vehicle
    began = vehicle.pose.x, vehicle.pose.y
    with world.mcu.fault("pushed", 0.5):
        world.call("stop")
        while not faults(world) and math.dist(began, (vehicle.pose.x, vehicle.pose.y)) < 2.0:
            world.run(0.1)
    assert faults(world)[0] == "wheel_runaway"


@pytest.mark.variations(61)
@pytest.mark.parametrize("seed", range(60))
@four_and_two
def test_a_sound_robot_behind_silences_latches_no_fault(seed: int, wheels: WheelMap) -> None:
    """The board is silent, the computer stalls, both, or the port is lost."""
    dice = random.Random(seed)
    checked, declared = dice.random() < 0.5, dice.random() < 0.6
    world = flickering(dice.choice(COUNTS), wheels, declared=declared, checked=checked)
    silent, lines = dice.uniform(0.05, 0.5), dice.uniform(0.05, 0.5)
    mute, stall, unplug = dice.choice(
        [(True, False, False), (False, True, False), (True, True, False), (False, False, True)]
    )
    mcu = world.mcu
    world.drive(0.3, seconds=1.0)
    end_ns = world.now_ns + 20 * NS_PER_S
    while world.now_ns < end_ns:
        wish = dice.choice([(0.5, 0.0), (dice.uniform(-1, 1), dice.uniform(-2, 2))])
        for _ in range(dice.randrange(1, 6)):
            seconds = silent * dice.uniform(0.7, 1.3)
            if unplug:
                world.port.unplug()
            with world.mcu.fault("mute") if mute else nullcontext():
                if stall:
                    world.stall(seconds)
                else:
                    world.hold(*wish, seconds=seconds)
            if unplug:
                world.port.plug(mcu)
            world.send(*wish)
            world.hold(*wish, seconds=lines * dice.uniform(0.7, 1.3))
            assert not faults(world), world.state.reason


@pytest.mark.variations(4)
@pytest.mark.parametrize("lines_s", [0.1, 0.3])
@pytest.mark.parametrize("gain", [-1.0, 0.0, 0.5, 2.0])
@four_and_two
def test_encoders_that_lie_behind_silences_are_in_doubt(
    gain: float, lines_s: float, wheels: WheelMap
) -> None:
    """Nobody knows what the board obeyed in a silence, so what was commanded may be the truth."""
    world = flickering(3200, wheels)
    world.run(1.3)
    world.drive(0.4, seconds=2.0)
    mcu, end_ns = world.mcu, world.now_ns + 8 * NS_PER_S
    with mcu.switched(partial(replace, gains=(gain,) * len(mcu.switches.gains))):
        while world.now_ns < end_ns and world.state.mode != "fault":
            with mcu.fault("mute"):
                world.hold(0.4, seconds=0.08)
            world.hold(0.4, seconds=lines_s)
            value, _, _ = judged(world)
            assert value < 6.0 or world.state.pose_doubt
