"""Tests of the steps on a machine: files and directories are made and removed, commands run."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.host.errors import MendableError
from acsard.machine.installation_steps import File, Remove, Run, Write


def test_written_and_removed_a_directory_is_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("untouched")
    file = File(tmp_path / "acsard" / "bin" / "tool", b"new", 0o755)
    Write(file).do()
    assert file.condition() == "as installed"
    assert file.path.stat().st_mode & 0o777 == 0o755
    file.path.unlink()
    file.path.symlink_to(tmp_path / "elsewhere")
    assert file.condition() == "changed"
    Write(file).do()
    assert (tmp_path / "elsewhere").read_text() == "untouched"
    Remove(file.path).do()
    assert file.condition() == "missing"
    assert [path.name for path in tmp_path.iterdir()] == ["elsewhere"]


def test_a_directory_with_something_else_in_it_stays(tmp_path: Path) -> None:
    file = File(tmp_path / "bin" / "tool", b"new")
    Write(file).do()
    (tmp_path / "bin" / "other").touch()
    Remove(file.path).do()
    assert [path.name for path in (tmp_path / "bin").iterdir()] == ["other"]


def test_a_command_that_fails_ends_it_unless_it_may() -> None:
    words = ("sh", "-c", "echo no >&2; exit 1")
    with pytest.raises(MendableError, match="no"):
        Run(words).do()
    Run(words, may_fail=True).do()
    with pytest.raises(MendableError, match="no such program"):
        Run(("no such program",)).do()


def test_a_whole_directory_goes_and_those_of_ours_that_are_empty_then(tmp_path: Path) -> None:
    place = tmp_path / "acsard" / "tls"
    (place / "clients").mkdir(parents=True)
    (place / "clients" / "key.pem").touch()
    Remove(place).do()
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_read_is_a_sentence(tmp_path: Path) -> None:
    place = File(tmp_path / "acsard.toml", b"")
    place.path.mkdir()
    assert place.condition() == "unreadable"
    with pytest.raises(MendableError, match=r"cannot read .*acsard\.toml"):
        place.found()
