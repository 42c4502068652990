"""Tests of the uncertainty of the distance covered without lines."""

from __future__ import annotations

import pytest

from acsard.core.motion.gap_variance import GUESS, SPAN, Gaps
from acsard.core.values import REST, Twist

CRUISE = Twist(0.5, 0.5)


def test_until_it_is_measured_the_acceleration_is_guessed() -> None:
    along, yaw = Gaps().unseen(SPAN, CRUISE, CRUISE)
    assert along == pytest.approx((GUESS.linear * SPAN**2 / 2) ** 2)
    assert yaw == pytest.approx((GUESS.angular * SPAN**2 / 2) ** 2)


def test_a_steady_drive_makes_gaps_certain() -> None:
    gaps = Gaps()
    gaps.interrupt(CRUISE)
    guessed = gaps.unseen(0.3, CRUISE, CRUISE)
    for _ in range(6000):
        gaps.follow(CRUISE, 0.01)
    measured = gaps.unseen(0.3, CRUISE, CRUISE)
    assert measured[0] < 0.02 * guessed[0]
    assert measured[1] < 0.02 * guessed[1]


def test_a_jerky_drive_is_measured_as_what_it_is() -> None:
    # The speed alternates between 0.4 and 0.6 m/s every 0.1 s. A span begins and ends at one of
    # them.
    gaps = Gaps()
    for i in range(30_000):
        gaps.follow(Twist(0.4 if i // 10 % 2 else 0.6, 0.0), 0.01)
    along, yaw = gaps.unseen(SPAN, CRUISE, CRUISE)
    assert 0.004**2 < along < 0.02**2
    assert yaw < 1e-5


def test_standing_says_nothing_of_driving() -> None:
    gaps = Gaps()
    before = gaps.unseen(0.3, CRUISE, CRUISE)
    for _ in range(6000):
        gaps.follow(REST, 0.01)
    assert gaps.unseen(0.3, CRUISE, CRUISE) == before


def test_who_stood_before_and_after_was_nowhere() -> None:
    assert Gaps().unseen(5.0, REST, REST) == (0.0, 0.0)


def test_no_gap_is_longer_than_its_faster_speed_goes() -> None:
    along, yaw = Gaps().unseen(30.0, Twist(0.1, -0.2), Twist(-0.5, 0.1))
    assert (along, yaw) == pytest.approx((15.0**2, 6.0**2))


def test_a_line_between_them_makes_two_gaps_of_one() -> None:
    gaps = Gaps()
    first = gaps.bridge(0.3, CRUISE, CRUISE)
    gaps.follow(CRUISE, 0.01)
    assert gaps.bridge(0.3, CRUISE, CRUISE) == first
    assert gaps.bridge(0.3, CRUISE, CRUISE)[0] > 20 * first[0]
