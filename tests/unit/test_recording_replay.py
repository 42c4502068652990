"""Tests of the replay of a recording: after a gap it goes on at the next head."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.host.errors import RecordingError
from acsard.recording.file import MAGIC, Failure, FrameWriter, Head, Recording
from acsard.recording.recorded_steps import checksum
from acsard.recording.replay import Playback
from acsard.recording.replay_text import describe_difference
from tests.scenarios.world import START
from tests.unit.drives import CONFIG, drive

TAPE = drive()


def played(*paths: Path, other: Config | None = None) -> tuple[list[int], Playback, Recording]:
    recording = Recording(paths)
    playback = Playback(recording, other)
    return [step.number for step, _ in playback.steps()], playback, recording


def test_a_replay_goes_on_after_damage_at_the_next_state(tmp_path: Path) -> None:
    path = TAPE.save(tmp_path / "a")
    data = bytearray(path.read_bytes())
    second = data.index(MAGIC, 1)
    data[second + 100 : second + 116] = b"sixteen bad byte"
    path.write_bytes(data)
    numbers, playback, recording = played(path)
    assert numbers == [n for n in range(len(TAPE.taken)) if not 200 <= n < 400]
    assert playback.comparison.same
    (gap,) = playback.gaps
    assert gap.steps == 200
    assert gap.begin == TAPE.taken[199].now
    assert gap.end == TAPE.taken[400].now
    assert len(recording.damage) == 1


def test_steps_outside_the_time_are_told_apart(tmp_path: Path) -> None:
    path = TAPE.save(tmp_path / "a")
    times = TAPE.taken[450].now.wall_ns, TAPE.taken[460].now.wall_ns
    recording = Recording([path], *times)
    playback = Playback(recording)
    numbers = [s.number for s, _ in playback.steps() if recording.contains(s.now)]
    assert numbers == [n for n, s in enumerate(TAPE.taken) if times[0] <= s.now.wall_ns <= times[1]]
    assert playback.comparison.steps == 200
    assert playback.comparison.same


def test_a_state_that_this_version_cannot_use_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        FrameWriter(file).begin(Head("9.9.9", "acsar", 5, 0, 0, "", b"no state"))
    with pytest.raises(RecordingError, match=r"cannot replay a, which acsard 9\.9\.9 wrote: "):
        played(path)


class BrokenError(Exception):
    pass


def test_the_step_in_which_the_daemon_failed_is_replayed_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = TAPE.save(tmp_path / "a", end=200)
    with path.open("ab") as file:
        frames = FrameWriter(file)
        at, state = TAPE.taken[200].now, TAPE.states[200]
        started_ns = START.wall_ns
        frames.begin(Head("0.2.0", "acsar", 200, at.mono_ns, at.wall_ns, "", state, started_ns))
        failed = TAPE.taken[200]
        frames.add(Failure(200, "BrokenError: x", failed.now, failed.heard))
        frames.end()
    _, playback, _ = played(path)
    assert "(BrokenError: x), does not fail in this version" in playback.failed_step()
    _, playback, _ = played(path)

    def fail(*_: object) -> None:
        raise BrokenError("y")

    monkeypatch.setattr(Robot, "hear", fail)
    assert "also fails here, with BrokenError: y" in playback.failed_step()


def test_a_difference_names_the_side_without_a_pose(tmp_path: Path) -> None:
    config = CONFIG
    checked = replace(config, mcu=replace(config.mcu, link_check="on"))
    _, playback, _ = played(TAPE.save(tmp_path / "a"), other=checked)
    first = playback.comparison.first_by_output["pose"]
    recorded, replayed = "\n".join(describe_difference(first, 0)).split("  replayed")
    assert "pose x 0.000000" in recorded
    assert "no pose" in replayed
    assert "no pose" not in recorded


# the estimates are stored rounded, with a checksum of the exact ones

ESTIMATES = [estimate for step in TAPE.taken for estimate in step.news.estimates]


def test_a_checksum_continues_and_covers_every_bit() -> None:
    *early, last = ESTIMATES
    assert checksum(ESTIMATES[5:], checksum(ESTIMATES[:5], 0)) == checksum(ESTIMATES, 0)
    nudged = replace(last, pose=replace(last.pose, x=math.nextafter(last.pose.x, 9.0)))
    turned = replace(last, positions=(0.0, *last.positions[1:]))
    for other in (nudged, turned):
        assert checksum([*early, other], 0) != checksum(ESTIMATES, 0)
