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
from acsard.core.link.quantization import BLOCK_STEPS, CountRecovery, Steps
from acsard.core.link.whole_counts import MAX_DOUBT
from acsard.core.link.whole_counts import WholeCounts as Recovered
from acsard.core.values import Instant, WheelSpeeds
from tests.each import each

Array = NDArray[np.float64]
RADIUS, TRACK, PERIOD = 0.05, 0.30, 0.01
AT = Instant(0, 0)


def sides(rng: np.random.Generator, seconds: float) -> Array:
    """Return the mean speeds of both sides in each period, rad/s, shape (periods, 2).

    The right side comes first.
    """
    v = w = 0.0
    rows, goal, left = [], (0.0, 0.0), 100
    for _ in range(round(seconds / PERIOD)):
        if left == 0:
            stop = rng.random() < 0.1
            goal = (0.0, 0.0) if stop else (rng.uniform(0.6, 1.2), rng.uniform(-1.2, 1.2))
            left = int(rng.uniform(50, 400))
        left -= 1
        v += max(-PERIOD, min(PERIOD, goal[0] - v))
        w += max(-4 * PERIOD, min(4 * PERIOD, goal[1] - w))
        rows.append(((v + w * TRACK / 2) / RADIUS, (v - w * TRACK / 2) / RADIUS))
    return np.array(rows)


def angles(rng: np.random.Generator, seconds: float) -> Array:
    """Return the wheels' true angles, rad, shape (periods + 1, 4).

    Each wheel starts at a random angle.
    """
    turned = sides(rng, seconds) * PERIOD
    wheels = np.vstack([np.zeros(4), np.cumsum(turned[:, [0, 1, 1, 0]], axis=0)])
    return wheels + rng.uniform(0, math.tau, 4)


def counted(wheels: Array, counts: int | NDArray[np.int_]) -> Array:
    """Return the whole counts of each wheel in each period, shape (periods, 4).

    `counts` is the number of counts per turn.
    """
    deltas: Array = np.diff(np.floor(wheels / math.tau * counts), axis=0)
    return deltas


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


def test_no_counts_are_derived_from_speeds_if_the_line_has_its_own_counts() -> None:
    lines = recover(CountRecovery(), speeds(20), 20, counts=True)
    assert all(line.counted is None for line in lines)
    assert max(lines[-1].steps) == pytest.approx(math.tau / 20 / PERIOD, abs=0.01)


def steps_after(speeds: list[float], steps: Steps | None = None) -> Steps:
    steps = steps or Steps()
    for speed in speeds:
        steps.add(speed)
    return steps


def fine_speeds(count: int = 2 * BLOCK_STEPS) -> list[float]:
    dice = random.Random(1)
    return [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for i in range(count)]


def test_one_damaged_line_does_not_change_the_quantization_step() -> None:
    steps = steps_after(fine_speeds(2 * BLOCK_STEPS + 8))
    steps_after([40.0, 12.0], steps)
    assert steps.size < 0.5


def test_a_quantization_step_that_does_not_recur_is_forgotten() -> None:
    steps = steps_after([0.0, 30.0] * BLOCK_STEPS)
    assert steps.size == 30.0
    steps_after(fine_speeds(3 * BLOCK_STEPS), steps)
    assert steps.size < 0.5


class WholeCounts:
    """The law under test for one encoder, with its jitter of the host's time, s."""

    def __init__(self, counts: int, jitter: float = 0.0005) -> None:
        self.angle, self._jitter, self._whole = math.tau / counts, jitter, Recovered()

    def turned(self, speeds: Motors, elapsed: float) -> Motors | None:
        return self._whole.turned(self.angle, speeds, elapsed, self._jitter)

    @property
    def believed(self) -> bool:
        return self._whole.doubt < MAX_DOUBT


def lines(
    counts: int, jitter: float, seed: int = 1, nominal: bool = False
) -> Iterator[tuple[Motors, float, Array]]:
    """Yield the speeds of each line, the host's estimate of its duration, s, and the true counts.

    Each sample is up to `jitter` s late, and the host does not know by how much. The firmware
    divides by the true time between two samples, or by the `nominal` period.
    """
    dice, wheels = np.random.default_rng(seed), angles(np.random.default_rng(seed), 25.0)
    at = np.arange(len(wheels)) * PERIOD + dice.uniform(0.0, jitter, len(wheels))
    sampled = np.array([np.interp(at, np.arange(len(w)) * PERIOD, w) for w in wheels.T]).T
    whole, times = counted(sampled, counts), np.diff(at)
    by = np.full_like(times, PERIOD) if nominal else times
    speeds = np.round(whole * math.tau / counts / by[:, None], 2)
    for row, number in zip(speeds.tolist(), whole, strict=True):
        yield (row[0], row[1], row[2], row[3]), PERIOD, number


def missed(counts: int, jitter: float, nominal: bool = False) -> Array:
    """Return the final error of each wheel's angle in counts."""
    counter, total = WholeCounts(counts), np.zeros(4)
    for speeds, own, number in lines(counts, jitter, nominal=nominal):
        turned = counter.turned(speeds, own)
        total += np.array(turned or [speed * own for speed in speeds]) / counter.angle - number
    assert counter.believed
    off: Array = np.abs(total)
    return off


@each("counts", [16, 20, 96])
@pytest.mark.parametrize("nominal", [False, True])
def test_a_jitter_of_two_ms_loses_no_count(counts: int, nominal: bool) -> None:
    assert missed(counts, 0.002, nominal).max() < 0.01


def test_a_line_that_repeats_the_previous_one_turns_no_wheel() -> None:
    counter, speed = WholeCounts(16), round(math.tau / 16 / 0.008, 2)
    speeds = (speed, 0.0, speed, 0.0)
    assert counter.turned(speeds, 0.008) == (counter.angle, 0.0, counter.angle, 0.0)
    assert counter.turned(speeds, 0.003) == (0.0, 0.0, 0.0, 0.0)
    assert counter.turned(speeds, 0.005) == (counter.angle, 0.0, counter.angle, 0.0)


def test_a_wrong_number_of_counts_is_corrected_by_the_next_line() -> None:
    counter, total = WholeCounts(96), 0.0
    for number, time, own in ((3, 0.010, 0.010), (3, 0.0139, 0.0112), (2, 0.0077, 0.0104)):
        speed = round(number * counter.angle / time, 2)
        turned = counter.turned((speed, speed, speed, speed), own)
        assert turned is not None
        total += turned[0]
    assert total / counter.angle == pytest.approx(8)


def test_whole_counts_are_refuted_for_firmware_that_filters() -> None:
    counter, speeds, dice = WholeCounts(96), np.zeros(4), random.Random(1)
    for row, own, _ in lines(96, 0.0):
        speeds = speeds + dice.uniform(0.2, 0.4) * (np.array(row) - speeds)
        a, b, c, d = np.round(speeds, 2).tolist()
        counter.turned((a, b, c, d), own)
    assert not counter.believed


@pytest.mark.parametrize("counts", [96, 400, 3200])
def test_equal_lines_at_uneven_times_lose_no_time(counts: int) -> None:
    """The host knows the durations too roughly to find whole counts.

    It must not take a line after a short time for a repetition of the last line.
    """
    counter, dice, turned, seconds = WholeCounts(counts), random.Random(1), 0.0, 0.0
    for _ in range(1000):
        own = dice.uniform(0.004, 0.014)
        seconds += own
        angles = counter.turned((13.45,) * 4, own)
        turned += 13.45 * own if angles is None else angles[0]
    assert turned == pytest.approx(13.45 * seconds, rel=0.005)


def test_one_damaged_line_does_not_refute_whole_counts() -> None:
    counter = WholeCounts(16)
    for number, (speeds, own, whole) in enumerate(lines(16, 0.001)):
        damaged = number == 300
        turned = counter.turned((speeds[0] + 7.13, 11.11, *speeds[2:]) if damaged else speeds, own)
        if number > 302 and turned is not None:
            assert [round(angle / counter.angle) for angle in turned] == whole.tolist()
    assert counter.believed


def off_by(lost: str, counts: int, jitter: float) -> float:
    """Lose every third command or reply, and return the relative error of the wheels' distance."""
    dice, wheels = np.random.default_rng(3), angles(np.random.default_rng(3), 60.0)
    n = np.arange(len(wheels))
    at = n * PERIOD + dice.uniform(0.0, jitter, len(wheels))
    way = np.array([np.interp(at, n * PERIOD, wheel) for wheel in wheels.T]).T
    whole = np.floor(way * counts / math.tau)
    indices = np.flatnonzero(n % 3 != 0)
    recovery, total, before = CountRecovery(), np.zeros(4), np.zeros(4)
    for last, this in itertools.pairwise(indices.tolist()):
        began = last if lost == "command" else this - 1
        speeds = (whole[this] - whole[began]) * math.tau / counts / (at[this] - at[began])
        bridged = (this - last - 1) * PERIOD
        line = Feedback(
            Instant(0, 0), WheelSpeeds(*np.round(speeds, 2).tolist()), bridged + PERIOD,
            bridged=bridged,
        )  # fmt: skip
        result = recovery.recover_counts(line, math.tau / counts)
        rates = np.array(result.speeds.as_tuple())
        counted = result.counted or rates * (result.dt - result.bridged)
        total += np.array(counted) + result.bridged * (before + rates) / 2
        before = rates
    true = way[indices[-1]] - way[indices[0]]
    return float(np.max(np.abs(total - true) / np.abs(true)))


@pytest.mark.parametrize(
    ("lost", "counts", "most"),
    [
        ("command", 16, 0.03), ("command", 48, 0.005), ("command", 96, 0.005),
        ("command", 400, 0.005), ("reply", 16, 0.03), ("reply", 96, 0.01), ("reply", 400, 0.01),
    ],
)  # fmt: skip
def test_a_missing_line_counts_once_whether_its_command_or_its_reply_was_lost(
    lost: str, counts: int, most: float
) -> None:
    # After a lost reply the counts of a period are unknown. After a lost command nothing is.
    assert off_by(lost, counts, 0.004) < most
