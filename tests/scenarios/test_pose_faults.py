"""A pose that a fault of a wheel makes wrong is as uncertain, at once, or `state` says so.

The cases are those of `pose_faults.py`; `-m soak -s` runs all of them.
"""

from __future__ import annotations

from functools import partial

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, WheelMap
from tests.scenarios.pose_faults import Case, cases, run
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


@pytest.mark.soak
@pytest.mark.parametrize(
    "case", [c for c in cases() if c.silence < 0.5 and not c.mute], ids=lambda case: case.name
)
def test_no_wheel_fault_makes_a_wrong_pose_certain(case: Case) -> None:
    check(case)
