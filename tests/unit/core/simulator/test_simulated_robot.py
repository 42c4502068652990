"""Tests of a simulated robot, which reports its true pose and its gyro's rate."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, SimConfig
from acsard.core.simulator.fake_mcu import MS, FakeMcu
from acsard.core.simulator.simulated_robot import OBSERVATION_PERIOD_NS, Observation, WatchedMcu

TRUE = Config(sim=SimConfig(motor_time_constant=0.0))
LINE = b"ap02.00,bn02.00,cn02.00,dp02.00\r\n"
RATE = 2.0 * 2 * 0.05 / 0.30
"""Turn rate that the line commands, rad/s."""


def observations(
    config: Config = TRUE, seconds: float = 1.0, step_ms: int = 5
) -> list[Observation]:
    """Return all observations of a robot that is commanded to turn from 100 ms on."""
    sights: list[Observation] = []
    mcu = WatchedMcu(config, 0, sights.append)
    for ms in range(0, int(seconds * 1000) + 1, step_ms):
        if ms >= 100 and ms % 20 == 0:
            mcu.receive(ms * MS, LINE)
        mcu.advance(ms * MS)
    return sights


def test_the_robot_is_observed_every_10_ms_for_any_step_size() -> None:
    for step_ms in (1, 5, 20):
        assert [sight.at_ns for sight in observations(step_ms=step_ms)] == [
            (n + 1) * OBSERVATION_PERIOD_NS for n in range(100)
        ]


def test_an_observation_has_the_true_pose_of_its_time() -> None:
    config = Config(sim=replace(TRUE.sim, track_multiplier=1.6))
    late, early = observations(config)[-1], observations(config)[49]
    turned = late.pose.yaw - early.pose.yaw
    assert turned == pytest.approx(RATE / 1.6 * 0.5)


def test_an_observed_board_answers_the_same_bytes() -> None:
    watched, alone = WatchedMcu(TRUE, 0, lambda sight: None), FakeMcu(TRUE)
    for mcu in (watched, alone):
        mcu.receive(0, LINE)
    assert watched.advance(100 * MS) == alone.advance(100 * MS) != b""


def test_the_next_observation_is_the_next_event_of_an_idle_board() -> None:
    mcu = WatchedMcu(TRUE, 7, lambda sight: None)
    assert mcu.next_ns() == 7 + OBSERVATION_PERIOD_NS
    mcu.receive(7, LINE)
    assert mcu.next_ns() < 7 + OBSERVATION_PERIOD_NS


def test_the_gyro_measures_the_true_turn_rate() -> None:
    sights = observations()
    assert [sight.gyro for sight in sights[50:]] == pytest.approx([RATE] * 50)
    assert sum(sight.gyro for sight in sights) * 0.01 == pytest.approx(sights[-1].pose.yaw)
