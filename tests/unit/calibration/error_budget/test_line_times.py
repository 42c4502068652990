"""Tests that find each line's slot and the missing lines from their stamps."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.error_budget.drive_log import line_times
from tests.each import each

PERIOD = 0.01
NONE = np.zeros(0)
EVEN = np.asarray(np.arange(600) * PERIOD, dtype=np.float64)


def test_even_lines_are_in_their_places() -> None:
    found = line_times(EVEN, NONE)
    assert np.abs(found.late).max() < 1e-9
    assert found.period == pytest.approx(PERIOD)
    assert not found.missing.any()


@each("period", [0.00997, 0.01, 0.0102, 0.05])
def test_the_period_need_not_be_known(period: float) -> None:
    t = np.asarray(np.arange(400) * period, dtype=np.float64)
    assert line_times(t, NONE).period == pytest.approx(period, rel=1e-6)


def test_a_line_that_is_read_late_is_late_and_not_missing() -> None:
    late = EVEN.copy()
    late[300:308] = late[308]  # a stall of the host delays all reads to its end
    found = line_times(late, NONE)
    assert not found.missing.any()
    assert found.late[300] == pytest.approx(0.08, abs=0.002)
    assert abs(found.late[400]) < 0.002


def test_an_adapter_that_holds_lines_loses_none() -> None:
    found = line_times(np.ceil(EVEN / 0.016) * 0.016, NONE)
    assert not found.missing.any()
    assert 0.003 < float(np.std(found.late)) < 0.006  # a uniform delay over 16 ms has 4.6


@each("gone", [1, 2, 5, 20])
def test_lines_that_do_not_come_are_missing_where_they_were(gone: int) -> None:
    rng = np.random.default_rng(1)
    kept = np.delete(EVEN, np.arange(300, 300 + gone)) + rng.uniform(0, 0.001, 600 - gone)
    found = line_times(np.sort(kept), NONE)
    assert np.flatnonzero(found.missing).tolist() == [300]
    assert found.missing[300] == gone
    assert np.abs(found.late).max() < 0.002


def test_lines_that_answer_others_belong_behind_those_however_uneven_they_left() -> None:
    rng = np.random.default_rng(2)
    sent = np.cumsum(rng.choice([0.004, 0.01, 0.013], 600))
    found = line_times(sent[3:] + 0.006, sent)
    assert np.abs(found.late).max() < 1e-9
    assert not found.missing.any()
    assert not line_times(np.delete(sent[3:], 200) + 0.002, sent).missing[:190].any()


def test_lines_of_one_stamp_are_no_error() -> None:
    assert len(line_times(np.zeros(40), NONE).late) == 40
