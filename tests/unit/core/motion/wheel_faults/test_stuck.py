"""A stuck encoder is distinguished from a steady wheel.

The command and the other wheel of the side show the difference.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.wheel_faults.stuck import Stuck

DT = 0.01
FINE = math.tau / 3200
SLOW_S = 0.25
"""Time in which a slow wheel completes most of a change, s."""


def after(acceleration: float, other: float = 1.0, same: bool = True, count: float = FINE) -> float:
    """Return the time until a wheel that still reports 10 rad/s is found stuck, s.

    The time starts when the command leaves 10 rad/s. The other wheel follows the change by the
    share `other`. The result is inf if one second is not enough.
    """
    stuck, slow, command, turned = Stuck(), 10.0, 10.0, 10.0
    for line in range(200):
        command += acceleration * DT if line >= 100 else 0.0
        slow += (command - slow) * DT / (SLOW_S + DT)
        turned = 10.0 + other * (command - 10.0)
        if stuck.says(same, (turned - 10.0) * DT, DT, count, slow, command):
            return (line - 99) * DT
    return math.inf


@pytest.mark.parametrize("acceleration", [20.0, 32.0, -20.0, -32.0])
def test_it_is_out_within_50_ms_of_being_2_rad_s_wrong(acceleration: float) -> None:
    assert after(acceleration) <= 2.0 / abs(acceleration) + 0.05


def test_a_steady_wheel_says_the_same_for_ever() -> None:
    assert after(0.0) == math.inf


def test_a_wheel_that_says_another_speed_is_not_stuck() -> None:
    assert after(20.0, same=False) == math.inf


def test_if_neither_wheel_follows_it_is_the_command_that_is_not_obeyed() -> None:
    assert after(20.0, other=0.0) == math.inf
    assert after(20.0, other=-1.0) == math.inf


@pytest.mark.parametrize("counts", [96, 400])
def test_coarser_encoders_need_more_turn_to_tell(counts: int) -> None:
    assert after(20.0) < after(20.0, count=math.tau / counts)


def test_a_speed_that_changes_in_between_begins_it_anew() -> None:
    stuck = Stuck()
    for line in range(1, 100):
        command = 10.0 + 0.2 * line
        found = stuck.says(line % 3 != 0, 0.002 * line, DT, FINE, command - 1.0, command)
        assert not found


@given(st.floats(0.0, 1.0), st.floats(0.02, 0.1), st.sampled_from([16, 96, 400, 3200]))
def test_a_sound_wheel_with_an_encoder_of_any_kind_is_not_stuck(
    phase: float, lag: float, counts: int
) -> None:
    stuck, count = Stuck(), math.tau / counts
    slow = command = speed = 10.0
    angles, said = [phase * count, 0.0], [0, 0]
    last = None
    for line in range(300):
        command += 0.2 if 100 <= line < 160 else 0.0
        slow += (command - slow) * DT / (SLOW_S + DT)
        speed += (command - speed) * DT / (lag + DT)
        angles = [angle + speed * DT for angle in angles]
        own, other = (  # both are whole counts
            math.floor(angle / count) - before for angle, before in zip(angles, said, strict=True)
        )
        said = [said[0] + own, said[1] + other]
        assert not stuck.says(own == last, (other - own) * count, DT, count, slow, command)
        last = own
