"""Tests that compare gyro and wheels: turn ratio, delay and contradiction."""

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


def test_the_first_ratio_is_one_with_a_rough_deviation_and_no_delay() -> None:
    assert (Match().ratio, Match().deviation) == (1.0, INITIAL_RATIO_STD)
    assert Match().delay() is None


@settings(max_examples=20, deadline=None)
@given(st.floats(0.4, 1.5), st.floats(-0.04, 0.1))
def test_the_ratio_is_found_whatever_the_delay(ratio: float, delay: float) -> None:
    match = matched(20.0, ratio, delay)
    assert match.ratio == pytest.approx(ratio, rel=0.03)
    assert match.deviation == MIN_RATIO_STD


@settings(max_examples=20, deadline=None)
@given(st.floats(0.4, 1.5), st.floats(-0.05, 0.05))
def test_the_delay_is_found_to_a_few_milliseconds(ratio: float, delay: float) -> None:
    result = matched(20.0, ratio, delay).delay()
    assert result is not None
    assert result == pytest.approx(delay, abs=0.006)


def test_a_delay_is_reported_only_once() -> None:
    match = matched(20.0, delay=0.05)
    assert match.delay() is not None
    assert match.delay() is None


@pytest.mark.parametrize("rate", [0.0, 0.8], ids=["standing", "turning steadily"])
def test_no_delay_is_found_without_a_change_of_the_turn_rate(rate: float) -> None:
    assert matched(30.0, rate=lambda t: rate).delay() is None


def test_the_encoder_counts_of_a_straight_drive_show_no_delay() -> None:
    match = matched(20.0, ratio=1.0)
    match.delay()
    dice, count = random.Random(1), math.tau / 400 * 0.125 / 0.266
    before = 0
    for _ in range(2000):
        # The sides differ by a count or not, as their fractions of counts happen to fall.
        now = dice.choice((0, 1))
        match.add((now - before) * count, dice.gauss(0.0, 1e-4), 0.05, slips=False)
        before = now
    result = match.delay()
    assert result is None or abs(result) < 0.005


@pytest.mark.parametrize("delay", [-0.04, 0.12])
def test_the_encoder_counts_of_a_straight_drive_do_not_change_the_ratio(delay: float) -> None:
    for seed in range(20):
        match, dice, before = matched(6.0, 0.625, delay), random.Random(seed), 0
        for _ in range(4000):
            now = dice.choice((0, 1))
            match.add((now - before) * 0.003, dice.gauss(0.0, 5e-5), DT, slips=False)
            before = now
        assert match.ratio == pytest.approx(0.625, abs=0.05)


def test_the_ratio_stays_bounded_if_the_gyro_does_not_follow_the_wheels() -> None:
    match, pattern = Match(), (0.0, 0.0, 0.1, 0.1, 0.0, 0.0, -0.1, -0.1)
    for n in range(4000):
        wheels, gyro = pattern[n // 10 % 8], pattern[(n // 10 + 3) % 8]
        match.add(wheels + 0.01, gyro + 0.01, DT, slips=False)
        assert math.isfinite(match.ratio)
        assert abs(match.ratio) < 3.0
        match.delay()


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


def test_a_corrected_delay_changes_the_ratio_immediately() -> None:
    match = matched(20.0, delay=0.02)
    before = match.ratio
    assert match.delay() is not None
    assert match.ratio != before


def test_the_spread_is_the_variation_of_the_ratio_between_turns() -> None:
    mixed = Match()
    for n in range(12000):
        ratio = 0.66 if int(n * DT / 5.0) % 2 else 0.54
        mixed.add(0.8 * DT, ratio * 0.8 * DT, DT, slips=False)
    assert matched(60.0, rate=lambda t: 0.8).spread < 0.01
    assert mixed.spread == pytest.approx(0.06, rel=0.3)


def test_a_changing_delay_of_the_gyro_does_not_make_the_ratio_less_certain() -> None:
    """The samples are up to 50 ms late, each by a different time."""
    match, gyro_angle, true = Match(), 0.0, 0.0
    for n in range(6000):
        late = (n * 7 % 11) * 0.005
        true = 0.6 * (math.cos(0.0) - math.cos(0.4 * (n * DT - late))) / 0.4
        match.add(math.sin(0.4 * n * DT) * DT, true - gyro_angle, DT, slips=False)
        gyro_angle = true
    assert match.spread < 0.05 * match.ratio


def test_the_spread_is_the_deviation_of_the_assumed_ratio_until_something_is_learned() -> None:
    assert Match().spread == INITIAL_RATIO_STD
