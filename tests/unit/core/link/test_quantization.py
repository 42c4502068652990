"""The daemon measures the quantization steps of the speeds and notices coarse encoders."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from acsard.core.link.feedback import Feedback
from acsard.core.link.quantization import BLOCK_STEPS, FIRST_STEPS, CountRecovery, Steps
from acsard.core.values import Instant, WheelSpeeds
from tests.unit.core.link.counted import PERIOD, Array, angles, counted

AT = Instant(0, 0)


def speeds(counts: int) -> Array:
    """Return the speeds that firmware reports in half a minute, in two decimals."""
    whole = counted(angles(np.random.default_rng(1), 30.0), counts)
    values: Array = np.round(whole * math.tau / counts / PERIOD, 2)
    return values


def recover(
    recovery: CountRecovery, rows: Array, configured: int = 0, counts: bool = False
) -> list[Feedback]:
    """Process each row as a line. With `counts`, the lines contain counts."""
    angle = math.tau / configured if configured else 0.0
    turned = (0.0,) * 4 if counts else None
    lines = (Feedback(AT, WheelSpeeds(*row), PERIOD, turned=turned) for row in rows.tolist())
    return [recovery.recover_counts(line, angle) for line in lines]


def test_without_configured_counts_no_line_has_whole_counts_and_coarse_lines_are_counted() -> None:
    coarse, fine = CountRecovery(), CountRecovery()
    assert all(
        line.counted is None for line in recover(coarse, speeds(20)) + recover(fine, speeds(3200))
    )
    assert coarse.counts(0) == fine.counts(0) == (0,) * 4
    assert coarse.coarse_lines > 1000
    assert fine.coarse_lines == 0


def test_with_configured_counts_no_line_is_counted_as_coarse() -> None:
    recovery = CountRecovery()
    lines = recover(recovery, speeds(20), 20)
    assert all(line.counted for line in lines)
    assert recovery.counts(20) == (20,) * 4
    assert recovery.coarse_lines == 0


def test_after_forgetting_no_step_is_known() -> None:
    recovery = CountRecovery()
    recover(recovery, speeds(400))
    recovery.forget()
    (line,) = recover(recovery, speeds(400)[500:501])
    assert line.steps == (math.inf,) * 4


def test_no_counts_are_derived_from_speeds_if_the_line_has_its_own_counts() -> None:
    lines = recover(CountRecovery(), speeds(20), 20, counts=True)
    assert all(line.counted is None for line in lines)
    assert max(lines[-1].steps) == pytest.approx(math.tau / 20 / PERIOD, abs=0.01)


def test_no_counts_are_derived_from_a_line_after_a_gap() -> None:
    recovery, line = CountRecovery(), Feedback(AT, WheelSpeeds(*[15.71] * 4), 0.0, gap=0.5)
    recover(recovery, speeds(400), 400)
    line = recovery.recover_counts(line, math.tau / 400)
    assert line.counted is None


def test_a_randomly_jumping_wheel_beside_three_fine_ones_is_not_a_coarse_encoder() -> None:
    dice, recovery = random.Random(1), CountRecovery()
    for _ in range(1000):
        fine = [round(5.0 + dice.uniform(-0.1, 0.1), 2) for _ in range(3)]
        speeds = WheelSpeeds(round(dice.uniform(-70.0, 70.0), 2), *fine)
        line = recovery.recover_counts(Feedback(AT, speeds, 0.01), 0.0)
    assert max(line.steps) < 1.0


def steps_after(speeds: list[float], steps: Steps | None = None) -> Steps:
    steps = steps or Steps()
    for speed in speeds:
        steps.add(speed)
    return steps


def fine_speeds(count: int = 2 * BLOCK_STEPS) -> list[float]:
    dice = random.Random(1)
    return [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for i in range(count)]


def test_the_quantization_step_is_unknown_until_enough_steps_were_seen() -> None:
    speeds = [0.1 * (i % 2) for i in range(FIRST_STEPS)]
    steps = steps_after(speeds)
    assert steps.size == math.inf
    steps.add(0.2)
    assert steps.size < 0.3


def test_the_quantization_step_is_not_learned_from_rest_or_flicker() -> None:
    steps = steps_after([0.0] * 1000 + [0.01 * (i % 2) for i in range(1000)])
    assert steps.size == math.inf


@pytest.mark.parametrize("counts", [16, 20, 96])
def test_the_quantization_step_of_whole_counts_is_one_count(counts: int) -> None:
    quantum, dice = math.tau / counts / 0.01, random.Random(2)
    steps = steps_after([quantum * dice.randint(0, 1) for _ in range(6 * BLOCK_STEPS)])
    assert steps.size == pytest.approx(quantum)


def test_a_fine_encoder_has_a_small_quantization_step() -> None:
    assert steps_after(fine_speeds()).size < 0.5


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_a_filter_reduces_the_quantization_step_by_its_share(share: float) -> None:
    speed, speeds, quantum = 0.0, [], 31.4
    for i in range(400):
        speed += share * ((0.0 if i % 9 else quantum) - speed)
        speeds.append(round(speed, 2))
    assert steps_after([0.0, *speeds]).size > 0.4 * share * quantum


def test_one_damaged_line_does_not_change_the_quantization_step() -> None:
    steps = steps_after(fine_speeds(2 * BLOCK_STEPS + 8))
    steps_after([40.0, 12.0], steps)
    assert steps.size < 0.5


def test_a_quantization_step_that_does_not_recur_is_forgotten() -> None:
    steps = steps_after([0.0, 30.0] * BLOCK_STEPS)
    assert steps.size == 30.0
    steps_after(fine_speeds(3 * BLOCK_STEPS), steps)
    assert steps.size < 0.5
