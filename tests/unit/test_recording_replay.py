"""A replay says which steps it took, what it cannot use, and where it differs."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.host.errors import RecordingError
from acsard.recording.file import Failure, FrameWriter, Head, Recording
from acsard.recording.replay import Playback, max_wheel_speed
from acsard.recording.replay_text import describe_difference
from tests.unit.drives import CONFIG, drive

TAPE = drive()


def played(*paths: Path, other: Config | None = None) -> tuple[list[int], Playback, Recording]:
    recording = Recording(paths)
    playback = Playback(recording, other)
    return [step.number for step, _ in playback.steps()], playback, recording


def test_steps_outside_the_time_are_told_apart(tmp_path: Path) -> None:
    path = TAPE.save(tmp_path / "a")
    times = TAPE.taken[450].now.wall_ns, TAPE.taken[460].now.wall_ns
    recording = Recording([path], *times)
    playback = Playback(recording)
    numbers = [s.number for s, _ in playback.steps() if recording.contains(s.now)]
    assert numbers == [n for n, s in enumerate(TAPE.taken) if times[0] <= s.now.wall_ns <= times[1]]
    found = playback.comparison
    assert (found.steps, found.equal["modes"], found.same) == (200, 200, True)
    lines = sum(entry.line is not None for entry in TAPE.taken[400:600])
    assert found.all["lines"] == found.equal["lines"] == lines < 200


def test_a_state_that_this_version_cannot_use_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        FrameWriter(file).begin(Head("9.9.9", "acsar", 5, 0, 0, "", b"no state"))
    with pytest.raises(RecordingError, match=r"cannot replay a, which acsard 9\.9\.9 wrote: "):
        played(path)


def test_a_difference_names_the_side_without_a_pose(tmp_path: Path) -> None:
    config = CONFIG
    checked = replace(config, mcu=replace(config.mcu, link_check="on"))
    _, playback, _ = played(TAPE.save(tmp_path / "a"), other=checked)
    first = playback.comparison.first_by_output["pose"]
    recorded, replayed = "\n".join(describe_difference(first, 0)).split("  replayed")
    assert "pose x 0.000000" in recorded
    assert "no pose" in replayed
    assert "no pose" not in recorded


@pytest.mark.parametrize("fastest", range(4))
def test_the_fastest_wheel_of_a_line_counts(fastest: int) -> None:
    speeds = [9.0 if wheel == fastest else 1.0 for wheel in range(4)]
    line = ",".join(f"{letter}n{speed:05.2f}" for letter, speed in zip("abcd", speeds, strict=True))
    assert max_wheel_speed(f"{line}\r\n".encode()) == 900


def test_a_failure_that_cannot_be_tried_again_is_reported_with_the_reason(tmp_path: Path) -> None:
    last = TAPE.taken[-1]
    for number, at, words in (
        (len(TAPE.taken), None, "the recorded daemon failed: KeyError: 'x'"),
        (len(TAPE.taken) + 5, last.now, "was not replayed, because the step before it is missing"),
    ):
        path = TAPE.save(tmp_path / "a")
        with path.open("ab") as file:
            frames = FrameWriter(file)
            start = TAPE.taken[0].now
            frames.begin(Head("0.2.0", "acsar", len(TAPE.taken), start.mono_ns, start.wall_ns))
            frames.add(Failure(number, "KeyError: 'x'", at, last.heard if at else None))
            frames.end()
        _, playback, _ = played(path)
        assert words in playback.failed_step()


def test_a_step_on_which_this_version_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forged recording may have any numbers, and so may one of another version."""

    def fails(*_: object) -> None:
        raise ZeroDivisionError("division\x1b by zero")

    playback = Playback(Recording([TAPE.save(tmp_path / "a")]))
    steps = playback.steps()
    for _ in range(7):
        next(steps)
    monkeypatch.setattr(playback.robot, "hear", fails)
    words = r"replay a, which acsard 0\.2\.0 wrote: it fails with ZeroDivisionError: .* in step 7$"
    with pytest.raises(RecordingError, match=words) as raised:
        next(steps)
    assert str(raised.value).isprintable()


def test_two_paths_are_as_far_apart_as_at_their_farthest(tmp_path: Path) -> None:
    drive = replace(CONFIG.drive, wheel_radius=2 * CONFIG.drive.wheel_radius)
    recording = Recording([TAPE.save(tmp_path / "a")])
    playback, farthest = Playback(recording, replace(CONFIG, drive=drive)), 0.0
    for step, news in playback.steps():
        if news.estimates:
            x, y, _ = (part / 1e6 for part in step.recorded.poses[-1])
            pose = news.estimates[-1].pose
            farthest = max(farthest, math.hypot(x - pose.x, y - pose.y))
    assert playback.comparison.max_distance_m == pytest.approx(farthest, abs=1e-5)
    assert farthest > 0.5
