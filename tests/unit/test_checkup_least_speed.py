"""The check measures the least speed that moves each motor."""

from __future__ import annotations

import re

import pytest

from acsard.checkup import least_speed
from acsard.core.config.settings import Config, SimConfig
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, Robot


@FOUR_AND_TWO
@each(
    ("faults", "verdict", "figure"),
    [
        ([], "PASS", "0.3 rad/s"),
        (["dead_band=0.2"], "PASS", "0.3 rad/s"),
        (["dead_band=0.5"], "WARN", "0.6 rad/s"),
        (["dead_band=1.9"], "WARN", "2 rad/s"),
        (["dead_band=2.5"], "WARN", "3 rad/s"),
    ],
)
def test_the_least_speed_is_measured_and_the_motors_stand_afterwards(
    faults: list[str], verdict: str, figure: str, config: Config
) -> None:
    robot = Robot(*faults, config=config)
    motors = list(range(len(config.mcu.wheels.letters)))
    with robot.board() as board:
        found = least_speed.finding(board, motors, 0.05)
        assert max(map(abs, robot.mcu.vehicle.speeds)) < 0.1
    assert (found.verdict.rstrip("?"), found.figure) == (verdict, figure)
    if verdict == "WARN":
        (speed, linear) = map(float, re.findall(r"([\d.]+) (?:rad|m)/s", found.text)[:2])
        assert linear == pytest.approx(0.05 * speed, abs=0.005)


@each("counts", [16, 20, 48])
def test_a_coarse_encoder_is_no_motor_that_ignores_small_speeds(counts: int) -> None:
    with Robot(config=Config(sim=SimConfig(encoder_counts=counts))).board() as board:
        assert least_speed.finding(board, [0, 1, 2, 3], 0.05).verdict == "PASS"


def test_without_a_sound_motor_nothing_turns() -> None:
    robot = Robot()
    with robot.board() as board:
        assert least_speed.finding(board, [], 0.05).verdict == "SKIPPED"
    assert not robot.turned
