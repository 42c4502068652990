"""Tests that turn rows in any order into runs, and runs into wheel angles, rests and blocks."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.log_table import LogError, read
from acsard.calibration.runs import Notes, blocks, gaps, inside, rest_intervals, runs
from tests.unit.calibration.cut import log_of

HEADER = "t,left,right,yaw_rate,run\n"


def rows(start: float, count: int = 100, step: float = 0.01, run: str = "") -> list[str]:
    return [f"{start + i * step:.3f},{i},{i},{i},{run}" for i in range(count)]


def of(lines: list[str]) -> tuple[list[str], list[float], tuple[str, ...]]:
    log = runs(read((HEADER + "\n".join(lines)).encode()))
    return [r.name for r in log.runs], [float(r.t[-1]) for r in log.runs], log.notes


def test_unordered_rows_are_sorted_and_reported() -> None:
    mixed = list(np.random.default_rng(1).permutation(rows(1.7e9, 1000)))
    names, ends, notes = of(mixed)
    assert names == ["1"]
    assert ends == pytest.approx([9.99])
    assert any("out of order" in note for note in notes)


def test_rows_with_repeated_times_are_taken_once_and_reported() -> None:
    log = runs(read((HEADER + "\n".join(rows(0) + rows(0))).encode()))
    assert len(log.runs[0].t) == 100
    assert any("an earlier row has the same time" in note for note in log.notes)


def test_a_time_that_restarts_begins_a_new_run() -> None:
    names, ends, notes = of(rows(0, 500) + rows(0, 300))
    assert (names, len(ends)) == (["1", "2"], 2)
    assert any("the time in the log jumps back; number of jumps: 1" in note for note in notes)


def test_halves_of_a_drive_in_the_wrong_order_stay_one_run() -> None:
    assert of(rows(10, 500) + rows(0, 500))[0] == ["1"]


def test_runs_are_distinguished_by_the_run_column() -> None:
    assert of(rows(0, run="a") + rows(0, run="b"))[0] == ["a", "b"]


@pytest.mark.parametrize(
    ("lines", "names"),
    [
        (rows(0, run="2") + rows(0), ["2", "3"]),
        (rows(0, run="2") + 2 * rows(0, 300), ["2", "3", "4"]),
        (2 * rows(0, 300) + rows(0, run="2"), ["1", "3", "2"]),
        (2 * rows(0, 300, run="a") + rows(0, run="a.2"), ["a", "a.3", "a.2"]),
    ],
)
def test_no_run_gets_the_name_of_another_run(lines: list[str], names: list[str]) -> None:
    assert of(lines)[0] == names


def test_a_run_with_too_few_rows_is_left_out_and_reported() -> None:
    names, _, notes = of(rows(0, run="a") + rows(0, 3, run="b"))
    assert names == ["a"]
    assert any("fewer than 20 rows of wheel speeds: 1" in note for note in notes)


def test_rows_without_a_time_are_reported() -> None:
    assert any("have no time" in n for n in of([*rows(0), ",1,1,1,", ",1,1,1,"])[2])


@pytest.mark.parametrize("rate", [20, 100, 500, 1000])
def test_times_in_milliseconds_are_refused(rate: int) -> None:
    with pytest.raises(LogError, match="t must be in seconds"):
        of(rows(0, step=1000.0 / rate))


@pytest.mark.parametrize("per_second", [1e6, 1e9])
def test_stamps_in_ns_and_us_since_1970_are_refused(per_second: float) -> None:
    lines = [f"{(1.7e9 + i / 100) * per_second:.0f},{i},{i},{i}," for i in range(100)]
    with pytest.raises(LogError, match="t must be in seconds"):
        of(lines)


@pytest.mark.parametrize("form", ["{:g}", "{:.0f}"])
def test_times_rounded_too_coarsely_are_refused(form: str) -> None:
    lines = [f"{form.format(1.7e9 + i / 100)},{i},{i},{i}," for i in range(3000)]
    with pytest.raises(LogError, match="write t in seconds with 3 decimals"):
        of(lines)


def test_a_zero_stamp_before_a_drive_is_left_out() -> None:
    names, ends, notes = of(["0,0,0,0,", *rows(1.7e9, 500)])
    assert names == ["1"]
    assert ends == pytest.approx([4.99])
    assert any("fewer than 20 rows of wheel speeds" in note for note in notes)


def test_a_pause_of_a_day_separates_two_drives() -> None:
    names, ends, notes = of(rows(0, 500) + rows(86_400, 300))
    assert names == ["1", "2"]
    assert ends == pytest.approx([4.99, 2.99])
    assert any("over 60 s in the wheel speeds; number of gaps: 1" in note for note in notes)


def test_a_column_without_any_number_is_refused_by_name() -> None:
    with pytest.raises(LogError, match="column right has no number in any row"):
        of([f"{i},1,,{i}," for i in range(100)])


FOUR = "t,fr,fl,rl,rr,yaw_rate\n"


@pytest.mark.parametrize(
    ("wheels", "words"),
    [
        ("0,9,9,9", "fr hardly turns while rr does"),
        ("9,9,-9,9", "fl and rl turn in opposite directions"),
        ("9,9,-9,-9", "turn in opposite directions"),
        ("9,9,0.1,9", "rl hardly turns while fl does"),
    ],
)
def test_front_and_rear_wheels_that_contradict_each_other_are_refused(
    wheels: str, words: str
) -> None:
    text = FOUR + "".join(f"{i / 100},{wheels},0\n" for i in range(500))
    with pytest.raises(LogError, match=words):
        runs(read(text.encode()))


def test_front_and_rear_wheels_that_differ_slightly_are_reported() -> None:
    text = FOUR + "".join(f"{i / 100},9,9,9,7,0\n" for i in range(500))
    assert any("fr and rr differ by 22%" in n for n in runs(read(text.encode())).notes)


def test_a_run_column_with_a_new_name_in_each_row_is_refused() -> None:
    with pytest.raises(LogError, match="each name must stand for a drive"):
        of([f"{i / 100},{i},{i},{i},{i}" for i in range(2000)])


def test_wheels_with_coarse_encoders_do_not_contradict_each_other() -> None:
    rng, step = np.random.default_rng(1), 2 * np.pi / 16
    angles = np.linspace(0, 40, 1001)[:, None] + rng.uniform(0, 1, 4)
    wheels = np.diff(np.floor(angles / step), axis=0) * step / 0.01
    text = FOUR + "".join(
        f"{i / 100},{','.join(map(str, row))},0\n" for i, row in enumerate(wheels)
    )
    log = runs(read(text.encode()))
    assert len(log.runs) == 1
    assert not log.notes


def test_a_log_without_wheels_is_refused() -> None:
    with pytest.raises(LogError, match="column left has no number in any row"):
        of([f"{i},,,{i}," for i in range(100)])
    with pytest.raises(LogError, match="no run has 20 rows"):
        of([f"{i},{i},{i},{i},{i}" for i in range(100)])


def test_four_wheels_are_the_means_of_two_sides() -> None:
    text = "t,fr,fl,rl,rr,x,y\n" + "\n".join(f"{i / 10},4,1,3,6,{i},{-i}" for i in range(30))
    run = runs(read(text.encode())).runs[0]
    assert (run.left[0], run.right[0]) == (2.0, 5.0)
    assert run.place[2] == 2 - 2j


def test_positions_that_a_logger_repeats_until_the_next_sample_are_taken_once() -> None:
    """The logger repeats positions of 5 Hz in rows of 100 Hz, so that every cell is filled."""
    rows = [f"{i / 100},{4 * (i >= 300)},{4 * (i >= 300)},{max(0, i // 20 - 15) * 0.04:.3f},0"
            for i in range(1000)]  # fmt: skip
    log = runs(read(("t,left,right,x,y\n" + "\n".join(rows)).encode()))
    run = log.runs[0]
    moving = run.place_t >= 3.3
    assert np.diff(run.place_t[moving]) == pytest.approx(0.2)
    assert (run.place_t < 3.0).sum() == 1, (
        "repeated positions at rest would outweigh those of the drive"
    )
    assert any("x y repeat their last value between samples" in note for note in log.notes)


def test_positions_of_half_the_rate_are_recognized_in_one_note_for_all_runs() -> None:
    """Rows of 20 Hz contain positions of 10 Hz. In some runs fewer than half are repeated."""
    rows = []
    for run in range(12):
        early = run % 2  # so many more positions are new
        rows += [
            f"{i / 20},4,4,{0.02 * (i if i < 10 * early else i // 2 * 2):.3f},0,{run}"
            for i in range(100)
        ]
    log = runs(read(("t,left,right,x,y,run\n" + "\n".join(rows)).encode()))
    assert [len(run.place) for run in log.runs] == [50, 55] * 6
    (note,) = log.notes
    assert note.startswith(
        "the columns x y repeat their last value between samples: such rows are left out (570 of"
    )


def test_one_note_sums_an_event_over_all_runs() -> None:
    notes = Notes(["columns not used: a"])
    for count in (3, 0, 4):
        notes.add("{} rows of yaw are out of order", count)
    notes.add("short runs are left out: {} of them", 1)
    assert notes.sentences() == (
        "columns not used: a", "7 rows of yaw are out of order (in 2 runs)",
        "short runs are left out: 1 of them",
    )  # fmt: skip


def test_a_repeated_position_of_the_drive_is_not_taken_for_the_rest_after_it() -> None:
    """The logger repeats positions of 1 Hz in every row.

    The rows after the stop therefore still contain the last position from the drive.
    """
    way = [0.04 * min(i, 550) for i in range(1000)]
    rows = [f"{i / 100},{4 * (i < 550)},{4 * (i < 550)},{way[i // 100 * 100]:.3f},0"
            for i in range(1000)]  # fmt: skip
    run = runs(read(("t,left,right,x,y\n" + "\n".join(rows)).encode())).runs[0]
    assert not ((run.place_t > 5.5) & (run.place_t < 6.0)).any()


def drive(*parts: tuple[float, float, float]) -> str:
    """Return a log of parts (from, to, rad/s) at 100 Hz; the right side turns backward."""
    lines = []
    for begin, end, speed in parts:
        lines += [f"{t:.2f},{speed},{-speed},," for t in np.arange(begin, end, 0.01)]
    return HEADER + "\n".join(lines)


def test_angles_are_sums_of_speeds() -> None:
    turned = log_of(drive((0, 10, 2.0))).runs[0]
    left, right = turned.angles(np.array([0.0, 5.0, 9.0]))
    assert np.allclose(left, [0, 10, 18])
    assert np.allclose(right, [0, -10, -18])


def test_angles_stay_constant_over_a_gap() -> None:
    turned = log_of(drive((0, 5, 2.0), (8, 10, 2.0))).runs[0]
    assert turned.gaps.shape == (1, 2)
    left, _ = turned.angles(np.array([4.99, 8.0]))
    assert left[0] == left[1]


def test_an_interval_that_overlaps_a_gap_is_not_inside() -> None:
    holes = gaps(np.concatenate((np.arange(0, 5, 0.1), np.arange(7, 9, 0.1))))
    begin, end = np.array([1.0, 4.0, 5.5, 7.5]), np.array([2.0, 6.0, 6.5, 8.0])
    assert inside(begin, end, holes).tolist() == [True, False, False, True]


def test_a_rest_is_an_interval_in_which_all_wheels_stand_long_enough() -> None:
    run = log_of(drive((0, 2, 0.0), (2, 4, 1.0), (4, 4.5, 0.0), (4.5, 6, 1.0), (6, 8, 0.01))).runs[
        0
    ]
    intervals = rest_intervals(run, 1.0, 0.2)
    assert np.allclose(intervals, [[0.2, 1.79], [6.2, 7.79]], atol=0.02)


def test_blocks_leave_out_standstills_and_gaps() -> None:
    runs = log_of(drive((0, 100, 0.0), (100, 140, 1.0), (160, 200, 1.0))).runs
    parts = blocks(runs, 4.0)
    assert 14 <= len(parts) <= 18
    assert all(part.end > 100 and not part.begin < 150 < part.end for part in parts)
