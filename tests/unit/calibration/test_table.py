"""CSV files of strangers: what is read, what is left out, and what a refusal says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.table import LogError, read

HEADER = b"t,left,right,yaw_rate\n"


def test_columns_may_be_in_any_order_with_spaces_comments_units_and_empty_cells() -> None:
    table = read(
        b"# of today\n yaw_rate [rad/s] , t (s),right,  Left\n0.5, 1.0 ,, # nothing\n\n,2,3,4\n"
    )
    assert table.columns["t"].tolist() == [1.0, 2.0]
    assert table.columns["left"][1] == 4.0
    assert np.isnan(table.columns["right"][0])
    assert np.isnan(table.columns["yaw_rate"][1])


def test_a_header_may_be_the_last_comment_before_the_numbers() -> None:
    assert read(b"# mine\n# t,left,right,yaw_rate\n1,2,3,4\n").columns["yaw_rate"][0] == 4.0


@pytest.mark.parametrize(
    "text",
    ["t;left;right;yaw_rate\n1,5;2;3;4\n", "t\tleft\tright\tyaw_rate\n1.5\t2\t3\t4\n"],
)
def test_other_separators_are_known_by_the_header(text: str) -> None:
    assert read(text.encode()).columns["t"][0] == 1.5
    assert read(text.encode("utf-16")).columns["t"][0] == 1.5


def test_runs_are_told_apart_by_any_name() -> None:
    table = read(b"run,t,left,right,yaw_rate\ncw 1,1,2,3,4\nccw,1,2,3,4\ncw 1,2,2,3,4\n")
    assert table.names == ("cw 1", "ccw")
    assert table.runs.tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "it is empty"),
        (b"# only this\n", "it is empty"),
        (HEADER, "no rows below the header"),
        (b"1,2,3,4\n", "line 1 is numbers"),
        (b"t,left,right\n1,2,3\n", "nothing to compare the wheels with"),
        (b"t,fr,fl,rr,yaw_rate\n1,2,3,4,5\n", "no column left, right"),
        (b"t,left,right,yawrate\n1,2,3,4\n", "is yawrate it?"),
        (b"timestamp,left,right,yaw_rate\n1,2,3,4\n", "is timestamp it? rename it t"),
        (b"t left right yaw_rate\n1 2 3 4\n", "without commas"),
        (b"t,left,right,left,x,y\n1,2,3,4,5,6\n", "left is there twice"),
        (HEADER + b"1,2,three,4\n", 'line 2, column right: "three" is no number'),
        (HEADER + b"1,2,3,4,5\n", "line 2 has 5 cells, the header 4"),
        (b"SQLite format 3\0\0\0", "not text"),
    ],
)
def test_a_refusal_says_where_and_what(data: bytes, words: str) -> None:
    with pytest.raises(LogError, match=r".") as refused:
        read(data)
    assert words in str(refused.value)


def test_few_bad_rows_are_left_out_and_told() -> None:
    table = read(HEADER + b"1,2,3,4\n" * 50 + b"1,2,3,x\n" + b"1,2")
    assert len(table.columns["t"]) == 51
    assert table.notes == ('1 row left out: line 52, column yaw_rate: "x" is no number',)


def test_many_bad_rows_refuse_the_file() -> None:
    with pytest.raises(LogError, match="4 of 54 rows"):
        read(HEADER + b"1,2,3,4\n" * 50 + b"1,2,3,x\n" * 4)


def test_what_is_no_measurement_counts_as_missing_and_is_told() -> None:
    table = read(HEADER + b"1,1e300,inf,nan\n2,1,1,1\n")
    assert np.isnan(table.columns["left"][0])
    assert np.isnan(table.columns["right"][0])
    assert len(table.notes) == 2


def test_a_spike_counts_as_missing_and_a_fast_drive_does_not() -> None:
    lines = [f"{i},{i % 10},{i % 10},0.1" for i in range(200)]
    lines[70] = "70,900,5,-40"
    table = read(HEADER + "\n".join(lines).encode())
    assert np.flatnonzero(np.isnan(table.columns["left"])).tolist() == [70]
    assert np.flatnonzero(np.isnan(table.columns["yaw_rate"])).tolist() == [70]
    assert not np.isnan(table.columns["right"]).any()
    assert len(table.notes) == 2


def test_columns_that_are_not_used_are_told() -> None:
    assert read(b"t,left,right,yaw_rate,volts\n1,2,3,4,5\n").notes == ('columns not used: "volts"',)


@given(st.binary(max_size=300), st.integers(0, 100))
def test_garbage_anywhere_is_refused_or_left_out(garbage: bytes, at: int) -> None:
    good = HEADER + b"1,2,3,4\n" * 10
    try:
        table = read(good[:at] + garbage + good[at:])
    except LogError:
        return
    assert set(table.columns) >= {"t"}
    assert len(table.runs) == len(table.columns["t"])
