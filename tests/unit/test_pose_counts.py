"""Whole counts from the speeds of a line, and the smallest step of a speed."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.quantization import BLOCK_STEPS, FIRST_STEPS, CountRecovery, Steps
from acsard.core.link.whole_counts import MAX_DOUBT
from acsard.core.link.whole_counts import WholeCounts as Recovered
from acsard.core.values import Instant, WheelSpeeds
from tests.each import each

Array = NDArray[np.float64]
PERIOD = 0.01
AT = Instant(0, 0)


def angles(seed: int, seconds: float, jitter: float) -> tuple[Array, Array]:
    """Return the wheels' true angles, rad, at each sample, and the times of the samples, s.

    The robot drives at random, and each wheel starts at a random angle. Each sample is up to
    `jitter` s late.
    """
    rng = np.random.default_rng(seed)
    linear = angular = 0.0
    rows, goal, left = [], (0.0, 0.0), 100
    for _ in range(round(seconds / PERIOD)):
        if left == 0:
            stop = rng.random() < 0.1
            goal = (0.0, 0.0) if stop else (rng.uniform(0.6, 1.2), rng.uniform(-1.2, 1.2))
            left = int(rng.uniform(50, 400))
        left -= 1
        linear += max(-PERIOD, min(PERIOD, goal[0] - linear))
        angular += max(-4 * PERIOD, min(4 * PERIOD, goal[1] - angular))
        sides = [(linear + sign * angular * 0.15) / 0.05 for sign in (1, -1, -1, 1)]
        rows.append([side * PERIOD for side in sides])
    way = np.vstack([np.zeros(4), np.cumsum(rows, axis=0)]) + rng.uniform(0, math.tau, 4)
    due = np.arange(len(way)) * PERIOD
    at = due + rng.uniform(0.0, jitter, len(way))
    return np.array([np.interp(at, due, wheel) for wheel in way.T]).T, at


def lines(
    counts: int, jitter: float = 0.0, nominal: bool = False
) -> Iterator[tuple[Motors, list[float]]]:
    """Yield the speeds of each line and the true counts. The host takes each line for 10 ms.

    The firmware divides by the true time between two samples, or by the `nominal` period.
    """
    way, at = angles(1, 25.0, jitter)
    whole, times = np.diff(np.floor(way / math.tau * counts), axis=0), np.diff(at)
    by = np.full_like(times, PERIOD) if nominal else times
    speeds = np.round(whole * math.tau / counts / by[:, None], 2)
    for row, number in zip(speeds.tolist(), whole.tolist(), strict=True):
        a, b, c, d = row
        yield (a, b, c, d), number


def test_without_configured_counts_no_line_has_whole_counts_and_coarse_lines_are_counted() -> None:
    for counts, coarse in ((20, True), (3200, False)):
        recovery = CountRecovery()
        first = recovery.recover_counts(Feedback(AT, WheelSpeeds(), PERIOD), 0.0)
        assert first.steps == (math.inf,) * 4
        for speeds, _ in lines(counts):
            line = recovery.recover_counts(Feedback(AT, WheelSpeeds(*speeds), PERIOD), 0.0)
            assert line.counted is None
        assert recovery.counts(0) == (0,) * 4
        assert (recovery.coarse_lines > 1000) == coarse == bool(recovery.coarse_lines)


def steps_after(speeds: list[float], steps: Steps | None = None) -> Steps:
    steps = steps or Steps()
    for speed in speeds:
        steps.add(speed, 39.0)
    return steps


def fine_speeds(count: int) -> list[float]:
    dice = random.Random(1)
    return [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for i in range(count)]


def test_a_quantization_step_is_known_once_it_has_recurred_and_while_it_does() -> None:
    steps = steps_after([0.1 * (i % 2) for i in range(FIRST_STEPS)])
    assert steps.size == math.inf
    assert steps_after([0.2], steps).size < 0.3
    steps = steps_after(fine_speeds(2 * BLOCK_STEPS + 8))
    assert steps_after([40.0, 12.0], steps).size < 0.5
    steps = steps_after([0.0, 30.0] * BLOCK_STEPS)
    assert steps.size == 30.0
    assert steps_after(fine_speeds(3 * BLOCK_STEPS), steps).size < 0.5
    # Larger changes than the coarsest encoder causes do not count.
    assert steps_after([0.0, 40.0] * BLOCK_STEPS, steps).size < 0.5


class WholeCounts:
    """The law under test for one encoder, of a host that knows times to half a millisecond."""

    def __init__(self, counts: int) -> None:
        self.angle, self._whole = math.tau / counts, Recovered()

    def turned(self, speeds: Motors, elapsed: float = PERIOD) -> Motors | None:
        return self._whole.turned(self.angle, speeds, elapsed, 0.0005)

    @property
    def believed(self) -> bool:
        return self._whole.doubt < MAX_DOUBT


@each("counts", [16, 20, 96])
@pytest.mark.parametrize("nominal", [False, True])
def test_a_jitter_of_two_ms_loses_no_count(counts: int, nominal: bool) -> None:
    counter, total = WholeCounts(counts), np.zeros(4)
    for speeds, number in lines(counts, 0.002, nominal):
        turned = counter.turned(speeds)
        total += np.array(turned or [s * PERIOD for s in speeds]) / counter.angle - number
    assert counter.believed
    assert np.abs(total).max() < 0.01


def test_a_line_that_repeats_the_previous_one_turns_no_wheel() -> None:
    counter, speed = WholeCounts(16), round(math.tau / 16 / 0.008, 2)
    speeds = (speed, 0.0, speed, 0.0)
    assert counter.turned(speeds, 0.008) == (counter.angle, 0.0, counter.angle, 0.0)
    assert counter.turned(speeds, 0.003) == (0.0, 0.0, 0.0, 0.0)
    assert counter.turned(speeds, 0.005) == (counter.angle, 0.0, counter.angle, 0.0)


def test_whole_counts_are_refuted_for_firmware_that_filters() -> None:
    counter, speeds, dice = WholeCounts(96), np.zeros(4), random.Random(1)
    for row, _ in lines(96):
        speeds = speeds + dice.uniform(0.2, 0.4) * (np.array(row) - speeds)
        a, b, c, d = np.round(speeds, 2).tolist()
        counter.turned((a, b, c, d))
    assert not counter.believed


def test_one_damaged_line_does_not_refute_whole_counts() -> None:
    counter = WholeCounts(16)
    for number, (speeds, whole) in enumerate(lines(16, 0.001)):
        damaged = number == 300
        turned = counter.turned((speeds[0] + 7.13, 11.11, *speeds[2:]) if damaged else speeds)
        if number > 302 and turned is not None:
            assert [round(angle / counter.angle) for angle in turned] == whole
    assert counter.believed


@pytest.mark.parametrize(
    ("lost", "counts", "most"),
    [
        ("command", 16, 0.03), ("command", 96, 0.005), ("command", 400, 0.005),
        ("reply", 16, 0.03), ("reply", 96, 0.01), ("reply", 400, 0.01),
    ],
)  # fmt: skip
def test_a_missing_line_counts_once_whether_its_command_or_its_reply_was_lost(
    lost: str, counts: int, most: float
) -> None:
    """Every third command or reply is lost.

    After a lost reply the counts of a period are unknown. After a lost command nothing is.
    """
    way, at = angles(3, 60.0, 0.004)
    whole = np.floor(way * counts / math.tau)
    indices = np.flatnonzero(np.arange(len(way)) % 3 != 0)
    recovery, total, before = CountRecovery(), np.zeros(4), np.zeros(4)
    for last, this in itertools.pairwise(indices.tolist()):
        began = last if lost == "command" else this - 1
        speeds = (whole[this] - whole[began]) * math.tau / counts / (at[this] - at[began])
        bridged = (this - last - 1) * PERIOD
        speeds_read = WheelSpeeds(*np.round(speeds, 2).tolist())
        line = Feedback(AT, speeds_read, bridged + PERIOD, bridged=bridged)
        result = recovery.recover_counts(line, math.tau / counts)
        rates = np.array(result.speeds.as_tuple())
        total += np.array(result.counted or rates * (result.dt - result.bridged))
        total += result.bridged * (before + rates) / 2
        before = rates
    true = way[indices[-1]] - way[indices[0]]
    assert float(np.max(np.abs(total - true) / np.abs(true))) < most
