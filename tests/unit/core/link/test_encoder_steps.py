"""The quantization step of reports is learned from values that recur."""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.link.encoder_steps import BLOCK, FIRST, Steps


def after(speeds: list[float], steps: Steps | None = None) -> Steps:
    steps = steps or Steps()
    for speed in speeds:
        steps.add(speed)
    return steps


def fine(count: int = 2 * BLOCK) -> list[float]:
    dice = random.Random(1)
    return [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for i in range(count)]


def test_nothing_is_known_until_enough_steps_were_seen() -> None:
    speeds = [0.1 * (i % 2) for i in range(FIRST)]
    steps = after(speeds)
    assert steps.size == math.inf
    steps.add(0.2)
    assert steps.size < 0.3


def test_rest_and_flicker_teach_nothing() -> None:
    steps = after([0.0] * 1000 + [0.01 * (i % 2) for i in range(1000)])
    assert steps.size == math.inf


@pytest.mark.parametrize("counts", [16, 20, 96])
def test_counts_step_by_a_count(counts: int) -> None:
    quantum, dice = math.tau / counts / 0.01, random.Random(2)
    steps = after([quantum * dice.randint(0, 1) for _ in range(6 * BLOCK)])
    assert steps.size == pytest.approx(quantum)


def test_a_fine_encoder_hardly_steps() -> None:
    assert after(fine()).size < 0.5


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_a_filter_behind_coarse_counts_leaves_of_a_step_its_share(share: float) -> None:
    speed, speeds, quantum = 0.0, [], 31.4
    for i in range(400):
        speed += share * ((0.0 if i % 9 else quantum) - speed)
        speeds.append(round(speed, 2))
    assert after([0.0, *speeds]).size > 0.4 * share * quantum


def test_one_damaged_line_is_no_step_of_an_encoder() -> None:
    steps = after(fine(2 * BLOCK + 8))
    after([40.0, 12.0], steps)
    assert steps.size < 0.5


def test_what_does_not_recur_is_forgotten() -> None:
    steps = after([0.0, 30.0] * BLOCK)
    assert steps.size == 30.0
    after(fine(3 * BLOCK), steps)
    assert steps.size < 0.5
