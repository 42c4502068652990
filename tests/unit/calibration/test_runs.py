"""Rows in any order -> drives."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.runs import runs
from acsard.calibration.table import LogError, read

HEADER = "t,left,right,yaw_rate,run\n"


def rows(start: float, count: int = 100, step: float = 0.01, run: str = "") -> list[str]:
    return [f"{start + i * step:.3f},{i},{i},{i},{run}" for i in range(count)]


def of(lines: list[str]) -> tuple[list[str], list[float], tuple[str, ...]]:
    log = runs(read((HEADER + "\n".join(lines)).encode()))
    return [r.name for r in log.runs], [float(r.t[-1]) for r in log.runs], log.notes


def test_rows_in_no_order_are_sorted_and_told() -> None:
    mixed = list(np.random.default_rng(1).permutation(rows(1.7e9, 1000)))
    names, ends, notes = of(mixed)
    assert names == ["1"]
    assert ends == pytest.approx([9.99])
    assert any("out of order" in note for note in notes)


def test_repeated_times_are_taken_once_and_told() -> None:
    log = runs(read((HEADER + "\n".join(rows(0) + rows(0))).encode()))
    assert len(log.runs[0].t) == 100
    assert any("repeat a time" in note for note in log.notes)


def test_a_time_that_begins_anew_begins_a_run() -> None:
    names, ends, notes = of(rows(0, 500) + rows(0, 300))
    assert (names, len(ends)) == (["1", "2"], 2)
    assert any("begins anew" in note for note in notes)


def test_halves_of_a_drive_in_the_wrong_order_stay_one_run() -> None:
    assert of(rows(10, 500) + rows(0, 500))[0] == ["1"]


def test_runs_are_told_apart_by_their_column() -> None:
    assert of(rows(0, run="a") + rows(0, run="b"))[0] == ["a", "b"]


def test_a_run_with_too_few_rows_is_left_out_and_told() -> None:
    names, _, notes = of(rows(0, run="a") + rows(0, 3, run="b"))
    assert names == ["a"]
    assert any("run b has 3 rows" in note for note in notes)


def test_rows_without_a_time_are_told() -> None:
    assert any("have no time" in n for n in of([*rows(0), ",1,1,1,", ",1,1,1,"])[2])


def test_milliseconds_are_told_from_seconds() -> None:
    with pytest.raises(LogError, match="t is in seconds"):
        of(rows(0, step=10.0))


def test_a_log_without_wheels_is_refused() -> None:
    with pytest.raises(LogError, match="no run has 20 rows"):
        of([f"{i},,,{i}," for i in range(100)])


def test_four_wheels_are_the_means_of_two_sides() -> None:
    text = "t,fr,fl,rl,rr,x,y\n" + "\n".join(f"{i / 10},4,1,3,6,{i},{-i}" for i in range(30))
    run = runs(read(text.encode())).runs[0]
    assert (run.left[0], run.right[0]) == (2.0, 5.0)
    assert run.place[2] == 2 - 2j
