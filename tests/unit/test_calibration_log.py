"""Tests of the one CSV format of a log, and of the runs that are made of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

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


def series(t: Any, *columns: Any) -> list[str]:
    return [",".join(f"{v:.4f}" for v in row) for row in zip(t, *columns, strict=True)]


def steady(t: Any, header: str = HEADER) -> bytes:
    return text(series(t, *(np.full(len(t), v) for v in (2.0, 3.0, 0.1))), header)


def test_a_run_has_8_rows_and_1_5_s() -> None:
    for count, step in ((32, 0.05), (8, 0.3)):
        assert len(read(steady(step * np.arange(count))).runs[0].t) == count
    for count, step in ((30, 0.05), (7, 0.3)):
        with pytest.raises(LogError, match=r"no run has 8 rows and 1\.5 s"):
            read(steady(step * np.arange(count)))
    log = read(steady(np.concatenate((0.05 * np.arange(100), 90 + 0.05 * np.arange(20)))))
    assert log.notes[-1] == "runs left out because they are too short: 1"


def test_rows_up_to_1_5_s_apart_and_6_h_make_a_log() -> None:
    assert read(steady(1.4 * np.arange(20))).runs[0].seconds == pytest.approx(26.6)
    with pytest.raises(LogError, match=r"rows of the wheels are 1\.6 s apart"):
        read(steady(1.6 * np.arange(20)))
    assert read(steady(1.4 * np.arange(15_300))).runs[0].seconds == pytest.approx(21418.6)
    with pytest.raises(LogError, match="the drive lasts 6 h"):
        read(steady(1.4 * np.arange(15_500)))


@pytest.mark.parametrize(
    ("step", "gap", "runs"),
    [
        (0.05, 0.95, 1), (0.05, 1.05, 2), (0.2, 1.5, 1), (0.2, 1.7, 2), (0.05, -0.95, 1),
        (0.05, -1.05, 2), (0.05, -2.0, 2),
    ],
)  # fmt: skip
def test_a_jump_back_and_a_gap_end_a_run(step: float, gap: float, runs: int) -> None:
    t = step * np.arange(100)
    log = read(steady(np.concatenate((t, t[-1] + gap + t))))
    assert len(log.runs) == runs
    if runs == 2:
        assert [len(run.t) for run in log.runs] == [100, 100]
        assert ("after a gap" in log.notes[0]) is (gap > 0)


def test_a_column_run_with_more_than_1000_names_is_refused() -> None:
    rows = [f"{line},{n}" for n, line in enumerate(lines(1001))]
    with pytest.raises(LogError, match="column run has 1001 different names"):
        read(text(rows, f"{HEADER},run"))
    with pytest.raises(LogError, match="no run has"):
        read(text(rows[:1000], f"{HEADER},run"))


@pytest.mark.parametrize(
    ("header", "words"),
    [("t_ms,left,right,yaw_rate", 'the column "t_ms" is not .* name it t, .* values in s'),
     ("t,left_rpm,right,yaw_rate", 'the column "left_rpm" .* name it left, .* in rad/s'),
     ("t,left,right,yaw_rate,run,run", "names a column twice")],
)  # fmt: skip
def test_a_column_with_another_unit_is_named(header: str, words: str) -> None:
    with pytest.raises(LogError, match=words):
        read(text(lines(), header))


def test_four_wheels_count_by_the_mean_of_their_side() -> None:
    t = 0.05 * np.arange(200)
    front, rear = 2 + np.sin(t), 2 - np.sin(t)
    header = "t,fr,fl,rl,rr,yaw_rate"
    (run,) = read(text(series(t, rear, front, 1.05 * front, 1.1 * rear, 0 * t), header)).runs
    (two,) = read(text(series(t, 1.025 * front, 1.05 * rear, 0 * t))).runs
    assert run.left == pytest.approx(np.asarray(two.left), abs=0.01)
    assert run.right == pytest.approx(np.asarray(two.right), abs=0.01)
    for share in (0.86, 1.17):
        read(text(series(t, rear, front, share * front, rear, 0 * t), header))
    for share in (0.84, 1.19):
        with pytest.raises(LogError, match=r"rolls otherwise than (rl|fl) by 16%"):
            read(text(series(t, rear, front, share * front, rear, 0 * t), header))


def test_a_gyro_that_repeats_its_value_for_more_than_1_s_of_turning_is_left_out() -> None:
    t = 0.05 * np.arange(400)
    left, right, rate = 4 + 3 * np.sin(t), 4 - 3 * np.sin(t), -0.2 * np.sin(t)
    for begin, seconds, left_out in ((3.0, 0.9, 0), (3.0, 1.1, 23), (3.0, 5.0, 101)):
        hung = (t > begin - 1e-6) & (t < begin + seconds + 1e-6)
        shown = np.where(hung, rate[np.argmax(hung)], rate)
        log = read(text(series(t, left, right, shown)))
        assert len(log.runs[0].gyro_t) == 400 - left_out
        assert len(log.notes) == bool(left_out)
    assert "exactly from 3 s to 8 s of run 1 (101 samples)" in log.notes[0]
    log = read(text(series(t, 0 * t + 2.0, 0 * t + 2.0, np.where(hung, 0.1, rate))))
    assert not log.notes  # it repeats what the wheels do


def test_positions_and_headings_that_repeat_the_row_before_are_left_out() -> None:
    t = 0.05 * np.arange(200)
    often = np.repeat(t[::4], 4)
    data = text(series(t, 0 * t + 2.0, 0 * t + 2.0, often, 0 * t, often), "t,left,right,x,y,yaw")
    log = read(data)
    assert (len(log.runs[0].place_t), len(log.runs[0].yaw_t)) == (50, 50)
    assert log.runs[0].place_t[:2] == pytest.approx([0.0, 0.2])
    assert log.notes == ("rows of x y and yaw left out, because they repeat the row before: 300",)


def test_a_single_wrong_position_is_left_out() -> None:
    t = 0.05 * np.arange(200)
    x = 0.1 * t + 0.001 * np.sin(40 * t)
    x[70] += 3.0
    log = read(text(series(t, 0 * t + 2.0, 0 * t + 2.0, x, 0 * t), "t,left,right,x,y"))
    assert len(log.runs[0].place) == 199
    assert log.notes == ("rows of x, y left out, far from those beside them: 1",)


def test_a_run_stands_where_its_wheels_hardly_roll() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    run = read(text(series(t, *(2.0 * (t > 3.0),) * 2, 0 * t))).runs[0]
    rests = run.rests(np.array([0.1, 0.2, 1.0, 2.75, 2.9, 4.0, 5.9]))
    assert rests.tolist() == [False, True, True, True, False, False, False]
    assert run.edges(2.0) == pytest.approx([0.0, 5.95 / 3, 2 * 5.95 / 3, 5.95])
    assert run.edges(60.0) == pytest.approx([0.0, 5.95])
    part = run.part(1.0, 2.0)
    assert (part.t[0], part.t[-1]) == pytest.approx((1.0, 2.0))
    assert len(part.t) == len(part.left) == len(part.right) == 21


def test_a_distance_is_as_sure_as_a_tape() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    (*_, run) = with_distance(read(text(series(t, 0 * t + 2, 0 * t + 2.1, 0 * t))), "", 0.6).runs
    assert (run.tape[0].std, run.tape[0].quantity) == (0.01, "distance")
    for left, right in ((2.0, 2.6), (2.0, -2.0), (0.5, 0.5)):  # curved, on the spot, too short
        with pytest.raises(LogError, match="is not straight"):
            with_distance(read(text(series(t, 0 * t + left, 0 * t + right, 0 * t))), "", 0.6)


def test_a_distance_is_refused_for_a_run_that_rocks() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    for rocks, straight in ((0.0, True), (6.0, False)):
        for sides in ((2 + rocks * np.sin(t * math.tau), 0 * t + 2),
                      (0 * t + 2, 2 + rocks * np.sin(t * math.tau))):  # fmt: skip
            log = read(text(series(t, *sides, 0 * t)))
            if straight:
                assert len(with_distance(log, "", 0.6).runs) == 2
            else:
                with pytest.raises(LogError, match="is not straight"):
                    with_distance(log, "", 0.6)


def test_the_straightness_that_a_distance_needs_is_90_percent() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    for share, straight in ((1.068, True), (1.075, False)):
        log = read(text(series(t, 0 * t + 2.0, 0 * t + 2.0 * share, 0 * t)))
        if straight:
            assert with_distance(log, "1", 0.6).runs[-1].tape[0].value == 0.6
        else:
            with pytest.raises(LogError, match="is not straight"):
                with_distance(log, "1", 0.6)


def test_a_measured_run_rolls_5_rad_at_least_ahead_or_back() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    for rolled, straight in ((4.9, False), (5.1, True), (-5.1, True)):
        log = read(text(series(t, *(0 * t + rolled / t[-1],) * 2, 0 * t)))
        if straight:
            assert with_distance(log, "", 0.25).runs[-1].name == "1"
        else:
            with pytest.raises(LogError, match="is not straight"):
                with_distance(log, "", 0.25)


def test_a_part_behind_a_gap_needs_8_rows_too() -> None:
    t = 0.3 * np.arange(20)
    for rows, runs in ((7, 1), (8, 2)):
        log = read(steady(np.concatenate((t, 90 + t[:rows]))))
        assert len(log.runs) == runs
        log = read(steady(np.concatenate((90 + t, t[:rows]))))
        assert len(log.runs) == runs


def test_a_column_beside_the_needed_one_may_have_its_name_with_a_unit() -> None:
    log = read(text([f"{line},9" for line in lines()], f"{HEADER},left_rpm"))
    assert log.notes == ("columns not used: left_rpm",)


def test_an_encoder_at_rest_may_rock_by_0_03_rad() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    for speed, rests in ((0.07, True), (0.08, False)):
        for sides in ((speed, 0.0), (0.0, -speed)):
            (run,) = read(text(series(t, 0 * t + sides[0], 0 * t + sides[1], 0 * t))).runs
            assert run.rests(np.array([3.0])).tolist() == [rests]
    at = np.array([0.19, 0.21, 5.74, 5.76])  # within 0.4 s around them
    assert run.rests(at).tolist() == [False] * 4
    (run,) = read(steady_at_zero(t)).runs
    assert run.rests(at).tolist() == [False, True, True, False]


def steady_at_zero(t: Floats) -> bytes:
    return text(series(t, 0 * t, 0 * t, 0 * t))


def test_all_columns_of_a_run_begin_at_its_first_row_of_the_wheels() -> None:
    t = 100.0 + 0.05 * np.arange(200)
    header = "t,left,right,yaw_rate,x,y,yaw,applied_linear,applied_angular"
    (run,) = read(text(series(t, 0 * t + 2, 0 * t + 3, 0 * t + 0.5, t, -t, 0.1 * t, 0 * t + 0.4,
                              0 * t - 0.3), header)).runs  # fmt: skip
    for times in (run.t, run.gyro_t, run.place_t, run.yaw_t, run.commands_t):
        assert np.asarray(times) == pytest.approx(t - 100.0)
    assert run.place[0] == pytest.approx(100 - 100j)
    assert run.yaw[-1] == pytest.approx(0.1 * t[-1], abs=1e-4)
    assert run.commands[0] == pytest.approx([0.4, -0.3])
    assert (run.left[-1], run.right[-1]) == pytest.approx((2 * 9.95, 3 * 9.95))
    assert run.turned[-1] == pytest.approx(0.5 * 9.95)
    part = run.part(2.0, 4.0)
    assert [len(v) for v in (part.t, part.place_t, part.yaw_t, part.place, part.yaw)] == [41] * 5
    assert len(part.gyro_t) == len(part.rate) == len(run.gyro_t)  # its delay is not known yet
    assert (part.place_t[0], part.place_t[-1]) == pytest.approx((2.0, 4.0))
    assert part.seconds == pytest.approx(2.0)


def test_sensors_may_begin_earlier_and_end_later_than_the_wheels() -> None:
    rows = [(0.05 * n, "2", "2", "") for n in range(400)]
    rows += [(0.05 * n + 0.01, "", "", "0.1") for n in range(-100, 500)]
    data = text([f"{t:.2f},{a},{b},{w}" for t, a, b, w in sorted(rows)])
    (run,) = read(data).runs
    assert (run.gyro_t[0], run.gyro_t[-1]) == pytest.approx((-1.0, 20.9), abs=0.06)
    data = text([f"{t:.2f},{a},{b},{w}" for t, a, b, w in sorted(rows) if not (a and t > 4.0)])
    (run,) = read(data).runs
    assert (run.gyro_t[0], run.gyro_t[-1]) == pytest.approx((-0.4, 4.4), abs=0.06)


def test_programs_that_write_all_wheels_by_turns_are_named() -> None:
    speed = np.repeat([0.1, 2.0], [36, 120])
    mixed = np.where(np.arange(len(speed)) % 2, 0.5 * speed, speed)
    t = 0.05 * np.arange(len(speed))
    with pytest.raises(LogError, match=r"^in left and right, two series of values alternate"):
        read(text(series(t, mixed, mixed, 0 * t)))
    (run,) = read(text(series(t, mixed, speed, 0 * t))).runs
    assert run.mixed == "left"  # it may be a coarse encoder


def test_rows_with_the_time_of_another_row_are_left_out() -> None:
    rows = lines()
    rows.insert(51, rows[50].replace(",2,", ",9,"))
    log = read(text(rows))
    assert len(log.runs[0].t) == 200
    assert log.notes == (
        "rows of left right left out, with the time of another row: 1",
        "rows of yaw_rate left out, with the time of another row: 1",
    )
    assert log.runs[0].right[-1] == pytest.approx(2 * 9.95)


def test_of_two_wheels_of_a_side_the_one_that_stands_is_dead() -> None:
    t = 0.05 * np.arange(400)
    turn = 3 * np.sin(t)
    for stands, words in ((0.019, "it stands still meanwhile"), (0.021, "another unit")):
        rear = np.where(t > 10.0, stands, turn)
        rows = series(t, turn, turn, rear, turn, 0 * t)
        with pytest.raises(LogError, match=f"rl rolls otherwise than fl by .*{words}"):
            read(text(rows, "t,fr,fl,rl,rr,yaw_rate"))
    rows = series(t, turn, turn, turn, np.where(t > 10.0, 0.0, turn), 0 * t)
    with pytest.raises(LogError, match=r"rr rolls otherwise than fr by .*it stands still"):
        read(text(rows, "t,fr,fl,rl,rr,yaw_rate"))
