"""Every drive in `tests/recordings` replays with the same result as when it was recorded.

A failure names the first output that changed. If this change is intended, `python -m
tests.recordings` makes the recordings of the simulator again. The texts of reasons and events may
change without new recordings, because the recordings keep the texts of older versions.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.recording.file_replay import replay_file
from acsard.recording.mcap_file import Recording
from acsard.recording.replay import TEXT_OUTPUTS
from acsard.recording.replay_text import describe_difference
from tests.each import each

RECORDINGS = sorted((Path(__file__).parent / "recordings").glob("*.mcap"))

MOST_BYTES = 100_000


def test_there_are_at_least_three_recordings_and_each_is_small() -> None:
    assert len(RECORDINGS) >= 3
    sizes = {path.name: path.stat().st_size for path in RECORDINGS}
    assert {name: size for name, size in sizes.items() if size > MOST_BYTES} == {}


@each("path", RECORDINGS)
def test_a_recording_replays_with_the_same_result(path: Path) -> None:
    recording = Recording(path)
    result = replay_file(recording)
    comparison = result.comparison
    assert result.gaps == []
    for output, first in comparison.first_by_output.items():
        if output not in TEXT_OUTPUTS:
            pytest.fail("\n".join(describe_difference(first, recording.about.mono_ns)))
    assert comparison.lines == comparison.lines_same > 100
    assert comparison.modes_same == comparison.steps
    assert comparison.exact, "an estimate is another in its last bits"
