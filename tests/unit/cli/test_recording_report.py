"""Tests of `acsard recording report`, which writes a recording as one HTML file."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import pytest

from acsard.recording.file import Recording
from acsard.recording.recorded_steps import US_PER_S
from tests.system.typed import typed
from tests.unit.recording.test_html_report import traces

RECORDINGS = Path(__file__).parents[2] / "recordings"
QUIET = RECORDINGS / "quiet.rec.zst"


def report(*words: object) -> tuple[int, str, str]:
    result = typed("recording", "report", *map(str, words))
    return result.code, result.out, result.err


@lru_cache
def ends_at() -> tuple[float, float]:
    """Return the robot's last recorded position, m."""
    poses = [pose for step in Recording([QUIET]).steps() for pose in step.recorded.poses]
    return poses[-1][0] / US_PER_S, poses[-1][1] / US_PER_S


def test_the_numbers_of_the_file_are_those_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = report(QUIET)
    assert (code, err) == (0, "")
    path = tmp_path / "quiet.html"
    assert out.startswith("quiet.html: ")
    assert path.stat().st_size < 2e6
    text = path.read_text(encoding="utf-8")
    (end,) = traces(text, "end")
    assert (end["x"][0], end["y"][0]) == pytest.approx(ends_at(), abs=1e-5)
    assert re.search(r"The robot drove 1\.87 m in 5\.1 s of 7\.9 s, at most 0\.5\d m/s\.", text)
    assert "(by unnamed (native))" in text


def test_an_old_report_is_replaced_only_by_a_complete_new_one(tmp_path: Path) -> None:
    new = tmp_path / "here.html"
    new.write_text("mine")
    assert report(QUIET, new, "--force", "--from", "2000-01-01", "--to", "+1s")[0] == 1
    assert new.read_text() == "mine"
    before = new.stat().st_ino
    assert report(QUIET, new, "--force")[0] == 0
    # A new file replaces the old one; the old one is not overwritten.
    assert new.stat().st_ino != before
    assert [*tmp_path.iterdir()] == [new]


def test_a_damaged_place_is_left_out_and_named(tmp_path: Path) -> None:
    bad, new = tmp_path / "bad.rec.zst", tmp_path / "bad.html"
    data = bytearray(QUIET.read_bytes())
    data[len(data) // 2] ^= 0xFF
    bad.write_bytes(data)
    code, _, err = report(bad, new)
    assert code == 0
    assert "bad.rec.zst: bytes " in err
    assert re.search(
        r'<p class="note">bad.rec.zst: bytes .* cannot be read', new.read_text(encoding="utf-8")
    )
