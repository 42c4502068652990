"""Tests that play each guided calibration with simulated robots.

The simulated person reads to a few mm.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from acsard.calibration.guided.legs import MOST_S, setup
from acsard.calibration.guided.ways import KINDS
from acsard.calibration.solve import Calibration
from acsard.core.config.settings import Config, DriveConfig
from tests.unit.calibration.guided.played import Player, anyone, play, usual_setup
from tests.unit.calibration.robots import Drive, Robot, drive, wander
from tests.unit.calibration.test_solve import off

FEW, MANY = 1, 20

each_way = pytest.mark.parametrize("way", KINDS)
so_many = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.soak)])


@cache
def robots(way: str, count: int) -> list[tuple[Robot, Calibration, Player, Drive]]:
    """Return each robot, its calibration, its player, and a random drive.

    The calibration did not use the random drive.
    """
    made = []
    for seed in range(count):
        robot = anyone(seed)
        player = Player(robot, gyro=way == "gyro", places=way == "positions")
        found = play(KINDS[way].begin(usual_setup()), player)
        made.append((robot, found, player, drive(robot, wander(robot.rng, 300.0))))
    return made


@so_many
@each_way
def test_heading_is_ten_times_better_than_geometric(way: str, count: int) -> None:
    before = np.array([off(d, np.ones(3)) for _, _, _, d in robots(way, count)])
    after = np.array([off(d, c.found.values) for _, c, _, d in robots(way, count)])
    better = before / after
    rms = float(np.sqrt(np.mean(before**2) / np.mean(after**2)))
    print(f"{way}: heading {rms:.1f} times better, from {min(better):.1f} to {max(better):.1f}")
    # One robot in twenty may meet a floor that skids more in the drive that tests the calibration.
    assert rms >= 10
    assert np.mean(better >= 10) >= 0.95


@so_many
@each_way
def test_standard_deviations_cover_the_truth(way: str, count: int) -> None:
    z = []
    for robot, found, _, _ in robots(way, count):
        values, std = found.found.values, found.found.std
        z += [(values[0] - robot.chi * (1 + robot.rate * w)) / std[0] for w in (0, 0.5, 1)]
        z += [(values[1] - robot.left) / std[1], (values[2] - robot.right) / std[2]]
    rms = np.sqrt(np.mean(np.square(z)))
    print(f"{way}: {np.mean(np.abs(z) < 2):.1%} of z within 2, rms {rms:.2f}")
    assert np.mean(np.abs(z) < 2) >= (0.95 if count == MANY else 0.85)
    # Very large standard deviations would cover the truth as well, but they would be useless.
    assert count == FEW or rms > 0.3


@so_many
@each_way
def test_ninety_seconds_of_driving_are_enough(way: str, count: int) -> None:
    seconds = [player.driven_s for _, _, player, _ in robots(way, count)]
    print(f"{way}: {min(seconds):.0f} to {max(seconds):.0f} s driven")
    assert max(seconds) <= MOST_S


@each_way
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.6])
def test_no_track_makes_it_longer_than_it_may_be(way: str, separation: float) -> None:
    made = setup(Config(drive=DriveConfig(wheel_separation=separation)))
    tracks = [1.0 + 0.05 * step for step in range(31)]
    longest = max(KINDS[way].longest_s(made, track) for track in tracks)
    assert longest <= MOST_S
    assert f"at most {longest:.0f} s" in KINDS[way].told(made)


@each_way
def test_what_it_improves_is_told(way: str) -> None:
    for _, found, _, _ in robots(way, FEW):
        now, then = found.gain.turn.now, found.gain.turn.then
        assert now is not None
        assert then is not None
        assert then < now / 5
