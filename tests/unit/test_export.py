"""Third-party programs can read exported files.

The tests also cover an export to the path of an existing file.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from msgspec.structs import replace
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from acsard.calibration.log import read
from acsard.core.config.settings import Config, WheelMap
from acsard.core.ros.channels import CHANNELS
from acsard.core.ros.names import Qos
from acsard.core.values import NS_PER_S, REST, GyroSample, Instant, Ns
from acsard.host.errors import RecordingError
from acsard.recording.export import (
    Kind,
    calibration_csv,
    export,
    feedback_cells,
    gyro_cells,
    offered_qos,
    replacing,
    table,
)
from acsard.recording.file import Recording
from tests.scenarios.taped import BATCH, Tape, recorded_world
from tests.scenarios.world import START
from tests.unit.drives import CONFIG, drive

SECONDS = (drive().taken[-1].now.mono_ns - START.mono_ns) / 1e9


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive().save(tmp_path_factory.mktemp("recorded") / "drive.rec.zst", CONFIG)


def part_of(path: Path, begin_s: float, end_s: float) -> Recording:
    """Return the recording of these seconds after the start."""

    def at(seconds: float) -> Ns:
        return START.wall_ns + round(seconds * NS_PER_S)

    return Recording([path], at(begin_s), at(end_s))


TOPICS = {
    "/odom", "/tf", "/tf_static", "/joint_states", "/cmd_vel_out", "/diagnostics", "/state", "/log",
    "/battery_state", "/cmd_vel_in/app", "/cmd_vel_in/teleop",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "robot1"])
def test_the_mcap_library_finds_the_export_finished_indexed_and_compressed(
    namespace: str, path: Path, tmp_path: Path
) -> None:
    new, before = tmp_path / "new.mcap", f"/{namespace}" if namespace else ""
    config = replace(CONFIG, ros=replace(CONFIG.ros, namespace=namespace))
    count = export(Recording([path]), new, "mcap", config)
    with new.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == count > 500
        topics = {record.topic for record in summary.channels.values()}
        assert topics == {f"{before}{topic}" for topic in TOPICS}
        assert {record.compression for record in summary.chunk_indexes} == {"zstd"}
        kinds = {record.name: record.encoding for record in summary.schemas.values()}
        assert kinds == {record.schema_name: "ros2msg" for record in CHANNELS}
        first, last = (
            (t - START.wall_ns) / 1e9
            for t in (summary.statistics.message_start_time, summary.statistics.message_end_time)
        )
        assert first == pytest.approx(0.0)
        assert last == pytest.approx(SECONDS, abs=0.1)
        odom = [record for _, _, record in reader.iter_messages(f"{before}/odom")]
    assert [record.sequence for record in odom] == [*range(1, len(odom) + 1)]


@pytest.mark.slow
def test_the_file_is_a_bag_of_ros_with_the_durability_of_each_topic(
    path: Path, tmp_path: Path
) -> None:
    export(Recording([path]), tmp_path / "new.mcap", "mcap")
    with AnyReader([tmp_path / "new.mcap"]) as reader:
        latched = {
            entry.topic: entry.ext.offered_qos_profiles[0].durability.name  # type: ignore[union-attr]
            for entry in reader.connections
        }
    assert latched.pop("/tf_static") == "TRANSIENT_LOCAL"
    assert set(latched.values()) == {"VOLATILE"}


def test_only_messages_of_the_time_span_are_written(path: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    begin_ns, end_ns = START.wall_ns + 5 * 10**8, START.wall_ns + 10**9
    export(part_of(path, 0.5, 1.0), new, "mcap")
    with new.open("rb") as stream:
        found = [(c.topic, m.log_time) for _, c, m in make_reader(stream).iter_messages()]
    times = [at_ns for topic, at_ns in found if topic == "/odom"]
    # The first message is latched: without it, viewers do not know where the lidar is.
    assert found[0][0] == "/tf_static"
    assert begin_ns <= min(times) < begin_ns + 20_000_000
    assert end_ns - 20_000_000 < max(times) <= end_ns


def test_a_time_span_without_messages_writes_no_file(path: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing was recorded in that time"):
        export(part_of(path, 1000.0, 1001.0), tmp_path / "new.mcap", "mcap")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("kind", ["mcap", "csv"])
def test_an_existing_file_is_replaced_only_with_force(
    kind: Kind, path: Path, tmp_path: Path
) -> None:
    new, short = tmp_path / "new", part_of(path, 0.0, 0.5)
    first = export(short, new, kind)
    with pytest.raises(FileExistsError, match="--force") as raised:
        export(short, new, kind)
    assert raised.value.strerror == "this path exists already; --force overwrites it"
    assert export(part_of(path, 0.0, 0.2), new, kind, force=True) < first
    assert [*tmp_path.iterdir()] == [new]


@pytest.mark.parametrize("name", ["bag", "/dev/null", "000001-a.rec.zst"])
def test_a_directory_a_device_and_a_recording_are_never_replaced(name: str, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "000001-a.rec.zst").write_bytes(b"a")
    before = {*tmp_path.iterdir()}
    with pytest.raises(FileExistsError), replacing(tmp_path / name, force=True):
        raise AssertionError
    assert {*tmp_path.iterdir()} == before


def test_only_a_file_is_ever_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "not mounted")
    (tmp_path / "directory").mkdir()
    before = {*tmp_path.iterdir()}
    for name in ("pipe", "link", "directory"):
        with pytest.raises(FileExistsError), replacing(tmp_path / name, force=True):
            raise AssertionError
    assert {*tmp_path.iterdir()} == before


@pytest.mark.parametrize("kind", ["mcap", "csv"])
def test_an_export_that_fails_leaves_nothing_and_a_replaced_file_stays(
    kind: Kind, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "old").write_text("mine")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acsard.recording.export.Playback.take", fail)
    monkeypatch.setattr("acsard.recording.export.Playback.steps", fail)
    with pytest.raises(OSError, match="No space"):
        export(Recording([path]), tmp_path / "new", kind)
    with pytest.raises(OSError, match="No space"):
        export(Recording([path]), tmp_path / "old", kind, force=True)
    assert [*tmp_path.iterdir()] == [tmp_path / "old"]
    assert (tmp_path / "old").read_text() == "mine"


GYRO = replace(Config(), odometry=replace(Config().odometry, gyro=True))
TWO = replace(GYRO, mcu=replace(GYRO.mcu, wheels=WheelMap(left="+l", right="+r")))


@pytest.fixture(scope="module", params=[GYRO, TWO], ids=["four wheels", "two wheels"])
def config(request: pytest.FixtureRequest) -> Config:
    chosen: Config = request.param
    return chosen


@pytest.fixture(scope="module")
def tape(config: Config) -> Tape:
    tape, world = recorded_world(config, every=BATCH)
    world.drive(0.5, 0.4, 3.0)
    return tape


def test_calibration_reads_the_steps_up_to_the_first_gap(
    tape: Tape, config: Config, tmp_path: Path
) -> None:
    first = tape.save(tmp_path / "first.rec.zst", config, end=BATCH)
    later = tape.save(tmp_path / "later.rec.zst", config, first=2 * BATCH)
    assert calibration_csv(Recording([first, later])) == calibration_csv(Recording([first]))
    assert calibration_csv(Recording([later])) != calibration_csv(Recording([first]))


@pytest.fixture(scope="module")
def turned(tape: Tape, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording([tape.save(tmp_path_factory.mktemp("drive") / "a.rec.zst", config)])


def test_the_table_has_a_row_for_each_feedback_line_and_each_gyro_sample(
    tape: Tape, config: Config, turned: Recording
) -> None:
    header, *rows = table(turned)
    wheels = ("fr", "fl", "rl", "rr") if config is GYRO else ("right", "left")
    assert header[: len(wheels) + 2] == ("t", *wheels, "yaw_rate")
    estimates = [e for t in tape.taken for e in t.news.estimates]
    reports = [sample for t in tape.taken for sample in t.heard.gyro]
    assert {len(row) for row in rows} == {len(header)}
    assert len(estimates) == sum(row[1] != "" for row in rows) > 100
    assert len(reports) == sum(row[header.index("yaw_rate")] != "" for row in rows) > 100
    # The robot turns left: the wheels of the right side roll faster.
    left = header.index("fl" if config is GYRO else "left")
    faster = [row for row in rows if row[1] and float(row[1]) > float(row[left]) + 0.1]
    assert len(faster) > 100
    assert ("driving", "up", "app") in {row[-3:] for row in rows}


def test_calibration_reads_the_same_from_the_table_and_from_the_recording(
    tape: Tape, turned: Recording
) -> None:
    whole = "\n".join(map(",".join, table(turned))).encode()
    runs = [read(text).runs[0] for text in (whole, calibration_csv(turned))]
    for name in ("t", "left", "right", "gyro_t", "turned", "commands_t", "commands"):
        column = getattr(runs[0], name)
        assert len(column) > 100
        np.testing.assert_array_equal(column, getattr(runs[1], name))
    lines = [e for t in tape.taken for e in t.news.estimates]
    assert len(runs[0].t) == len(lines)


def test_the_times_in_the_table_are_those_of_the_samples(tape: Tape, config: Config) -> None:
    *_, estimate = [estimate for step in tape.taken for estimate in step.news.estimates]
    wall_ns, wheels = estimate.at.wall_ns, len(config.joint_names)
    cells = feedback_cells(estimate, REST, wheels)
    assert cells[0] == f"{wall_ns // 10**9}.{wall_ns % 10**9 // 1000:06}"
    now = Instant(START.mono_ns + 50, START.wall_ns + 50)
    arrived = GyroSample(START.mono_ns + 2_000_050, None, 0.25)
    at_arrival = "1800000000.002000", *[""] * wheels, "0.25"
    assert gyro_cells(arrived, now, wheels)[: wheels + 2] == at_arrival
    assert gyro_cells(replace(arrived, stamp_ns=1_500_000), now, wheels)[0] == "0.001500"


def loaded(text: str) -> Any:
    return YAML(typ="safe").load(io.StringIO(text))


@pytest.mark.parametrize(
    ("qos", "depth", "reliability", "durability"),
    [
        (Qos(), 10, 1, 2),
        (Qos(1, transient=True), 1, 1, 1),
        (Qos(5, best_effort=True), 5, 2, 2),
    ],
)
def test_qos_policies_are_written_as_the_numbers_of_rmw(
    qos: Qos, depth: int, reliability: int, durability: int
) -> None:
    (profile,) = loaded(offered_qos(qos))
    assert (profile["history"], profile["depth"]) == (1, depth)
    assert (profile["reliability"], profile["durability"]) == (reliability, durability)
    assert profile["avoid_ros_namespace_conventions"] is False
