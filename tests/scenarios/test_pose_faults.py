"""A pose that a fault of a wheel makes wrong is as uncertain, at once, or `state` says so.

The cases are those of `pose_faults.py`; `-m soak -s` runs all of them.
"""

from __future__ import annotations

from functools import partial

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, WheelMap
from tests.scenarios.pose_faults import Case, cases, judged, run
from tests.scenarios.world import World
from tests.wheels import TWO, four_and_two

SOME = [
    Case("runaway motor", "rear_left", "to and fro"), Case("dead encoder", "left", "stop and go"),
    Case("reversed encoder", "left", "straight", TWO), Case("half", "rear_right", "slalom"),
    Case("1.5 times", "left", "stop and go", TWO), Case("frozen encoder", "all", "slalom"),
    Case("swapped encoders", "right left", "slalom", TWO), Case("dead encoder", "all", "back"),
    Case("dead motor", "rear_right", "on the spot"), Case("a fifth too slow", "all", "slalom", TWO),
    Case("swapped motors", "front_right front_left", "turning"),
    Case("twice", "all", "turning", TWO, gyro=True),
    Case("a fifth too fast", "all", "straight", TWO, checked=True, silence=0.6),
    Case("half", "left", "to and fro", checked=True, silence=0.3, mute=True),
    Case("dead encoder", "left", "slalom", checked=True, silence=0.6),
    Case("twice", "all", "to and fro", TWO, checked=True, silence=0.6),
    Case("reversed encoder", "left", "turning", silence=0.3, mute=True),
    Case("reversed encoder", "left", "to and fro", declared=False),
    Case("half", "left", "straight", TWO, declared=False),
    Case("twice", "left", "straight", counts=20), Case("half", "all", "straight", counts=16),
]  # fmt: skip


def check(case: Case) -> None:
    result = run(case)
    assert result.unsaid < 6.0, result


@pytest.mark.variations(9)
@pytest.mark.parametrize("case", SOME, ids=lambda case: case.name)
def test_a_wheel_fault_never_makes_a_wrong_pose_certain(case: Case) -> None:
    check(case)


@pytest.mark.parametrize("seconds", [0.15, 0.6])
@four_and_two
def test_a_silence_hides_no_difference_behind_it(seconds: float, wheels: WheelMap) -> None:
    world = World(Config(mcu=McuConfig(wheels=wheels)))
    world.run(1.5)
    world.drive(0.4, seconds=1.0)
    world.stall(seconds)
    with world.mcu.switched(partial(replace, gains=(0.5,) * len(world.mcu.switches.gains))):
        world.drive(0.4, seconds=12.0)
    assert world.state.pose_doubt == "wheels_and_commands_differ"


@pytest.mark.parametrize("gain", [0.0, 2.0])
def test_a_press_in_a_silence_hides_nothing_before_it(gain: float) -> None:
    world = World(Config(mcu=McuConfig(link_check="on", encoder_counts=3200)))
    mcu = world.mcu
    with mcu.fault("estop"):
        world.run(1.5)
        world.drive(0.4, seconds=2.0)
        with mcu.switched(partial(replace, gains=(gain,) * len(mcu.switches.gains))):
            with mcu.fault("estop_pressed", 0.2, 1.0):
                world.stall(0.6)
                world.hold(0.0, 0.0, 1.0)
            assert judged(world)[0] < 6.0


@pytest.mark.parametrize(("gain", "mute_s", "lines_s"), [(0.8, 0.08, 0.1), (2.0, 0.3, 0.3)])
def test_lying_encoders_behind_a_flickering_link_are_in_doubt(
    gain: float, mute_s: float, lines_s: float
) -> None:
    """In a silence the command is larger than at its ends, and the robot follows it."""
    world = World(Config(mcu=McuConfig(encoder_counts=3200)))
    world.run(1.5)
    world.drive(0.4, seconds=2.0)
    mcu = world.mcu
    with mcu.switched(partial(replace, gains=(gain,) * len(mcu.switches.gains))):
        for _ in range(40):
            with mcu.fault("mute"):
                world.hold(0.4, seconds=mute_s)
            world.hold(0.4, seconds=lines_s)
            assert judged(world)[0] < 6.0 or world.state.pose_doubt


@pytest.mark.soak
@pytest.mark.parametrize(
    "case", [c for c in cases() if c.silence < 0.5], ids=lambda case: case.name
)
def test_no_wheel_fault_makes_a_wrong_pose_certain(case: Case) -> None:
    check(case)
