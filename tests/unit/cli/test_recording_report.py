"""Tests of `acsard recording report`, which writes a recording as one HTML file."""

from __future__ import annotations

import json
import re
import shutil
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest

from acsard.core.motion.lifecycle import Lifecycle
from acsard.recording.file_replay import steps
from acsard.recording.mcap_file import Recording
from acsard.recording.recorded_steps import US_PER_S
from tests.scenarios.taped import chunks
from tests.system.typed import typed
from tests.unit.report.seen import column

RECORDINGS = Path(__file__).parents[2] / "recordings"
QUIET = RECORDINGS / "quiet.mcap"


def report(*words: object) -> tuple[int, str, str]:
    result = typed("recording", "report", *map(str, words))
    return result.code, result.out, result.err


def pictures(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the traces of each plot in the file, by name."""
    text = path.read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="pictures">(.*?)</script>', text)
    return {figure["name"]: figure["data"] for figure in json.loads(data)}


@lru_cache
def ends_at() -> tuple[float, float]:
    """Return the robot's last recorded position, m."""
    poses = [pose for step in steps(Recording(QUIET)) for pose in step.recorded.poses]
    return poses[-1][0] / US_PER_S, poses[-1][1] / US_PER_S


@pytest.mark.slow
def test_the_numbers_of_the_file_are_those_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = report(QUIET)
    assert (code, err) == (0, "")
    path = tmp_path / "quiet.html"
    assert out.startswith("quiet.html: ")
    assert path.stat().st_size < 8e6
    end = next(trace for trace in pictures(path)["path"] if trace["name"] == "end")
    assert (column(end["x"])[0], column(end["y"])[0]) == ends_at()
    text = path.read_text(encoding="utf-8")
    assert "1 stop (by unnamed (native))" in text
    assert "Plotly" in text


@pytest.mark.slow
def test_a_version_with_other_texts_says_that_only_texts_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Lifecycle, "_cleared_text", lambda self: "the words of another version")
    code, _, err = report(QUIET, tmp_path / "new.html")
    assert code == 0
    assert "the texts of reasons or events differ from the recorded ones" in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_an_old_report_is_replaced_only_by_a_complete_new_one(tmp_path: Path) -> None:
    new = tmp_path / "here.html"
    new.write_text("mine")
    assert report(QUIET, new, "--force", "--from", "9999")[0] == 1
    assert new.read_text() == "mine"
    before = new.stat().st_ino
    assert report(QUIET, new, "--force")[0] == 0
    # a new file replaces the old one; the old one is not overwritten
    assert new.stat().st_ino != before
    assert [*tmp_path.iterdir()] == [new]


@pytest.mark.slow
def test_a_report_of_a_range_says_that_the_recording_is_truncated(tmp_path: Path) -> None:
    cut, new = tmp_path / "cut.mcap", tmp_path / "cut.html"
    shutil.copy(QUIET, cut)
    cut.write_bytes(cut.read_bytes()[:-4000])
    code, _, err = report(cut, new, "--from", "1", "--to", "2")
    assert code == 0
    assert "no end: it was cut" in err
    assert "no end: it was cut" in new.read_text(encoding="utf-8")
    times = column(pictures(new)["speeds"][2]["x"])
    assert times[-1] - times[0] == pytest.approx(1000, abs=30)


@pytest.mark.slow
def test_a_damaged_section_is_left_out_and_reported(tmp_path: Path) -> None:
    bad, new = tmp_path / "bad.mcap", tmp_path / "bad.html"
    data = bytearray((RECORDINGS / "faults.mcap").read_bytes())
    (begin, end), _ = chunks(data)
    data[(begin + end) // 2 : (begin + end) // 2 + 20] = bytes(20)
    bad.write_bytes(data)
    code, _, err = report(bad, new)
    assert code == 0
    assert "1 damaged place is left out" in err
    assert "steps are missing" in err
    text = new.read_text(encoding="utf-8")
    assert "1 damaged place is left out" in text
    assert "steps are missing" in text
