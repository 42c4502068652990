"""A pose that a fault of a wheel makes wrong is as uncertain, at once, or `state` says so.

The cases are those of `pose_faults.py`; `-m soak -s` runs all of them.
"""

from __future__ import annotations

import pytest

from tests.scenarios.pose_faults import Case, cases, run
from tests.wheels import TWO

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


@pytest.mark.soak
@pytest.mark.parametrize("case", list(cases()), ids=lambda case: case.name)
def test_no_wheel_fault_makes_a_wrong_pose_certain(case: Case) -> None:
    check(case)
