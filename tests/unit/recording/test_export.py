"""Third-party programs can read exported files.

The tests also cover an export to the path of an existing file.
"""

from __future__ import annotations

import io
import os
import random
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from acsard.calibration.log_table import read
from acsard.core.config.settings import Config, SimConfig
from acsard.core.robot import Robot
from acsard.core.ros.channels import CHANNELS
from acsard.core.ros.names import Qos
from acsard.core.values import GyroSample, Instant
from acsard.host.errors import RecordingError
from acsard.recording import atomic_output
from acsard.recording.atomic_output import replacing
from acsard.recording.export import (
    CSV_HEADER,
    MEASURED_CSV_HEADER,
    BagTopic,
    Kind,
    bag_metadata,
    calibration_csv,
    csv_rows,
    export,
    gyro_columns,
    measured_csv_rows,
    offered_qos,
    wheel_columns,
)
from acsard.recording.mcap_file import Recording, RecordingWriter, Topic
from acsard.recording.stepped_robot import SteppedRobot
from acsard.recording.time_span import Span
from tests.scenarios.taped import BATCH, Tape, chunks, recorded_world
from tests.scenarios.world import START

SECONDS = 2.0

CONFIG = Config(sim=SimConfig(faults=("battery=90:60",)))
"""A robot whose board reports its battery, so that each topic has messages."""

KINDS: tuple[Kind, ...] = ("mcap", "csv", "rosbag2")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a drive with two sources."""
    tape, world = recorded_world(CONFIG)
    world.drive(0.5, 0.3, 0.4)
    world.drive(0.3, 0.0, 0.3, source="teleop")
    world.call("stop")
    world.run(SECONDS - (world.now_ns - START.mono_ns) / 1e9)
    path = tmp_path_factory.mktemp("recorded") / "drive.mcap"
    tape.write(path, CONFIG)
    return path


TOPICS = {
    "/odom", "/tf", "/tf_static", "/joint_states", "/cmd_vel_out", "/diagnostics", "/state", "/log",
    "/battery_state", "/cmd_vel_in/app", "/cmd_vel_in/teleop",
}  # fmt: skip


@pytest.mark.slow
def test_the_mcap_library_finds_the_export_finished_indexed_and_compressed(
    path: Path, tmp_path: Path
) -> None:
    new = tmp_path / "new.mcap"
    done = export(Recording(path), new, "mcap")
    with new.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == done.count > 500
        assert {record.topic for record in summary.channels.values()} == TOPICS
        assert {record.compression for record in summary.chunk_indexes} == {"zstd"}
        kinds = {record.name: record.encoding for record in summary.schemas.values()}
        assert kinds == {record.schema_name: "ros2msg" for record in CHANNELS}
        first, last = (
            (t - START.wall_ns) / 1e9
            for t in (summary.statistics.message_start_time, summary.statistics.message_end_time)
        )
        assert first == pytest.approx(0.0)
        assert last == pytest.approx(SECONDS, abs=0.1)
        odom = [record for _, _, record in reader.iter_messages("/odom")]
    assert [record.sequence for record in odom] == [*range(1, len(odom) + 1)]
    assert done.gaps == []


def counted(reader: Any) -> Counter[str]:
    """Decode all messages of a file, and return their number for each topic."""
    counts: Counter[str] = Counter()
    with reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            assert message.__msgtype__ == connection.msgtype
            counts[connection.topic] += 1
    return counts


@pytest.mark.slow
def test_rosbags_reads_every_message_with_the_definitions_in_the_file(
    path: Path, tmp_path: Path
) -> None:
    recording = Recording(path)
    result = export(recording, tmp_path / "one.mcap", "mcap")
    other = export(recording, tmp_path / "bag", "rosbag2")
    alone, bag = (
        counted(AnyReader([tmp_path / name], default_typestore=get_typestore(Stores.EMPTY)))
        for name in ("one.mcap", "bag")
    )
    assert alone == bag
    assert set(bag) == TOPICS
    assert bag.total() == result.count == other.count


@pytest.mark.slow
def test_a_bag_is_a_directory_whose_metadata_match_its_file(path: Path, tmp_path: Path) -> None:
    export(Recording(path), tmp_path / "bag", "rosbag2")
    assert {entry.name for entry in (tmp_path / "bag").iterdir()} == {"bag_0.mcap", "metadata.yaml"}
    with Reader(tmp_path / "bag") as reader:
        times = [time for _, time, _ in reader.messages()]
        assert reader.message_count == len(times)
        assert (reader.start_time, reader.end_time - 1) == (min(times), max(times))
        latched = {
            entry.topic: entry.ext.offered_qos_profiles[0].durability.name  # type: ignore[union-attr]
            for entry in reader.connections
        }
    assert latched.pop("/tf_static") == "TRANSIENT_LOCAL"
    assert set(latched.values()) == {"VOLATILE"}


def test_every_topic_begins_with_the_namespace(path: Path, tmp_path: Path) -> None:
    config = replace(Config(), ros=replace(Config().ros, namespace="robot1"))
    export(Recording(path), tmp_path / "new.mcap", "mcap", config)
    with (tmp_path / "new.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {entry.topic for entry in summary.channels.values()} == {
        f"/robot1{entry}" for entry in TOPICS
    }


def test_only_messages_of_the_time_span_are_written(path: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    begin_ns, end_ns = START.wall_ns + 5 * 10**8, START.wall_ns + 10**9
    export(Recording(path), new, "mcap", span=Span(0.5, 1.0))
    with new.open("rb") as stream:
        times = [
            m.log_time for _, c, m in make_reader(stream).iter_messages() if c.topic == "/odom"
        ]
    assert begin_ns <= min(times) < begin_ns + 20_000_000
    assert end_ns - 20_000_000 < max(times) <= end_ns


def test_a_time_span_without_messages_writes_no_file(path: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing in that span of time"):
        export(Recording(path), tmp_path / "new.mcap", "mcap", span=Span(1000.0))
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_file_is_replaced_only_with_force(
    kind: Kind, path: Path, tmp_path: Path
) -> None:
    new, recording = tmp_path / "new", Recording(path)
    first = export(recording, new, kind)
    with pytest.raises(FileExistsError):
        export(recording, new, kind)
    half = Span(end=1.0)
    again = export(recording, new, kind, span=half, force=True)
    assert again.count < first.count
    assert [*tmp_path.iterdir()] == [new]


def test_a_directory_that_is_not_a_bag_is_never_replaced(path: Path, tmp_path: Path) -> None:
    new = tmp_path / "thesis"
    new.mkdir()
    (new / "chapter").write_text("1")
    for kind in ("mcap", "rosbag2"):
        with pytest.raises(FileExistsError, match="not a ROS bag"):
            export(Recording(path), new, kind, force=True)
    assert (new / "chapter").read_text() == "1"
    assert [*tmp_path.iterdir()] == [new]


@pytest.mark.slow
def test_a_bag_with_other_files_in_it_is_never_replaced(path: Path, tmp_path: Path) -> None:
    for name in ("notes.txt", "photos", "kept.mcap"):
        new = tmp_path / f"bag {name}"
        export(Recording(path), new, "rosbag2")
        match name:
            case "photos":
                (new / name).mkdir()
            case "kept.mcap":
                (new / name).write_bytes(path.read_bytes())
            case _:
                (new / name).write_text("1")
        before = sorted(new.iterdir())
        for kind in KINDS:
            with pytest.raises(FileExistsError, match=name):
                export(Recording(path), new, kind, force=True)
        assert sorted(new.iterdir()) == before


@pytest.mark.slow
def test_a_link_to_a_bag_is_replaced_and_the_bag_stays(path: Path, tmp_path: Path) -> None:
    bag, link = tmp_path / "bag", tmp_path / "link"
    export(Recording(path), bag, "rosbag2")
    link.symlink_to(bag)
    export(Recording(path), link, "rosbag2", force=True)
    assert not link.is_symlink()
    assert {entry.name for entry in bag.iterdir()} == {"bag_0.mcap", "metadata.yaml"}
    assert {entry.name for entry in tmp_path.iterdir()} == {"bag", "link"}


def test_a_bag_stays_until_the_new_one_can_take_its_place(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "bag_0.db3"):
        (bag / name).write_text("1")
    with pytest.raises(FileNotFoundError), replacing(bag, force=True):
        pass  # the block writes no file that could replace it
    assert {entry.name for entry in bag.iterdir()} == {"metadata.yaml", "bag_0.db3"}
    assert [*tmp_path.iterdir()] == [bag]


def test_a_device_or_a_pipe_is_never_replaced(path: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for kind in KINDS:
        with pytest.raises(FileExistsError, match="this path is a device or a pipe"):
            export(Recording(path), pipe, kind, force=True)
    assert pipe.is_fifo()


def test_a_large_file_of_another_program_is_not_read(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other.mcap"
    with other.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "libmcap")
        writer.finish()

    def reads(path: Path) -> Recording:
        raise AssertionError(f"{path} is read")

    recording = Recording(path)
    monkeypatch.setattr(atomic_output, "Recording", reads)
    with pytest.raises(FileExistsError, match="--force overwrites it"):
        export(recording, other, "mcap")


def test_a_defect_of_the_export_is_not_reported_as_a_state_that_cannot_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape, world = recorded_world(CONFIG, every=BATCH)
    world.run(2 * BATCH / 100)
    tape.write(recorded := tmp_path / "drive.mcap", CONFIG, first=BATCH)

    def fails(*_: object, **__: object) -> None:
        raise TypeError("defect")

    monkeypatch.setattr(Writer, "add_message", fails)
    with pytest.raises(TypeError, match="defect"):
        export(Recording(recorded), tmp_path / "new.mcap", "mcap")


def test_a_recording_is_never_replaced(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    before = path.read_bytes()
    other.write_bytes(before)
    for recording in (other, path):
        with pytest.raises(FileExistsError, match="this file is a recording"):
            export(Recording(recording), other, "mcap", force=True)
    assert other.read_bytes() == before


@contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_the_umask_decides_which_users_may_read_an_export(
    mask: int, path: Path, tmp_path: Path
) -> None:
    begin = Span(end=0.1)
    with umask(mask):
        export(Recording(path), tmp_path / "a.csv", "csv", span=begin)
        export(Recording(path), tmp_path / "bag", "rosbag2", span=begin)
    modes = {stat.S_IMODE(p.stat().st_mode) for p in tmp_path.rglob("*") if p.is_file()}
    assert modes == {0o666 & ~mask}
    assert stat.S_IMODE((tmp_path / "bag").stat().st_mode) == 0o777 & ~mask


@pytest.mark.slow
def test_the_readable_part_of_a_cut_recording_is_exported(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    begin, end = chunks(path.read_bytes())[-1]
    cut.write_bytes(path.read_bytes()[: (begin + end) // 2])
    recording = Recording(cut)
    done = export(recording, tmp_path / "new.mcap", "mcap")
    assert not recording.is_intact
    with (tmp_path / "new.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == done.count > 100


def test_an_export_without_a_later_state_ends_at_missing_steps_and_reports_them(
    path: Path, tmp_path: Path
) -> None:
    data = bytearray(path.read_bytes())
    begin, end = chunks(data)[-2]
    data[(begin + end) // 2] ^= 0xFF
    holed = tmp_path / "holed.mcap"
    holed.write_bytes(data)
    done = export(Recording(holed), tmp_path / "new.csv", "csv")
    (gap,) = done.gaps
    assert gap.unreadable > 100
    assert 50 < done.count < export(Recording(path), tmp_path / "whole.csv", "csv").count


@pytest.mark.parametrize("seed", range(3))
def test_an_export_of_a_damaged_file_writes_messages_or_says_why_not(
    seed: int, path: Path, tmp_path: Path
) -> None:
    dice = random.Random(seed)
    data = bytearray(path.read_bytes())
    data = data[: dice.randrange(len(data) // 2, len(data))]
    for _ in range(dice.randrange(3)):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
    harmed = tmp_path / "harmed.mcap"
    harmed.write_bytes(data)
    why = done = None
    try:
        recording = Recording(harmed)
        done = export(recording, tmp_path / "new.csv", "csv")
    except RecordingError as error:
        why = str(error)
    if done is None:
        assert str(harmed) in str(why)
        assert [*tmp_path.iterdir()] == [harmed]
    else:
        assert done.count > 0
        assert done.gaps or not recording.is_intact


def test_an_export_reports_its_progress(path: Path, tmp_path: Path) -> None:
    times: list[int] = []
    export(Recording(path), tmp_path / "new.csv", "csv", progress=times.append)
    assert times[0] >= START.wall_ns
    assert times == sorted(times)


def test_calibration_refuses_a_recording_without_a_gyro(path: Path) -> None:
    with pytest.raises(RecordingError, match="no gyro"):
        calibration_csv(Recording(path))


GYRO = replace(Config(), odometry=replace(Config().odometry, gyro=True))


@pytest.fixture(scope="module")
def tape() -> Tape:
    tape, world = recorded_world(GYRO)
    world.drive(0.5, 0.4, 1.0)
    return tape


def test_calibration_reads_the_steps_between_a_missing_beginning_and_the_next_gap(
    tmp_path: Path,
) -> None:
    tape, world = recorded_world(GYRO, every=BATCH)
    world.drive(0.5, 0.4, 4.0)
    tape.write(tmp_path / "whole.mcap", GYRO)
    tape.write(tmp_path / "later.mcap", GYRO, first=BATCH)
    whole, later = Recording(tmp_path / "whole.mcap"), Recording(tmp_path / "later.mcap")
    messages = [*later.messages()]
    batches = [number for number, (topic, _, _) in enumerate(messages) if topic == "steps"]
    assert len(batches) >= 3
    del messages[batches[1]]
    # `whole.about` says that the recording began before its first readable step.
    writing = RecordingWriter(tmp_path / "harmed.mcap", whole.about)
    for topic, wall_ns, data in messages:
        writing.add(topic, wall_ns, data)
    writing.finish()
    rows = [
        row
        for step in tape.steps()
        for row in measured_csv_rows(step, tape.taken[step.number].outputs)
        if BATCH <= step.number < 2 * BATCH
    ]
    table = calibration_csv(Recording(tmp_path / "harmed.mcap"))
    assert table.decode().splitlines() == [MEASURED_CSV_HEADER, *rows]


def test_an_export_does_not_compare_the_end_record_with_the_events(
    path: Path, tmp_path: Path
) -> None:
    """The comparison would read the whole recording again, and only a replay uses its result."""

    class Counted(Recording):
        reads = 0

        def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
            self.reads += 1
            return super().messages()

    recording = Counted(path)
    export(recording, tmp_path / "new.csv", "csv")
    # The first reading ends at the first message, which shows whether the recording has a state.
    assert recording.reads == 2


def test_the_table_has_a_row_for_each_feedback_line_and_each_gyro_sample(tape: Tape) -> None:
    robot = SteppedRobot(Robot(GYRO))
    lines: list[str] = []
    for step in tape.steps():
        lines += csv_rows(step, robot.step(step.inputs))
    estimates = [e for t in tape.taken for e in t.outputs.estimates]
    reports = [sample for t in tape.taken for sample in t.inputs.gyro]
    cells = [line.split(",") for line in lines]
    assert {len(row) for row in cells} == {len(CSV_HEADER.split(","))}
    assert len(estimates) == sum(row[1] != "" for row in cells) > 100
    assert len(reports) == sum(row[5] != "" for row in cells) > 100
    assert ["driving", "up", "app"] in [row[-3:] for row in cells]


def test_calibration_reads_the_same_from_the_whole_table_and_from_the_measured_columns(
    tape: Tape,
) -> None:
    robot, twin = SteppedRobot(Robot(GYRO)), SteppedRobot(Robot(GYRO))
    whole, part = [CSV_HEADER], [MEASURED_CSV_HEADER]
    for step in tape.steps():
        whole += csv_rows(step, robot.step(step.inputs))
        part += measured_csv_rows(step, twin.step(step.inputs))
    tables = [read("\n".join(lines).encode()) for lines in (whole, part)]
    commands = ["applied_linear", "applied_angular"]
    assert list(tables[0].columns) == ["t", "fr", "fl", "rl", "rr", "yaw_rate", *commands]
    for name, values in tables[0].columns.items():
        np.testing.assert_array_equal(values, tables[1].columns[name])
    speeds = [e.speeds.front_right for t in tape.taken for e in t.outputs.estimates]
    fr = tables[0].columns["fr"]
    np.testing.assert_allclose(fr[~np.isnan(fr)], speeds, rtol=1e-5)


def test_the_times_in_the_table_are_those_of_the_samples(tape: Tape) -> None:
    estimate = tape.taken[-1].outputs.estimates or tape.taken[-2].outputs.estimates
    wall_ns = estimate[0].at.wall_ns
    assert wheel_columns(estimate[0]).startswith(f"{wall_ns // 10**9}.{wall_ns % 10**9 // 1000:06}")
    now = Instant(START.mono_ns + 50, START.wall_ns + 50)
    arrived = GyroSample(START.mono_ns + 2_000_050, None, 0.25)
    assert gyro_columns(arrived, now) == "1800000000.002000,,,,,0.25"
    assert gyro_columns(replace(arrived, stamp_ns=1_500_000), now) == "0.001500,,,,,0.25"


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


def test_topics_are_written_whatever_their_names() -> None:
    topics = [
        BagTopic("/odom", "nav_msgs/msg/Odometry", Qos(), 7),
        BagTopic("/cmd_vel_in/off", "geometry_msgs/msg/TwistStamped", Qos(), 2),
    ]
    metadata = loaded(bag_metadata("yes: no #.mcap", topics, 5, 25))["rosbag2_bagfile_information"]
    assert metadata["relative_file_paths"] == ["yes: no #.mcap"]
    assert metadata["message_count"] == 9
    assert metadata["starting_time"] == {"nanoseconds_since_epoch": 5}
    assert metadata["duration"] == {"nanoseconds": 20}
    assert metadata["files"][0] == {
        "path": "yes: no #.mcap",
        "starting_time": {"nanoseconds_since_epoch": 5},
        "duration": {"nanoseconds": 20},
        "message_count": 9,
    }
    names = [topic["topic_metadata"]["name"] for topic in metadata["topics_with_message_count"]]
    assert names == ["/odom", "/cmd_vel_in/off"]
    first = metadata["topics_with_message_count"][0]
    assert loaded(first["topic_metadata"]["offered_qos_profiles"]) == loaded(offered_qos(Qos()))
