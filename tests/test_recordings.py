"""Every drive in `tests/recordings` replays with the same result as when it was recorded.

A failure names the first line, mode or pose that changed. If the change is wanted, `python -m
tests.recordings` rewrites the recordings that were made with the simulator.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.recording.file import Recording
from acsard.recording.file_replay import replay_file
from acsard.recording.replay_text import describe_difference
from tests.each import each

RECORDINGS = sorted((Path(__file__).parent / "recordings").glob("*.mcap"))

MOST_BYTES = 100_000


def test_there_are_some_and_each_is_small() -> None:
    assert len(RECORDINGS) >= 3
    sizes = {path.name: path.stat().st_size for path in RECORDINGS}
    assert {name: size for name, size in sizes.items() if size > MOST_BYTES} == {}


@each("path", RECORDINGS)
def test_it_comes_out_as_it_did(path: Path) -> None:
    recording = Recording(path)
    comparison, trouble, _ = replay_file(recording)
    assert trouble == ""
    if comparison.first is not None:
        pytest.fail("\n".join(describe_difference(comparison.first, recording.about.mono_ns)))
    assert comparison.lines == comparison.lines_same > 100
    assert comparison.modes_same == comparison.steps
    assert comparison.exact, "an estimate is another in its last bits"
