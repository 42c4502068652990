"""Tests of the table of a log: columns, units, spikes, and rows of recorded messages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.log_table import (
    HEADER,
    KEYS,
    Floats,
    LogError,
    bounded,
    factor,
    parted,
    read,
    row,
)
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.messages.schema import (
    Header,
    Imu,
    JointState,
    Message,
    Pose,
    PoseStamped,
    Quaternion,
    ServiceReply,
    Time,
    Vector3,
)
from tests.each import each
from tests.unit.calibration import cut

LOG_HEADER = b"t,left,right,yaw_rate\n"


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
def test_separators_and_encodings_are_recognized_from_the_header(text: str) -> None:
    assert read(text.encode()).columns["t"][0] == 1.5
    assert read(text.encode("utf-16")).columns["t"][0] == 1.5


@each("place", ["first", "last"])
@each("name", ["#1", "lap #2", "cw # slow", '"a, b"'])
def test_a_run_may_have_any_character_in_its_name(name: str, place: str) -> None:
    header, row = b"t,left,right,yaw_rate", "{},2,3,4"
    cells = [f"{name},{row}" if place == "first" else f"{row},{name}"] * 3
    names = b"run," + header if place == "first" else header + b",run"
    text = "\n".join(field.format(t) for t, field in enumerate(cells))
    table = read(names + b"\n" + text.encode())
    assert table.names == (name.strip('"'),)
    assert table.columns["t"].tolist() == [0.0, 1.0, 2.0]
    assert not table.notes


@pytest.mark.parametrize(
    "row",
    [
        "1,2,3,4 # slipped, perhaps, or not",
        "1,2,3,4,# slipped, perhaps",
        "# 1,2,3,5\n1,2,3,4",
        "1,2,3,4\n#9,2,3,4",
    ],
)
def test_a_comment_may_follow_the_numbers_or_have_a_line_of_its_own(row: str) -> None:
    table = read(LOG_HEADER + row.encode())
    assert table.columns["yaw_rate"].tolist() == [4.0]
    assert not table.notes


def test_a_text_in_an_unused_column_may_have_a_number_sign() -> None:
    table = read(b"t,note,left,right,yaw_rate\n1,try #3,2,3,4\n")
    assert table.columns["yaw_rate"].tolist() == [4.0]


def test_a_cell_with_a_number_sign_among_its_digits_is_not_a_number() -> None:
    """C on Windows writes NaN like this. The number before the sign is not a speed."""
    table = read(LOG_HEADER + b"1,2,3,4\n2,1.#QNAN,3,4\n3,#N/A,--,4\n")
    assert table.columns["t"].tolist() == [1.0, 3.0]
    assert np.isnan(table.columns["left"][1])
    assert np.isnan(table.columns["right"][1])
    assert "not a number" in table.notes[0]


def test_runs_are_distinguished_by_any_name() -> None:
    table = read(b"run,t,left,right,yaw_rate\ncw 1,1,2,3,4\nccw,1,2,3,4\ncw 1,2,2,3,4\n")
    assert table.names == ("cw 1", "ccw")
    assert table.runs.tolist() == [0, 1, 0]


def test_few_bad_rows_are_left_out_and_reported() -> None:
    table = read(LOG_HEADER + b"1,2,3,4\n" * 50 + b"1,2,3,x\n" + b"1,2")
    assert len(table.columns["t"]) == 51
    assert table.notes == ('1 row left out: line 52, column yaw_rate: "x" is not a number',)


def test_a_file_with_many_bad_rows_is_refused() -> None:
    with pytest.raises(LogError, match="4 of 54 rows"):
        read(LOG_HEADER + b"1,2,3,4\n" * 50 + b"1,2,3,x\n" * 4)


def test_a_value_that_is_not_a_measurement_counts_as_missing_and_is_reported() -> None:
    table = read(LOG_HEADER + b"1,1e300,inf,nan\n2,1,1,1\n")
    assert np.isnan(table.columns["left"][0])
    assert np.isnan(table.columns["right"][0])
    assert len(table.notes) == 2


def test_columns_that_are_not_used_are_reported() -> None:
    assert read(b"t,left,right,yaw_rate,volts\n1,2,3,4,5\n").notes == ('columns not used: "volts"',)


# files as other loggers write them

ROWS = [(i / 100, i % 7 + 0.25, i % 5 + 0.5, 0.125) for i in range(40)]
NAMES = ["t", "left", "right", "yaw_rate"]


def written(separator: str = ",", point: str = ".", end: str = "\n", more: str = "") -> str:
    rows = (separator.join(f"{v:.3f}".replace(".", point) for v in row) + more for row in ROWS)
    return end.join([separator.join(NAMES) + more, *rows]) + end


FOREIGN: dict[str, bytes] = {
    "a byte order mark": b"\xef\xbb\xbf" + written().encode(),
    "UTF-16": written("\t").encode("utf-16"),
    "lines of Windows": written(end="\r\n").encode(),
    "lines of old Macs": written(end="\r").encode(),
    "semicolons and decimal commas": written(";", ",").encode(),
    "semicolons and a hint for a spreadsheet": ("sep=;\n" + written(";", ",")).encode(),
    "a comma in a unit": written(";").replace("rate", "rate (rad/s, up)").encode(),
    "tabs": written("\t").encode(),
    "trailing commas": written(more=",").encode(),
    "commas enough for a whole sheet": written(more=",,,,,").encode(),
    "empty lines": written(end="\n\n").encode(),
    "capitals and spaces": written().replace("yaw_rate", "Yaw Rate").replace("t,", "T,").encode(),
    "names in quotes": written().replace("t,left", '"t","left"').encode(),
    "all in quotes": "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in written().splitlines()
    ).encode(),
    "a comment of MATLAB's": ("% " + written()).encode(),
    "one log behind another": (written() + written()).encode(),
    "other units": "\n".join(
        ["t [ms],left [rpm],right (deg/s),yaw_rate (°/s)"]
        + [
            f"{1000 * t:.6f},{a * 60 / math.tau:.9f},{math.degrees(b):.9f},{math.degrees(w):.9f}"
            for t, a, b, w in ROWS
        ]
    ).encode(),
}


@each("how", FOREIGN)
def test_a_file_of_another_logger_gives_the_same_table(how: str) -> None:
    table = read(FOREIGN[how])
    matrix = np.column_stack([table.columns[name] for name in NAMES])
    assert matrix[:40] == pytest.approx(np.array(ROWS))
    assert not [note for note in table.notes if "not used" not in note]


@each(
    ("data", "words"),
    [
        (written(point=",").encode(), "write numbers with a decimal point"),
        (written(";").replace(".", "'").encode(), "write numbers with a decimal point"),
        (written().replace("0.", "12:00:00.").encode(), "a date, but t must be in seconds"),
        (written(" ").encode(), "no commas between"),
        (written().replace("yaw_rate", "gyro_z").encode(), "the header must name yaw_rate"),
        (
            written().replace("t,l", "time_ms,l").encode(),
            "if column time_ms is the time, rename it to t and convert it to seconds",
        ),
        (b"%time,field.left,field.right\n1,2,3\n", "if column time is the time, rename it to t"),
        (b"", "the file is empty"),
        (b"# only this\n", "the file is empty"),
        (LOG_HEADER, "no rows below the header"),
        (b"1,2,3,4\n", "line 1 contains numbers"),
        (b"t,left,right\n1,2,3\n", "no column with which to compare the wheels"),
        (b"t,fr,fl,rr,yaw_rate\n1,2,3,4,5\n", "no column left, right"),
        (b"t,left,right,yawrate\n1,2,3,4\n", "if column yawrate is the missing one"),
        (
            b"timestamp,left,right,yaw_rate\n1,2,3,4\n",
            "if column timestamp is the time, rename it to t",
        ),
        (b"t left right yaw_rate\n1 2 3 4\n", "no commas between"),
        (b"t,left,right,left,x,y\n1,2,3,4,5,6\n", "left exists twice"),
        (LOG_HEADER + b"1,2,three,4\n", 'line 2, column right: "three" is not a number'),
        (LOG_HEADER + b"1,2,3,4,5\n", "line 2 has 5 cells, but the header has 4"),
        (b"SQLite format 3\0\0\0", "not text"),
    ],
)
def test_a_refusal_names_the_place_the_error_and_the_remedy(data: bytes, words: str) -> None:
    with pytest.raises(LogError, match=r".") as refused:
        read(data)
    assert words in str(refused.value)


def test_a_unit_that_is_not_known_is_reported() -> None:
    notes = read(LOG_HEADER.replace(b"left", b"left (m/s)") + b"1,2,3,4\n").notes
    assert "column left has the unknown unit (m/s)" in notes[0]


@given(st.binary(max_size=300), st.integers(0, 100))
def test_garbage_bytes_anywhere_are_refused_or_left_out(garbage: bytes, at: int) -> None:
    good = LOG_HEADER + b"1,2,3,4\n" * 10
    try:
        table = read(good[:at] + garbage + good[at:])
    except LogError:
        return
    assert set(table.columns) >= {"t"}
    assert len(table.runs) == len(table.columns["t"])


@each(
    ("cell", "name", "unit"),
    [
        ("t", "t", ""),
        (" T [ms] ", "t", "ms"),
        ("Yaw Rate (deg / s)", "yaw_rate", "deg/s"),
        ("yaw-rate", "yaw_rate", ""),
        ("left(rpm", "left", "rpm"),
        ("", "", ""),
    ],
)
def test_a_unit_in_brackets_is_separated_from_the_column_name(
    cell: str, name: str, unit: str
) -> None:
    assert parted(cell) == (name, unit)


@each(
    ("name", "unit", "times"),
    [
        ("t", "", 1.0),
        ("t", "ns", 1e-9),
        ("x", "cm", 0.01),
        ("yaw", "deg", math.pi / 180),
        ("yaw_rate", "degrees/sec", math.pi / 180),
        ("left", "rpm", math.tau / 60),
        ("left", "rad/s", 1.0),
        ("left", "m/s", None),
        ("t", "rad", None),
    ],
)
def test_each_unit_has_its_conversion_factor(name: str, unit: str, times: float | None) -> None:
    assert factor(name, unit) == (None if times is None else pytest.approx(times))


def table(count: int = 200) -> dict[str, Floats]:
    turned = np.arange(count) % 10.0
    return {
        "t": np.arange(count) / 10,
        "left": turned.copy(),
        "right": turned.copy(),
        "yaw_rate": np.full(count, 0.1),
    }


def test_a_spike_counts_as_missing_and_a_fast_drive_does_not() -> None:
    columns = table()
    columns["left"][70], columns["yaw_rate"][70] = 900.0, -40.0
    notes = list(bounded(columns))
    assert np.flatnonzero(np.isnan(columns["left"])).tolist() == [70]
    assert np.flatnonzero(np.isnan(columns["yaw_rate"])).tolist() == [70]
    assert not np.isnan(columns["right"]).any()
    assert notes == [
        "1 cell of left left out: no robot has a value like 900",
        "1 cell of yaw_rate left out: no robot has a value like -40",
    ]


def test_a_spike_is_found_between_rows_of_other_sensors() -> None:
    columns = table()
    columns["yaw_rate"][1::2] = np.nan
    columns["yaw_rate"][100] = 40.0
    assert list(bounded(columns)) == ["1 cell of yaw_rate left out: no robot has a value like 40"]


def mostly_standing(rng: np.random.Generator) -> dict[str, Floats]:
    """Return half an hour at 100 Hz in which the robot turns for 20 s."""
    t = np.arange(180_000) / 100
    rate = np.where((t > 900) & (t < 920), 1.0, 0.0) + 0.03 + rng.normal(0, 0.003, len(t))
    wheels = np.where((t > 900) & (t < 920), 4.8, 0.0)
    return {"t": t, "left": -wheels, "right": wheels, "yaw_rate": rate}


@pytest.mark.parametrize("order", ["as recorded", "shuffled", "beside another drive"])
def test_turns_of_a_robot_that_mostly_stands_still_are_not_spikes(order: str) -> None:
    rng = np.random.default_rng(1)
    columns = mostly_standing(rng)
    if order == "shuffled":
        mixed = rng.permutation(len(columns["t"]))
        columns = {name: values[mixed] for name, values in columns.items()}
    elif order == "beside another drive":
        other = columns | {"yaw_rate": rng.normal(0.03, 0.003, len(columns["t"]))}
        columns = {name: np.concatenate([columns[name], other[name]]) for name in columns}
    assert list(bounded(columns)) == []


def test_impossible_values_count_as_missing_however_many_follow_each_other() -> None:
    columns = table()
    columns["left"][50:60], columns["t"][3] = np.inf, 1e21
    assert len(list(bounded(columns))) == 2
    assert np.isnan(columns["left"][50:60]).all()


STAMP = Header(Time(1_700_000_000, 5_250_000))
WHEELS = JointState(STAMP, velocity=[1.25, -2.5, -2.0, 1.0])
GYRO = Imu(
    Header(), Quaternion(), [0.0] * 9, Vector3(z=-0.125), [0.0] * 9, Vector3(), [0.0] * 9
)  # fmt: skip
PLACE = PoseStamped(
    STAMP, Pose(Vector3(1.5, -2.25), Quaternion(z=math.sin(0.5), w=math.cos(0.5)))
)  # fmt: skip


def test_each_message_is_a_row_with_its_own_time() -> None:
    arrived_ns = 1_700_000_001_500_000_000
    rows = [row(message, arrived_ns) for message in (WHEELS, GYRO, PLACE)]
    table = read("\n".join([HEADER, *rows]).encode())
    nan = math.nan
    expected = {
        "t": [1_700_000_000.00525, 1_700_000_001.5, 1_700_000_000.00525],
        "fr": [1.25, nan, nan], "fl": [-2.5, nan, nan],
        "rl": [-2.0, nan, nan], "rr": [1.0, nan, nan],
        "yaw_rate": [nan, -0.125, nan],
        "x": [nan, nan, 1.5], "y": [nan, nan, -2.25], "yaw": [nan, nan, 1.0],
    }  # fmt: skip
    for name, values in expected.items():
        assert table.columns[name] == pytest.approx(np.array(values), abs=1e-5, nan_ok=True)


def test_every_key_of_a_log_is_a_key_of_the_daemon() -> None:
    assert all(by_key(key) is not None for key in KEYS)


@pytest.mark.parametrize("message", [JointState(), ServiceReply(True, "")])
def test_a_message_without_wheels_or_turns_is_not_a_row(message: Message) -> None:
    with pytest.raises(ValueError, match="cannot be in a log"):
        row(message, 0)


def test_a_table_made_directly_equals_that_of_the_written_log() -> None:
    """The other tests use `cut.table`, which makes the table without writing a log."""
    drive = cut.usual()
    for gyro, places in ((False, True), (True, False), (True, True)):
        direct = cut.table(drive, gyro=gyro, places=places)
        written = read(drive.csv(gyro=gyro, places=places).encode())
        assert list(direct.columns) == list(written.columns)
        for name, values in direct.columns.items():
            assert np.allclose(values, written.columns[name], rtol=0, atol=1e-12, equal_nan=True)


def test_a_column_of_counts_is_not_proposed_as_speeds() -> None:
    with pytest.raises(LogError, match="ticks_left has counts, not speeds") as refused:
        read(b"t,ticks_left,ticks_right,yaw_rate\n0,1,1,0\n")
    assert "rename" not in str(refused.value)
