"""Tests of the one CSV format of a log, and of the runs that are made of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from acsard.calibration.log import LogError, read, with_distance
from acsard.calibration.series import Floats
from tests.unit.calibration_logs import run, usual
from tests.unit.calibration_robots import Robot, drive

HEADER = "t,left,right,yaw_rate"


def lines(count: int = 200, start: float = 0.0, speed: float = 2.0) -> list[str]:
    t = start + 0.05 * np.arange(count)
    return [f"{a:.3f},{speed + 0.01 * n},{speed},{0.001 * n}" for n, a in enumerate(t)]


def text(rows: list[str], header: str = HEADER) -> bytes:
    return "\n".join([header, *rows, ""]).encode()


def test_a_csv_file_gives_the_same_run_as_its_samples() -> None:
    trip = usual()
    (made,) = read(trip.csv().encode()).runs
    direct = run(trip)
    for name in ("t", "left", "right", "turned", "place_t", "place"):
        assert np.asarray(getattr(made, name)) == pytest.approx(
            np.asarray(getattr(direct, name)), abs=2e-3
        )


def test_columns_may_be_in_any_order_and_others_are_named_in_a_note() -> None:
    rows = [",".join([*reversed(line.split(",")), "7"]) for line in lines()]
    log = read(text(rows, "yaw_rate,right,left,t,battery"))
    assert log.runs[0].left[-1] > log.runs[0].right[-1]
    assert log.notes == ("columns not used: battery",)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\xff\xfe", "is not text"),
        (b"", "does not name t, left, right, yaw_rate"),
        (b"a,b\n1,2\n", "does not name t, left, right"),
        (b"t,left,right,yaw_rate,t\n1,2,3,4,5\n", "a column twice"),
        (b"t,left,right,yaw_rate\n", "no rows below the header"),
        (b"t;left;right\n1;2;3\n", "does not name"),
        (text(["0,1,1,1", "0.1,one,1,1", "0.2,1,1,1"]), 'line 3 is "0.1,one,1,1"'),
        (text(["0,1,1", "0.1,1,1,1"]), "line 2"),
        (text(lines(5)), "no run has 8 rows"),
        (text([f"{n // 10},1,1,1" for n in range(300)]), "only 30 different times"),
    ],
)
def test_a_file_in_another_form_is_refused_with_the_place(data: bytes, words: str) -> None:
    with pytest.raises(LogError) as refused:
        read(data)
    assert words in str(refused.value)


def test_a_last_line_that_was_cut_off_is_left_out() -> None:
    log = read(text([*lines(), "10.000,2.0,2"]).rstrip())
    assert len(log.runs[0].t) == 200
    assert log.notes == ("the last line is cut off and left out",)


def test_a_new_run_begins_after_a_jump_back_and_after_a_gap() -> None:
    log = read(text([*lines(), *lines(start=-50.0), *lines(start=1000.0)]))
    assert [run.name for run in log.runs] == ["1", "2", "3"]
    assert [run.seconds for run in log.runs] == pytest.approx([9.95] * 3)
    assert len(log.notes) == 2


def test_the_column_run_names_the_runs() -> None:
    rows = [f"{line},square" for line in lines()] + [f"{line},turns" for line in lines(start=99.0)]
    rows += [f"{line},turns" for line in lines(start=500.0)]
    log = read(text(rows, f"{HEADER},run"))
    assert [run.name for run in log.runs] == ["square", "turns", "turns.2"]


def test_single_wrong_cells_are_left_out_with_a_note() -> None:
    rows = lines()
    rows[50] = "2.5,5000,2,0.05"
    log = read(text(rows))
    assert len(log.runs[0].t) == 199
    assert log.notes == ("cells of left left out, far from those beside them, such as 5000: 1",)


@pytest.mark.parametrize(
    ("wheel", "words"),
    [
        (lambda fl, fr, t: 0 * fl, "dead, or its cable loose"),
        (lambda fl, fr, t: np.where(t > 12.0, 0.0, fl), "dead, or its cable loose"),
        (lambda fl, fr, t: -fl, "wrong sign"),
        (lambda fl, fr, t: fr, "of the other side"),
        (lambda fl, fr, t: fl / 2, "another unit or other counts"),
        (lambda fl, fr, t: 2 * fl, "another unit or other counts"),
    ],
)
def test_a_wheel_that_rolls_otherwise_than_its_neighbour_is_refused_with_the_cause(
    wheel: Callable[..., Floats], words: str
) -> None:
    t = 0.05 * np.arange(400)
    left, right = 2 + 4 * np.sin(t), 2 - 4 * np.sin(t)
    columns = (t, right, wheel(left, right, t), left, right, 0 * t)
    rows = [",".join(f"{v:.4f}" for v in row) for row in zip(*columns, strict=True)]
    with pytest.raises(LogError, match=r"(rl|fl) rolls otherwise than (fl|rl) by \d+%") as refused:
        read(text(rows, "t,fr,fl,rl,rr,yaw_rate"))
    assert words in str(refused.value)


def test_a_distance_is_that_of_the_straightest_run_or_of_the_named_one() -> None:
    ahead = drive(Robot(), [(1, 0, 0), (8, 0.4, 0), (1, 0, 0)])
    data = usual().csv(run="turns") + ahead.csv(run="straight").partition("\n")[2]
    log = read(data.encode())
    for name in ("", "straight"):
        measured = with_distance(log, name, 3.2).runs[-1]
        assert (measured.name, measured.tape[0].value) == ("straight", 3.2)
        assert not len(measured.gyro_t)
    with pytest.raises(LogError, match="run turns do not roll alike"):
        with_distance(log, "turns", 3.2)
    with pytest.raises(LogError, match='no run "square"; there are turns, straight'):
        with_distance(log, "square", 3.2)
