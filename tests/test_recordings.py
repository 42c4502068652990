"""Every drive in `tests/recordings` replays with the same result as when it was recorded.

A failure names the first output that changed. If this change is intended, `python -m
tests.recordings` makes the recordings of the simulator again. The texts of reasons and events may
change without new recordings, because the recordings keep the texts of older versions.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.recording.file import SUFFIX, Recording
from acsard.recording.replay import Playback
from acsard.recording.replay_text import describe_difference
from tests.each import each

RECORDINGS = sorted((Path(__file__).parent / "recordings").glob(f"*{SUFFIX}"))

MOST_BYTES = 100_000


def test_there_are_at_least_three_recordings_and_each_is_small() -> None:
    assert len(RECORDINGS) >= 3
    sizes = {path.name: path.stat().st_size for path in RECORDINGS}
    assert {name: size for name, size in sizes.items() if size > MOST_BYTES} == {}


@each("path", RECORDINGS)
def test_a_recording_replays_with_the_same_result(path: Path) -> None:
    recording = Recording([path])
    playback = Playback(recording)
    steps = [step for step, _ in playback.steps()]
    comparison = playback.comparison
    assert (playback.gaps, recording.damage) == ([], [])
    assert [step.number for step in steps] == list(range(len(steps)))
    for output, first in comparison.first_by_output.items():
        if output not in ("reason", "event text"):
            pytest.fail("\n".join(describe_difference(first, steps[0].now.mono_ns)))
    assert comparison.all["lines"] == comparison.equal["lines"] > 100
    assert comparison.equal["modes"] == comparison.steps
    assert comparison.exact, "an estimate is another in its last bits"
