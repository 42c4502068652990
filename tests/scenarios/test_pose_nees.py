"""NEES of the pose over drawn robots, for each row of `pose_nees.py`: at most 6 on average.

`-m soak -s` tries 20 fresh robots of each row, and prints the figures.
"""

from __future__ import annotations

from time import time_ns

import pytest

from acsard.core.config.settings import WheelMap
from tests.scenarios.pose_nees import ROWS, run
from tests.wheels import four_and_two


def check(name: str, wheels: WheelMap, first: int, robots: int) -> None:
    results = [run(ROWS[name], first + seed, wheels) for seed in range(robots)]
    mean = sum(result.nees for result in results) / robots
    print(f"\n{name}, {len(wheels.names)} wheels, seeds from {first}: NEES {mean:.2f}", end="")
    assert mean < 6.0


@pytest.mark.slow
@pytest.mark.variations(60)
@pytest.mark.parametrize("name", ROWS)
@four_and_two
def test_a_pose_is_as_uncertain_as_it_is_wrong(name: str, wheels: WheelMap) -> None:
    check(name, wheels, 7000, 3)


@pytest.mark.soak
@pytest.mark.parametrize("name", ROWS)
@four_and_two
def test_the_poses_of_fresh_robots_are_as_uncertain_as_they_are_wrong(
    name: str, wheels: WheelMap
) -> None:
    check(name, wheels, time_ns() // 1_000_000_000 % 1_000_000 * 100, 20)
