"""Tests of coarse encoders from received bytes to pose.

No true line is dropped, and the error is that of the raw counters. Run it with `pytest -m slow -s
core/link/test_coarse.py`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec import Struct

from acsard.core.config.settings import FeedbackConfig
from tests.unit.core.link.counted import (
    PERIOD,
    Array,
    Host,
    angles,
    counted,
    end,
    lines,
    speeds,
    text,
)
from tests.unit.core.link.table import print_row

COUNTS = (16, 20, 40, 96, 400)
FINER = (1000, 2000, 4000)


class Driven(Struct, frozen=True):
    """Distance between the computed and the true end of a drive, m, for three computations.

    `raw` uses counts, `plain` multiplies each reported speed by the period, and `ours` is the
    session under test.
    """

    raw: float
    plain: float
    ours: float
    lines: int
    dropped: int


def drive(counts: int, seed: int, seconds: float, configured: int = 0) -> Driven:
    wheels = angles(np.random.default_rng(seed), seconds)
    host = Host(counts=configured)
    for line in lines(wheels, counts):
        host.receive(line)
    assert host.session.count_recovery.counts(configured) == (configured,) * 4
    pose, true = host.odometry.pose, end(np.diff(wheels, axis=0))
    exact = counted(wheels, counts) * math.tau / counts
    plain = np.round(exact / PERIOD, 2) * PERIOD
    return Driven(
        math.dist(end(exact), true),
        math.dist(end(plain), true),
        math.dist((pose.x, pose.y), true),
        host.lines,
        host.dropped,
    )


@pytest.mark.slow
@pytest.mark.parametrize("counts", COUNTS)
def test_no_true_line_is_dropped_and_a_short_drive_ends_where_the_reports_say(counts: int) -> None:
    result = drive(counts, 1, 25.0)
    assert result.dropped == 0
    assert result.ours == pytest.approx(result.plain, abs=0.004)


@pytest.mark.variations(8)
@pytest.mark.parametrize("counts", COUNTS + FINER)
def test_with_configured_counts_a_drive_ends_exactly_where_the_raw_counter_says(
    counts: int,
) -> None:
    result = drive(counts, 2, 60.0, counts)
    assert result.dropped == 0
    assert result.ours == pytest.approx(result.raw, abs=0.0002)


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("counts", COUNTS + FINER)
@pytest.mark.parametrize("configured", [False, True], ids=["", "configured"])
def test_the_error_after_450_m_is_that_of_the_raw_counter(counts: int, configured: bool) -> None:
    """Without configured counts, speeds in two decimals add 1 m of error at most."""
    drives = [drive(counts, seed, 600.0, counts if configured else 0) for seed in range(20)]
    raw, plain, ours = (
        float(np.mean([getattr(result, what) for result in drives]))
        for what in ("raw", "plain", "ours")
    )
    dropped = sum(result.dropped for result in drives)
    print_row(
        f"{counts} counts a turn{', configured' if configured else ''}",
        "1.05 x raw counter" if configured else "raw counter + 1 m",
        f"{ours * 1e3:.1f} mm, {ours / raw:.3f} x raw, {ours / plain:.2f} x reports; "
        f"{dropped} lines dropped",
    )
    assert dropped == 0
    assert ours <= (1.05 * raw if configured else raw + 1.0)


# other effects with coarse encoders: no counts are found for others, and no line is dropped


def host_after(rows: Array, feedback: FeedbackConfig | None = None) -> Host:
    host = Host(feedback)
    for row in rows:
        host.receive(text(row))
    return host


@pytest.mark.variations(3)
@pytest.mark.parametrize("counts", [16, 20, 40, 96])
def test_no_line_of_a_firmware_that_divides_by_its_measured_time_is_dropped(counts: int) -> None:
    wheels, dice = angles(np.random.default_rng(2), 25.0), np.random.default_rng(1)
    read = np.concatenate([[0.0], np.cumsum(dice.uniform(0.7, 1.3, len(wheels) - 100))])
    at = [np.interp(read, np.arange(len(wheels)), wheel) for wheel in wheels.T]
    rows = counted(np.array(at).T, counts) * math.tau / counts / PERIOD / np.diff(read)[:, None]
    host = host_after(np.round(rows, 2))
    assert (host.dropped, host.why) == (0, "")


@pytest.mark.variations(9)
@pytest.mark.parametrize("counts", [16, 20, 40, 96])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.9])
def test_no_line_of_a_firmware_that_filters_is_dropped(counts: int, share: float) -> None:
    wheels, speed, rows = angles(np.random.default_rng(3), 25.0), np.zeros(4), []
    for row in counted(wheels, counts) * math.tau / counts / PERIOD:
        speed = speed + share * (row - speed)
        rows.append(speed)
    host = host_after(np.round(np.array(rows), 2))
    assert (host.dropped, host.why) == (0, "")
    assert host.session.count_recovery.counts(0) == (0,) * 4


def wild(wheels: int, seed: int) -> Host:
    """Return the host of a drive in which `wheels` wheels report random speeds until a fault.

    The drive has already begun when the host receives its first line.
    """
    host, dice = Host(), np.random.default_rng(seed)
    for right, left in speeds(np.random.default_rng(seed), 9.0)[150:]:
        row = np.array([right, left, left, right])
        row[:wheels] = dice.uniform(-60.0, 60.0, wheels)
        host.receive(text(np.round(row, 2)))
        if host.sanity.doubtful:
            break
    return host


def test_a_wheel_that_jumps_at_random_is_suspected_because_the_other_wheels_step_finely() -> None:
    line_counts = sorted(wild(1, seed).lines for seed in range(7))
    assert line_counts[3] <= 60


def test_two_wheels_that_jump_at_random_are_not_suspected() -> None:
    """The same speeds could come from two coarse encoders on a robot with two fine ones."""
    assert not wild(2, 1).sanity.doubtful
