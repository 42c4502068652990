"""Tests of the table of a log: columns, spikes, and rows of recorded messages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.log_rows import HEADER, KEYS, row
from acsard.calibration.log_table import Floats, LogError, bounded, read
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


def test_columns_may_be_in_any_order_and_cells_may_be_empty() -> None:
    table = read(b"yaw_rate,t,right,left\n0.5,1.0,,\n\n,2,3,4\n")
    assert table.columns["t"].tolist() == [1.0, 2.0]
    assert table.columns["left"][1] == 4.0
    assert np.isnan(table.columns["right"][0])
    assert np.isnan(table.columns["yaw_rate"][1])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_the_ends_of_lines_and_a_byte_order_mark_do_not_matter(end: str, mark: bytes) -> None:
    text = end.join(["t,left,right,yaw_rate", "1,2,3,4", ""])
    assert read(mark + text.encode()).columns["yaw_rate"].tolist() == [4.0]


def test_runs_are_distinguished_by_any_name() -> None:
    table = read(b"run,t,left,right,yaw_rate\ncw 1,1,2,3,4\n#2,1,2,3,4\ncw 1,2,2,3,4\n")
    assert table.names == ("cw 1", "#2")
    assert table.runs.tolist() == [0, 1, 0]


def test_a_value_that_is_not_a_measurement_counts_as_missing_and_is_reported() -> None:
    table = read(LOG_HEADER + b"1,1e300,inf,nan\n2,1,1,1\n")
    assert np.isnan(table.columns["left"][0])
    assert np.isnan(table.columns["right"][0])
    assert len(table.notes) == 2


def test_columns_that_are_not_used_are_reported() -> None:
    assert read(b"t,left,right,yaw_rate,volts\n1,2,3,4,5\n").notes == ("columns not used: volts",)


@each(
    ("data", "words"),
    [
        (b"", "does not name t, left, right, yaw_rate"),
        (b"1,2,3,4\n", "does not name t, left"),
        (b"t;left;right;yaw_rate\n1;2;3;4\n", "does not name t, left"),
        (b"t [s],left,right,yaw_rate\n1,2,3,4\n", "does not name t:"),
        (b"T,left,right,yaw_rate\n1,2,3,4\n", "does not name t:"),
        (b"t,fr,fl,rr,yaw_rate\n1,2,3,4,5\n", "does not name left, right"),
        (b"t,left,right,x\n1,2,3,4\n", "does not name yaw_rate (of a gyro) or x and y"),
        (b"t,left,right,left,x,y\n1,2,3,4,5,6\n", "names a column twice"),
        (LOG_HEADER + b"1,2,3,4\n1,2,three,4\n", 'line 3 is "1,2,three,4"'),
        (LOG_HEADER + b"1,2,3,4,5\n", 'line 2 is "1,2,3,4,5"'),
        (LOG_HEADER + b"1,2,3\n", 'line 2 is "1,2,3"'),
        (LOG_HEADER + b"# slow\n", 'line 2 is "# slow"'),
        ("t,left,right,yaw_rate\n".encode("utf-16"), "the file is not text"),
    ],
)
def test_another_format_is_refused_with_the_header_to_write(data: bytes, words: str) -> None:
    with pytest.raises(LogError, match=r".") as refused:
        read(data)
    assert words in str(refused.value)
    assert 'like "t,left,right,yaw_rate" or "t,fr,fl,rl,rr,x,y"' in str(refused.value)


def test_a_file_without_rows_is_refused() -> None:
    with pytest.raises(LogError, match="no rows below the header"):
        read(LOG_HEADER)


@given(st.binary(max_size=300), st.integers(0, 100))
def test_garbage_bytes_anywhere_are_refused_or_left_out(garbage: bytes, at: int) -> None:
    good = LOG_HEADER + b"1,2,3,4\n" * 10
    try:
        table = read(good[:at] + garbage + good[at:])
    except LogError:
        return
    assert set(table.columns) >= {"t"}
    assert len(table.runs) == len(table.columns["t"])


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
