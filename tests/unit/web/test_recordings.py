"""Tests of the list of recordings that the page shows."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.web.recordings import rows


def test_a_robot_that_has_just_started_has_no_recordings(tmp_path: Path) -> None:
    """The recorder makes its directory about a second after the daemon's start."""
    assert rows(tmp_path / "record") == []


def test_a_file_in_place_of_the_directory_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "record").write_text("")
    with pytest.raises(NotADirectoryError):
        rows(tmp_path / "record")
