"""Tests that play each guided calibration with simulated robots.

The simulated person reads the tape with errors of a few mm.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from acsard.calibration.guided.drive_plan import (
    MAX_TRACK_RATIO,
    NEEDS,
    GuideError,
    Slant,
    setup,
)
from acsard.calibration.guided.methods import METHODS
from acsard.calibration.guided.runner import guide
from acsard.calibration.log_table import LogError, NoCalibrationError
from acsard.calibration.solve import Calibration
from acsard.core.config.settings import Config, DriveConfig
from acsard.terminal.prompt import NumberQuestion
from tests.unit.calibration.guided.played import (
    PlayedPrompt,
    Player,
    anyone,
    leg,
    play,
    usual_setup,
)
from tests.unit.calibration.robots import Drive, Robot, drive, wander
from tests.unit.calibration.test_solve import off

FEW, MANY = 1, 20

MAX_DRIVE_S = 90.0
"""Limit for the total driving time of all legs of a method, s."""

each_way = pytest.mark.parametrize("way", METHODS)
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
        calibration = play(way, player)
        made.append((robot, calibration, player, drive(robot, wander(robot.rng, 300.0))))
    return made


@pytest.mark.variations(5)
@so_many
@each_way
def test_heading_is_ten_times_better_than_geometric(way: str, count: int) -> None:
    before = np.array([off(d, np.ones(3)) for _, _, _, d in robots(way, count)])
    after = np.array([off(d, c.multipliers.values) for _, c, _, d in robots(way, count)])
    better = before / after
    rms = float(np.sqrt(np.mean(before**2) / np.mean(after**2)))
    print(f"{way}: heading {rms:.1f} times better, from {min(better):.1f} to {max(better):.1f}")
    # One robot in twenty may meet a floor that skids more in the drive that tests the calibration.
    assert rms >= 10
    assert np.mean(better >= 10) >= 0.95


@pytest.mark.slow
@so_many
@each_way
def test_standard_deviations_cover_the_truth(way: str, count: int) -> None:
    z = []
    for robot, calibration, player, _ in robots(way, count):
        values, std = calibration.multipliers.values, calibration.multipliers.std
        # The track is the best constant one, at the mean rate of all turns.
        turned = np.concatenate([np.diff(made.yaw) for made in player.drives])
        seconds = np.concatenate([np.diff(made.t) for made in player.drives])
        rate = float(np.sum(turned**2 / seconds) / np.sum(np.abs(turned)))
        z += [(values[0] - robot.chi * (1 + robot.rate * rate)) / std[0]]
        z += [(values[1] - robot.left) / std[1], (values[2] - robot.right) / std[2]]
    rms = np.sqrt(np.mean(np.square(z)))
    print(f"{way}: {np.mean(np.abs(z) < 2):.1%} of z within 2, rms {rms:.2f}")
    assert np.mean(np.abs(z) < 2) >= (0.9 if count == MANY else 0.85)
    # Very large standard deviations would cover the truth as well, but they would be useless.
    assert count == FEW or rms > 0.3


@pytest.mark.variations(5)
@so_many
@each_way
def test_ninety_seconds_of_driving_are_enough(way: str, count: int) -> None:
    seconds = [player.driven_s for _, _, player, _ in robots(way, count)]
    print(f"{way}: {min(seconds):.0f} to {max(seconds):.0f} s driven")
    assert max(seconds) <= MAX_DRIVE_S


@each_way
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.6])
def test_no_track_makes_a_method_longer_than_its_limit(way: str, separation: float) -> None:
    made = setup(Config(drive=DriveConfig(wheel_separation=separation)))
    tracks = [1.0 + 0.05 * step for step in range(31)]
    longest = max(sum(leg.seconds for leg in METHODS[way].legs(made, track)) for track in tracks)
    assert METHODS[way].longest_s(made) == longest <= MAX_DRIVE_S


@each_way
def test_the_improvement_is_reported(way: str) -> None:
    for _, calibration, _, _ in robots(way, FEW):
        worth = calibration.improvement
        # Only a heading sensor or a tape measures a turn itself.
        error = worth.place if way == "positions" else worth.turn
        now, then = error.before, error.after
        assert now is not None
        assert then is not None
        assert then < now / 4


# the legs of each way


class Talk(PlayedPrompt):
    """A prompt that records what it shows and asks."""

    def __init__(self, player: Player) -> None:
        super().__init__(player)
        self.shown: list[str] = []
        self.asked: list[NumberQuestion] = []

    def show_text(self, text: str) -> None:
        self.shown.append(text)

    def start(self, text: str) -> None:
        self.shown.append(text)

    def number(self, ask: NumberQuestion) -> float:
        self.asked.append(ask)
        return super().number(ask)


@cache
def talk(way: str) -> Talk:
    player = Player(anyone(0), gyro=way == "gyro", places=way == "positions")
    talk = Talk(player)
    guide(way, usual_setup(), talk, player.ride)
    return talk


@pytest.mark.variations(5)
@each_way
def test_a_person_reads_what_is_needed_and_how_long_each_leg_takes(way: str) -> None:
    first, *legs = talk(way).shown
    assert first.startswith(f"Calibration with {NEEDS[way]}. The robot drives for at most ")
    assert f" {METHODS[way].longest_s(usual_setup()):.0f} s in total, in several legs." in first
    assert [text.split(".")[0] for text in legs] == [str(n + 1) for n in range(len(legs))]
    assert all(text.endswith(" s)") for text in legs)


@each_way
def test_the_names_of_a_method_are_unique_and_refer_to_its_earlier_legs(way: str) -> None:
    table = METHODS[way]
    legs = table.legs(usual_setup(), 1.6)
    names = [leg.name for leg in legs]
    assert len(set(names)) == len(names)
    for number, stage in enumerate(legs):
        asked = [ask.name for ask in stage.asks]
        assert len(set(asked)) == len(asked)
        for measure in stage.measures:
            if isinstance(measure, Slant):
                assert set(measure.over) <= set(names[: number + 1])
                assert {measure.near, measure.far} <= set(asked)
                assert measure.apart in {ask.name for ask in table.asks}
                assert measure.since in ("", *names[:number])
            else:
                assert measure.answer in asked


@each_way
def test_legs_before_the_track_is_known_do_not_depend_on_it(way: str) -> None:
    narrow, wide = (METHODS[way].legs(usual_setup(), track) for track in (1.0, MAX_TRACK_RATIO))
    for first, other in zip(narrow, wide, strict=True):
        assert first == other
        if any(isinstance(m, Slant) and m.quantity == "turned" for m in first.measures):
            break


class Hasty(Player):
    """A person who ends the first turn after less than half a revolution."""

    def _round_s(self, angular: float) -> float:
        return super()._round_s(angular) / 2.3


def test_a_first_turn_that_was_ended_half_way_is_refused() -> None:
    with pytest.raises(GuideError, match="exactly one turn"):
        play("tape", Hasty(Robot(chi=1.7)))


def test_short_lengths_are_asked_in_mm_and_the_long_one_in_m() -> None:
    units = [ask.unit for ask in talk("tape").asked]
    assert units.count("m") == 1
    assert set(units) == {"mm", "m"}


class Blind(Player):
    """A person without a tape, who answers each question with its default."""

    def answer(self, ask: NumberQuestion) -> float:
        assert ask.usual is not None
        return ask.usual


def test_a_tape_beside_the_gyro_measures_the_wheels() -> None:
    robot = replace(anyone(3), left=0.95, right=0.952)
    calibration = play("gyro", Player(robot, gyro=True))
    assert calibration.scale == "distance"
    assert calibration.multipliers.values[1] == pytest.approx(0.95, rel=0.02)


def test_without_a_tape_the_mean_wheel_radius_stays_as_configured() -> None:
    calibration = play("gyro", Blind(anyone(3), gyro=True))
    assert calibration.scale == ""
    assert calibration.multipliers.values[1:].mean() == pytest.approx(1.0, abs=1e-6)


def test_a_gyro_with_a_constant_value_is_refused() -> None:
    robot = replace(anyone(3), gyro_noise=0.0, gyro_hz=0.001)
    with pytest.raises((LogError, NoCalibrationError), match=r"gyro|record"):
        play("gyro", Blind(robot, gyro=True))


@pytest.mark.parametrize("way", ["gyro", "positions"])
def test_every_curve_is_driven_back(way: str) -> None:
    curves = [move for move in leg(way, "turns").moves if move.linear and move.angular]
    assert sum(move.angular * move.seconds for move in curves) == pytest.approx(0.0)
    assert sum(move.linear * move.seconds for move in curves) == pytest.approx(0.0)
