"""Tests that compare gyro and wheels: turn ratio and contradiction."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.motion.gyro_match import INITIAL_RATIO_STD, MIN_RATIO_STD, Match

DT = 0.01
QUANTUM = math.tau / 3200 * 0.05 / 0.30
"""Turn of the robot for one encoder count on both wheels of one side, rad."""

Rate = Callable[[float], float]


def stirring(t: float) -> float:
    """Return a turn rate of the wheels that varies on several time scales, rad/s."""
    return math.sin(1.3 * t) + 0.6 * math.sin(3.1 * t + 1.0)


def matched(seconds: float, ratio: float = 0.6, delay: float = 0.0, rate: Rate = stirring) -> Match:
    match, total = Match(), 0.0
    turned = 0.0
    for n in range(round(seconds / DT)):
        turned += rate(n * DT) * DT
        wheels = round(turned / QUANTUM) * QUANTUM - total
        total += wheels
        match.add(wheels, ratio * rate(n * DT - delay) * DT, DT, slips=False)
    return match


def test_the_first_ratio_is_one_with_a_rough_deviation() -> None:
    assert (Match().ratio, Match().deviation) == (1.0, INITIAL_RATIO_STD)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.4, 1.5), st.floats(-0.04, 0.1))
def test_the_ratio_is_found_whatever_the_delay(ratio: float, delay: float) -> None:
    match = matched(20.0, ratio, delay)
    assert match.ratio == pytest.approx(ratio, rel=0.03)
    assert match.deviation == MIN_RATIO_STD


@pytest.mark.parametrize("delay", [-0.04, 0.12])
def test_the_encoder_counts_of_a_straight_drive_do_not_change_the_ratio(delay: float) -> None:
    for seed in range(20):
        match, dice, before = matched(6.0, 0.625, delay), random.Random(seed), 0
        for _ in range(4000):
            now = dice.choice((0, 1))
            match.add((now - before) * 0.003, dice.gauss(0.0, 5e-5), DT, slips=False)
            before = now
        assert match.ratio == pytest.approx(0.625, abs=0.05)


def test_nothing_is_learned_while_the_robot_rests() -> None:
    match = matched(30.0, rate=lambda t: 0.0)
    assert (match.ratio, match.blocks) == (1.0, 0.0)


def slipping(match: Match, seconds: float, wheels: float, gyro: float) -> list[bool]:
    flags = []
    for _ in range(round(seconds / DT)):
        match.add(wheels * DT, gyro * DT, DT, slips=True)
        flags.append(match.contradiction(1e-6))
    return flags


def test_a_gyro_at_rest_contradicts_turning_wheels_within_a_quarter_of_a_second() -> None:
    match = matched(20.0)
    slipping(match, 1.0, 1.0, 0.6)
    flags = slipping(match, 0.25, 1.0, 0.0)
    assert flags[-1]
    assert not flags[0]


@pytest.mark.parametrize("share", [0.85, 1.0, 1.15])
def test_a_slightly_different_floor_is_no_contradiction(share: float) -> None:
    match = matched(20.0)
    assert not any(slipping(match, 2.0, 1.0, 0.6 * share))


def test_a_late_gyro_does_not_contradict_the_wheels() -> None:
    match, count = Match(), 0
    for n in range(3000):
        t = n * DT
        match.add(stirring(t) * DT, 0.6 * stirring(t - 0.05) * DT, DT, slips=False)
        count += match.contradiction(1e-6)
    assert count == 0


def test_the_ratio_is_not_learned_during_slip() -> None:
    match = matched(20.0)
    slipping(match, 1.0, 1.0, 0.0)  # the blocks before the slip are still learned
    before = match.ratio
    slipping(match, 20.0, 1.0, 0.0)
    assert match.ratio == before
