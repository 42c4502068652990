"""The page lists the recordings."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from acsard.web import recordings
from acsard.web.callers import RequestRefusedError
from acsard.web.recordings import BlackBox, Recording, rows


def test_a_robot_that_has_just_started_has_no_recordings(tmp_path: Path) -> None:
    """The recorder makes its directory about a second after the daemon's start."""
    assert rows(tmp_path / "record") == []


def test_a_file_that_the_daemon_deletes_meanwhile_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["000001-20261121T070027Z.rec.zst", "000002-20261121T070127Z.rec.zst"]
    (tmp_path / names[1]).write_bytes(b"")
    monkeypatch.setattr(recordings, "listed", lambda place: [place / name for name in names])
    assert [row.name for row in rows(tmp_path)] == names[1:]


def test_a_recording_is_listed_with_its_beginning_and_its_duration(tmp_path: Path) -> None:
    path = tmp_path / "000001-20261121T070027Z.rec.zst"
    path.write_bytes(b"1234")
    begin = 1_795_244_427.0
    os.utime(path, (begin, begin + 60.0))
    assert rows(tmp_path) == [Recording(path.name, begin, 60.0, 4, being_recorded=False)]
    os.utime(path)
    (row,) = rows(tmp_path)
    assert row.being_recorded


def test_a_file_in_place_of_the_directory_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "record").write_text("")
    with pytest.raises(NotADirectoryError):
        rows(tmp_path / "record")


@pytest.mark.parametrize("directory", ["", "record"])
async def test_a_fresh_robot_has_an_empty_list_of_recordings(
    tmp_path: Path, directory: str
) -> None:
    place = directory and str(tmp_path / directory)
    robot: Any = SimpleNamespace(
        endpoint="tcp/127.0.0.1:7447", about=SimpleNamespace(recordings=place)
    )
    assert await BlackBox(robot).rows() == []
    with pytest.raises(RequestRefusedError, match="does not exist"):
        await BlackBox(robot).find("000001-20261121T070027Z.rec.zst")
