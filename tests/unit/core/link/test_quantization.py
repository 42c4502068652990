"""A line gives the wheels' angles in whole counts as long as its speed and time agree with them."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable
from functools import cache
from types import FrameType
from typing import Any

import numpy as np
import pytest

from acsard.core.link.feedback import Feedback
from acsard.core.link.quantization import LONG, LOOK, CountRecovery
from acsard.core.values import Instant, WheelSpeeds
from tests.unit.core.link.counted import PERIOD, Array, angles, counted

AT = Instant(0, 0)
Four = tuple[float, float, float, float]


@cache
def drive(seconds: float = 30.0, seed: int = 1) -> Array:
    """Return true angles, shape (periods + 1, 4); the robot stands during the first second."""
    return angles(np.random.default_rng(seed), seconds)


def speeds(counts: int | list[int], wheels: Array | None = None, period: float = PERIOD) -> Array:
    """Return the speeds that firmware reports for these angles, in two decimals."""
    told: Array = np.round(whole(counts, wheels) * math.tau / np.array(counts) / period, 2)
    return told


def whole(counts: int | list[int], wheels: Array | None = None) -> Array:
    """Return the whole counts of four encoders, shape (periods, 4)."""
    wheels = drive() if wheels is None else wheels
    return counted(wheels, np.array(counts))


def look(
    recovery: CountRecovery, rows: Array, dt: float = PERIOD, bridged: float = 0.0
) -> list[Feedback]:
    """Feed each row as a line, `dt` seconds after the one before."""
    lines = (Feedback(AT, WheelSpeeds(*row), dt, bridged=bridged) for row in rows.tolist())
    return [recovery.look(line) for line in lines]


def total(lines: list[Feedback]) -> Array:
    """Return the angles that odometry derives from these lines, rad, by wheel."""
    turned: Array = np.array([folded(line) for line in lines]).sum(axis=0)
    return turned


def folded(line: Feedback) -> Four:
    a, b, c, d = line.counted or (speed * line.dt for speed in line.speeds.as_tuple())
    return a, b, c, d


def known(counts: int = 400) -> CountRecovery:
    recovery = CountRecovery()
    look(recovery, speeds(counts))
    assert recovery.counts == (counts,) * 4
    return recovery


@pytest.mark.variations(3)
@pytest.mark.parametrize("counts", [16, 20, 40, 96, 400, 1000, 4000])
def test_the_counts_are_found_within_seconds_and_no_rounding_is_left(counts: int) -> None:
    recovery = CountRecovery()
    lines = look(recovery, speeds(counts))
    assert recovery.counts == (counts,) * 4
    first = next(i for i, line in enumerate(lines) if line.counted)
    assert first < 15 / PERIOD
    assert total(lines) == pytest.approx(
        np.sum(whole(counts), axis=0) * math.tau / counts, abs=1e-9
    )


def test_the_hosts_jitter_bends_nothing_once_they_are_known() -> None:
    recovery, dice = known(), np.random.default_rng(1)
    late = dice.uniform(0, 0.006, 3001)
    rows, lines = speeds(400), []
    for i, row in enumerate(rows):
        lines += look(recovery, row[None], PERIOD + late[i + 1] - late[i])
    turned = np.sum(whole(400), axis=0) * math.tau / 400
    assert total(lines) == pytest.approx(turned, abs=1e-9)


def test_four_wheels_may_have_four_encoders_one_of_them_filtered() -> None:
    each, recovery = [20, 400, 96, 1000], CountRecovery()
    rows = speeds(each)
    rows[:, 3] = np.round(np.convolve(rows[:, 3], 0.5 ** np.arange(1, 12))[:3000], 2)
    lines = look(recovery, rows)
    assert recovery.counts == (20, 400, 96, 0)
    turned = np.sum(whole(each), axis=0) * math.tau / np.array(each)
    assert total(lines)[:3] == pytest.approx(turned[:3], abs=1e-9)
    assert total(lines)[3] == pytest.approx(rows[:, 3].sum() * PERIOD, abs=1e-9)


def test_wheels_that_turn_backwards_count_backwards() -> None:
    recovery = known(96)
    lines = look(recovery, -speeds(96))
    assert total(lines) == pytest.approx(-np.sum(whole(96), axis=0) * math.tau / 96, abs=1e-9)


def filtered(counts: int, share: float, seed: int) -> Array:
    """Return speeds behind a low-pass filter."""
    rows, out = whole(counts, drive(12.0, seed)) * math.tau / counts / PERIOD, []
    speed = np.zeros(4)
    for row in rows:
        speed = speed + share * (row - speed)
        out.append(speed)
    return np.round(np.array(out), 2)


@pytest.mark.parametrize(
    "streams", [8, pytest.param(1000, marks=[pytest.mark.soak, pytest.mark.timeout(900)])]
)
def test_no_firmware_that_filters_is_taken_for_one_that_counts(streams: int) -> None:
    dice, taken = np.random.default_rng(1), 0
    for seed in range(streams):
        counts = int(dice.choice([16, 20, 40, 96, 400, 1000, 4000]))
        recovery = CountRecovery()
        look(recovery, filtered(counts, dice.uniform(0.05, 0.9), seed))
        taken += any(recovery.counts)
    print(f"\n{taken} of {streams} filtered streams taken for counts")
    assert taken == 0


def test_a_firmware_that_divides_by_the_time_it_measured_shows_no_counts() -> None:
    recovery, dice = CountRecovery(), np.random.default_rng(2)
    measured = PERIOD + dice.uniform(-0.0008, 0.0008, (3000, 1))
    look(recovery, np.round(whole(400) * math.tau / 400 / measured, 2))
    assert recovery.counts == (0,) * 4


@pytest.mark.variations(3)
@pytest.mark.parametrize("share", [0.995, 1.0002, 1.005])
def test_an_oscillator_that_is_off_makes_no_other_angle(share: float) -> None:
    recovery, rows = CountRecovery(), speeds(400)
    look(recovery, rows, PERIOD * share)
    assert recovery.counts == (400,) * 4
    turned = np.sum(whole(400), axis=0) * math.tau / 400
    assert total(look(recovery, rows, PERIOD * share)) == pytest.approx(turned, abs=1e-9)


@pytest.mark.variations(3)
@pytest.mark.parametrize("period", [0.005, 0.02, 0.1, 1 / 60])
def test_any_round_period_will_do(period: float) -> None:
    wheels = drive()[:: max(1, round(period / PERIOD))]
    recovery = CountRecovery()
    look(recovery, speeds(96, wheels, period), period)
    assert recovery.counts == (96,) * 4


def test_a_period_that_makes_no_whole_counts_is_refused() -> None:
    recovery = CountRecovery()
    lines = look(recovery, speeds(400, period=PERIOD * 0.9965))
    assert recovery.counts == (0,) * 4
    assert all(line.counted is None for line in lines)


def test_a_line_that_is_missing_is_made_up_for_by_its_neighbour() -> None:
    recovery, rows = known(), speeds(400)
    keep = np.arange(len(rows)) % 100 != 50
    lines = []
    for i in np.flatnonzero(keep):
        lines += look(recovery, rows[i : i + 1], PERIOD if i == 0 or keep[i - 1] else 2 * PERIOD)
    turned = np.sum(whole(400), axis=0) * math.tau / 400
    assert recovery.counts == (400,) * 4
    assert total(lines) == pytest.approx(turned, rel=0.002)


def test_a_line_that_was_bridged_is_not_made_up_for_again() -> None:
    recovery, rows = known(), speeds(400)
    lines = look(recovery, rows, 2 * PERIOD, bridged=PERIOD)
    assert total(lines) == pytest.approx(np.sum(whole(400), axis=0) * math.tau / 400, abs=1e-9)


@pytest.mark.parametrize("period", [0.005, 0.02])
def test_another_period_is_found_out_and_learned(period: float) -> None:
    recovery, wheels = known(), drive(60.0, 2)[:: max(1, round(period / PERIOD))]
    lines = look(recovery, speeds(400, wheels, period), period)
    assert recovery.counts == (400,) * 4
    turned = np.sum(whole(400, wheels), axis=0) * math.tau / 400
    assert total(lines) == pytest.approx(turned, abs=2.0)  # the motion of an eighth of a second


def test_another_encoder_is_found_out_and_learned() -> None:
    recovery = known(400)
    look(recovery, speeds(96))
    assert recovery.counts == (96,) * 4


def test_damage_now_and_then_ends_nothing() -> None:
    recovery, rows = known(), speeds(400)
    rows[50::100] = 12.34
    look(recovery, rows)
    assert recovery.counts == (400,) * 4


def test_after_forgetting_nothing_is_known() -> None:
    recovery = known()
    recovery.forget()
    assert recovery.counts == (0,) * 4
    (line,) = look(recovery, speeds(400)[500:501])
    assert line.counted is None
    assert line.steps == (math.inf,) * 4


def test_where_the_line_has_counts_of_its_own_nothing_is_made_of_its_speeds() -> None:
    recovery = CountRecovery()
    for row in speeds(20).tolist():
        line = Feedback(AT, WheelSpeeds(*row), PERIOD, turned=(0.0,) * 4)
        seen = recovery.look(line)
        assert seen.counted is None
    assert max(seen.steps) == pytest.approx(math.tau / 20 / PERIOD, abs=0.01)


def test_after_a_gap_a_line_says_nothing_of_how_far_it_went() -> None:
    recovery = known()
    line = recovery.look(Feedback(AT, WheelSpeeds(*[15.71] * 4), 0.0, gap=0.5))
    assert line.counted is None


class Work:
    """Counts the executed lines of Python."""

    def __init__(self) -> None:
        self.lines = 0

    def trace(self, frame: FrameType, event: str, arg: object) -> Callable[..., Any]:
        self.lines += event == "line"
        return self.trace

    def of(self, recovery: CountRecovery, row: list[float]) -> int:
        line, before, was = Feedback(AT, WheelSpeeds(*row), PERIOD), self.lines, sys.gettrace()
        sys.settrace(self.trace)
        try:
            recovery.look(line)
        finally:
            sys.settrace(was)
        return self.lines - before


@pytest.mark.parametrize("counts", [20, 4000, 20_000])
def test_no_single_line_has_to_wait_for_the_search(counts: int) -> None:
    recovery, work = CountRecovery(), Work()
    each = [work.of(recovery, row) for row in speeds(counts)[:1500].tolist()]
    print(f"\n{counts}: {np.median(each):.0f} lines of Python a report, {max(each)} at most")
    assert np.median(each) < 250
    assert max(each) < 3000


@pytest.mark.slow
def test_counts_are_found_whenever_the_wheels_begin_to_turn() -> None:
    whole_block = LOOK * LONG
    toggling = np.array([[0.0] * 4, [31.42] * 4] * 150)
    for standing in range(whole_block - 120, whole_block - 95):
        recovery = CountRecovery()
        look(recovery, np.zeros((standing, 4)))
        look(recovery, toggling)
        assert recovery.counts == (20,) * 4


def test_a_wheel_that_jumps_at_random_is_no_coarse_encoder_beside_three_fine_ones() -> None:
    dice, recovery = random.Random(1), CountRecovery()
    for _ in range(1000):
        fine = [round(5.0 + dice.uniform(-0.1, 0.1), 2) for _ in range(3)]
        speeds = WheelSpeeds(round(dice.uniform(-70.0, 70.0), 2), *fine)
        line = recovery.look(Feedback(Instant(0, 0), speeds, 0.01))
    assert max(line.steps) < 1.0
