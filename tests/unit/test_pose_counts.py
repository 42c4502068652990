"""Whole counts from the speeds of a line, and whether the encoders are coarse."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from acsard.core.link.coarse_encoders import CoarseEncoders
from acsard.core.link.whole_counts import MAX_MISFIT
from acsard.core.link.whole_counts import WholeCounts as Recovered
from acsard.core.values import Wheels4
from tests.each import each

Array = NDArray[np.float64]
PERIOD = 0.01
DRIVEN = 4, 2


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
) -> Iterator[tuple[Wheels4, list[float]]]:
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


def of(driven: int, speeds: Iterable[float]) -> Wheels4:
    """Return the speeds of four wheels; of two driven ones, the rear ones do as the front ones."""
    a, b, c, d = speeds
    return (a, b, c, d) if driven == 4 else (a, b, b, a)


def found(encoders: CoarseEncoders, some: Iterable[Wheels4], driven: int = 4) -> str:
    for speeds in some:
        encoders.step(of(driven, speeds), PERIOD, driven)
    return encoders.found


@each("driven", DRIVEN)
@each("counts", [16, 20, 48, 96])
@each("jitter", [0.0, 0.002])
def test_coarse_encoders_are_found_in_the_speeds(counts: int, jitter: float, driven: int) -> None:
    encoders = CoarseEncoders()
    assert found(encoders, (speeds for speeds, _ in lines(counts, jitter)), driven) == "coarse"
    assert encoders.lines > 2000


@each("driven", DRIVEN)
@each("counts", [400, 1024, 3200])
@each("window", [0.004, 0.005, 0.01])
def test_fine_encoders_are_not_although_the_board_counts_for_less_than_a_line(
    counts: int, window: float, driven: int
) -> None:
    encoders, dice = CoarseEncoders(), random.Random(counts)
    for speeds, _ in lines(counts):
        step = math.tau / counts / window
        read = [step * math.floor(speed / step + dice.random()) for speed in speeds]
        encoders.step(of(driven, read), PERIOD, driven)
        assert encoders.found != "coarse"
    assert (encoders.found, encoders.lines) == ("fine", 0)


@each("driven", DRIVEN)
@each(("share", "false", "most"), [(0.01, 2, 0.0), (0.05, 1, 0.005), (0.05, 2, 0.01)])
def test_damaged_lines_are_seldom_taken_for_coarse_encoders(
    share: float, false: int, most: float, driven: int
) -> None:
    """In a share of the lines, so many values have a digit with one false bit."""
    encoders, dice, coarse, number = CoarseEncoders(), random.Random(2), 0, 0
    for speeds, _ in lines(3200, 0.001):
        read = [*speeds]
        if dice.random() < share:
            for wheel in dice.sample(range(driven), false):
                read[wheel] = with_a_false_bit(read[wheel], dice)
        encoders.step(of(driven, read), PERIOD, driven)
        coarse, number = coarse + (encoders.found == "coarse"), number + 1
    assert coarse <= most * number


def with_a_false_bit(speed: float, dice: random.Random) -> float:
    text, place, digit = bytearray(b"%05.2f" % abs(speed)), dice.choice((0, 1, 3, 4)), 0
    while not b"0"[0] <= digit <= b"9"[0]:
        digit = text[place] ^ 1 << dice.randrange(4)
    text[place] = digit
    return math.copysign(float(text), speed)


def fine(count: int) -> list[Wheels4]:
    dice, rows = random.Random(1), []
    for i in range(count):
        a, b, c, d = [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for _ in range(4)]
        rows.append((a, b, c, d))
    return rows


def test_accelerations_and_single_damaged_wheels_do_not_look_like_coarse_encoders() -> None:
    lifted = [(speed,) * 4 for speed in (*range(0, 60, 6), *range(60, 0, -6))]
    assert found(CoarseEncoders(), [*fine(100), *lifted, *fine(100), *lifted]) == "fine"
    assert found(CoarseEncoders(), [(30.0, 10.0, 10.0, 10.0), *fine(9)] * 40) == "fine"
    # Not even the coarsest encoder jumps so far.
    assert found(CoarseEncoders(), [*fine(100), *[(95.0,) * 4, (0.0,) * 4] * 100]) == "fine"


def test_encoders_may_turn_out_to_be_coarse_or_fine_after_all_and_are_unknown_before() -> None:
    encoders = CoarseEncoders()
    assert encoders.step((0.0,) * 4, PERIOD, 4) == math.inf
    assert found(encoders, fine(200)) == "fine"
    assert found(encoders, [(31.4, 31.4, 10.0, 10.0), (10.0,) * 4] * 3) == ""
    assert found(encoders, [(31.4,) * 4, (10.0,) * 4] * 3) == "coarse"
    assert found(encoders, fine(200)) == "fine"
    encoders.forget()
    assert encoders.found == ""


class WholeCounts:
    """The law under test for one encoder, of a host that knows times to half a millisecond."""

    def __init__(self, counts: int) -> None:
        self.angle, self._whole = math.tau / counts, Recovered()

    def turned(self, speeds: Wheels4, elapsed: float = PERIOD) -> Wheels4 | None:
        return self._whole.turned(self.angle, speeds, elapsed, 0.0005)

    @property
    def believed(self) -> bool:
        return self._whole.misfit < MAX_MISFIT


@each("driven", DRIVEN)
@each("counts", [16, 20, 96])
@pytest.mark.parametrize("nominal", [False, True])
def test_a_jitter_of_two_ms_loses_no_count(counts: int, nominal: bool, driven: int) -> None:
    counter, total = WholeCounts(counts), np.zeros(4)
    for speeds, number in lines(counts, 0.002, nominal):
        read = of(driven, speeds)
        turned = counter.turned(read) or [s * PERIOD for s in read]
        total += np.array(turned) / counter.angle - of(driven, number)
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


@pytest.mark.variations(4)
@each("driven", DRIVEN)
@pytest.mark.parametrize(
    ("lost", "counts", "most"),
    [
        ("command", 16, 0.03), ("command", 96, 0.005), ("command", 400, 0.005),
        ("reply", 16, 0.03), ("reply", 96, 0.01), ("reply", 400, 0.01),
    ],
)  # fmt: skip
def test_a_missing_line_counts_once_whether_its_command_or_its_reply_was_lost(
    lost: str, counts: int, most: float, driven: int
) -> None:
    """Every third command or reply is lost.

    After a lost reply the counts of a period are unknown. After a lost command nothing is.
    """
    way, at = angles(3, 60.0, 0.004)
    way = np.array([of(driven, wheels) for wheels in way])
    whole = np.floor(way * counts / math.tau)
    indices = np.flatnonzero(np.arange(len(way)) % 3 != 0)
    recovery, total, before = Recovered(), np.zeros(4), np.zeros(4)
    for last, this in itertools.pairwise(indices.tolist()):
        began = last if lost == "command" else this - 1
        speeds = (whole[this] - whole[began]) * math.tau / counts / (at[this] - at[began])
        bridged = (this - last - 1) * PERIOD
        a, b, c, d = np.round(speeds, 2).tolist()
        speeds_read = a, b, c, d
        rates = np.array(speeds_read)
        counted = recovery.turned(math.tau / counts, speeds_read, PERIOD, 0.0, bridged)
        gap = 0.0 if recovery.covers_gap else bridged
        total += np.array(counted or rates * (bridged + PERIOD - gap)) + gap * (before + rates) / 2
        before = rates
    true = way[indices[-1]] - way[indices[0]]
    assert float(np.max(np.abs(total - true) / np.abs(true))) < most
