"""Tests of turns on the spot and of the distances that a person reads off."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.doubts import RefusedError
from acsard.calibration.guided.readings import Reading
from acsard.calibration.guided.setup import WIDEST
from acsard.calibration.guided.spins import (
    MOST_SPIN_S,
    effective,
    once_round,
    slant,
    turns,
)  # fmt: skip
from acsard.calibration.guided.steps import GuideError
from acsard.config.settings import DriveConfig
from tests.unit.calibration.cut import IDEAL
from tests.unit.calibration.guided.played import Player, usual_setup
from tests.unit.calibration.robots import Robot


@given(angle=st.floats(-1.3, 1.3), apart=st.floats(0.1, 1.0))
def test_two_distances_from_a_line_are_an_angle(angle: float, apart: float) -> None:
    """A turn to the left brings the front closer to a line on the robot's left."""
    half = apart / 2 * math.sin(angle)
    assert slant(1.0 - half, 1.0 + half, apart) == pytest.approx(angle, abs=1e-9)


def test_distances_that_no_robot_can_have_are_refused() -> None:
    with pytest.raises(RefusedError, match="measure again"):
        slant(0.1, 0.5, 0.25)


@pytest.mark.parametrize("track", [1.0, 1.7, WIDEST])
def test_a_first_turn_has_the_time_that_the_widest_track_takes(track: float) -> None:
    move = once_round(usual_setup(), "").moves[-1]
    assert move.angular * move.seconds / track > 2 * math.pi


@pytest.mark.parametrize("track", [1.0, 1.7, WIDEST])
@pytest.mark.parametrize("rate", [0.6, 1.2])
def test_there_is_time_for_the_turns(track: float, rate: float) -> None:
    setup = usual_setup()
    count = turns(setup, rate, track, 3)
    assert 1 <= count <= 3
    assert setup.turn(2 * math.pi * count, rate, track).seconds <= MOST_SPIN_S


def once(chi: float) -> Reading:
    """Return the reading of a first turn with this track, ended after about one revolution."""
    player = Player(replace(Robot(chi=chi), **IDEAL))  # type: ignore[arg-type]
    run = player.ride(once_round(usual_setup(), ""))
    return Reading((run,), "turned", player.yaw, 0.01)


@pytest.mark.parametrize("chi", [1.0, 1.6, 2.4])
@pytest.mark.parametrize("multiplier", [1.0, 1.6])
def test_one_turn_tells_the_track_whatever_is_configured(chi: float, multiplier: float) -> None:
    drive = DriveConfig(wheel_separation_multiplier=multiplier)
    assert effective(once(chi), drive) == pytest.approx(chi, rel=1e-3)


def test_a_turn_that_was_no_whole_one_is_told() -> None:
    half = once(2.4)
    with pytest.raises(GuideError, match="one whole turn"):
        effective(Reading(half.rides, "turned", math.pi, 0.01), DriveConfig())
