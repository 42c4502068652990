"""Tests of the messages that a replayed robot publishes.

`scenarios/test_export.py` proves that they equal the original messages.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.ros.shapes import Log
from acsard.core.values import NS_PER_S
from acsard.recording.file import FrameWriter, Head, Recording, Waits
from acsard.recording.published import MEASURED_ROWS, Published, published
from acsard.recording.timeline import Timeline
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World


def published_messages(tape: Tape, config: Config) -> list[Published]:
    with tempfile.TemporaryDirectory() as place:
        return list(published(Recording([tape.save(Path(place) / "a.rec.zst")]), config))


def names(published: list[Published]) -> set[str]:
    return {message.channel.name for message in published}


def driven() -> Tape:
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.4, 1.0)
    return tape


def test_a_transform_that_is_switched_off_is_not_published() -> None:
    tape, config = driven(), Config()
    quiet = replace(
        config,
        odometry=replace(config.odometry, publish_tf=False),
        lidar=replace(config.lidar, publish_tf=False),
    )
    assert names(published_messages(tape, config)) - names(published_messages(tape, quiet)) == {
        "tf",
        "tf_static",
    }


def test_other_parameters_change_the_pose_but_not_the_received_commands() -> None:
    tape, config = driven(), Config()
    wider = replace(config, drive=replace(config.drive, wheel_separation=0.6))
    then, now = published_messages(tape, config), published_messages(tape, wider)
    (last, other) = (
        [m for m in messages if m.channel.name == "odom"][-1] for messages in (then, now)
    )
    turned, less = (m.message.pose.pose.orientation.z for m in (last, other))
    assert 0.3 < less / turned < 0.7
    commands = [
        [m for m in messages if m.channel.name.startswith("cmd_vel_in")] for messages in (then, now)
    ]
    assert commands[0] == commands[1] != []


def test_odometry_is_published_after_its_sample_and_a_command_at_its_arrival() -> None:
    published = published_messages(driven(), Config())
    odom = [m for m in published if m.channel.name == "odom"]
    assert all(m.message.header.stamp.to_ns() <= m.wall_ns for m in odom)
    times = [m.wall_ns for m in odom]
    assert times == sorted(times)
    commands = [m for m in published if m.source == "app"]
    assert all(m.message.header.stamp.to_ns() == m.wall_ns for m in commands)


def test_values_that_a_recording_lacks_are_not_published() -> None:
    published = published_messages(driven(), Config())
    rows = {
        row.name for m in published if m.channel.name == "diagnostics" for row in m.message.status
    }
    assert rows
    assert not rows & MEASURED_ROWS
    states = [m.message for m in published if m.channel.name == "state"]
    assert all(state.latencies == {} and state.certificate_expiry == "" for state in states)


def logs(messages: list[Published]) -> list[Log]:
    return [m.message for m in messages if isinstance(m.message, Log)]


def test_the_log_has_the_same_lines_as_the_timeline(tmp_path: Path) -> None:
    recording, timeline = Recording([driven().save(tmp_path / "a.rec.zst")]), Timeline()
    entries = [entry for record in recording.records() for entry in timeline.take(record)]
    lines = logs(list(published(recording)))
    assert [line.name for line in lines] == [entry.name for entry in entries]
    assert [line.msg for line in lines] == [entry.sentence for entry in entries]
    assert [line.stamp.to_ns() for line in lines] == [entry.wall_ns for entry in entries]
    assert "start" in [line.name for line in lines]


def test_two_runs_of_the_daemon_are_published_one_after_the_other(tmp_path: Path) -> None:
    path = driven().save(tmp_path / "a.rec.zst")
    once, twice = (list(published(Recording([path] * n))) for n in (1, 2))
    # A restarted robot begins at the origin of `odom` again.
    odom, both = ([m for m in run if m.channel.name == "odom"] for run in (once, twice))
    assert both == odom * 2
    assert [line.name for line in logs(twice)].count("start") == 2


def test_what_sources_waited_for_before_a_part_is_not_in_its_log(tmp_path: Path) -> None:
    tape, path = driven(), tmp_path / "a.rec.zst"
    steps = tape.taken
    start, middle = steps[0].now, steps[len(steps) // 2].now
    with path.open("wb") as file:
        frames = FrameWriter(file)
        text = "\n".join(document(effective(Config()))) + "\n"
        frames.begin(Head("0.2.0", "acsar", 0, start.mono_ns, start.wall_ns, text))
        frames.add(Waits(start, {"nav": ("higher", "early")}))
        frames.add(Waits(middle, {"nav": ("equal", "late")}))
    part = published(Recording([path], START.wall_ns + 1))
    assert [line.msg for line in logs(list(part))] == ["late (by nav)"]


def test_a_part_has_the_messages_of_its_time_and_says_what_it_continues(tmp_path: Path) -> None:
    path, begin_ns = driven().save(tmp_path / "a.rec.zst"), START.wall_ns + NS_PER_S // 2
    part = list(published(Recording([path], begin_ns)))
    whole = list(published(Recording([path])))
    first, *rest = logs(part)
    assert (first.name, first.msg) == (
        "continues",
        "the robot is driving (commanded by app), link up (by app)",
    )
    assert min(m.wall_ns for m in part) >= begin_ns - 10_000_000
    steady = {"odom", "cmd_vel_out", "state", "joint_states"}
    inside = [m for m in whole if m.wall_ns >= begin_ns and m.channel.name in steady]
    assert [m for m in part if m.channel.name in steady] == inside
    assert rest == [line for line in logs(whole) if line.stamp.to_ns() >= begin_ns]
