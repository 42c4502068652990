"""A service cannot run from a home directory or from a venv that uses a Python in one."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.host.placement import misplaced

PROGRAM = "/usr/bin/env"
"""A program that every user may run."""


@pytest.mark.parametrize(
    ("prefix", "base", "good"),
    [
        ("/opt/acsard/venv", "/usr", True),
        ("/usr", "/usr", False),
        ("/home/anna/venv", "/usr", False),
        ("/root/venv", "/usr", False),
        ("/tmp/venv", "/usr", False),
        ("/rooted/venv", "/usr", True),
    ],
)
def test_a_service_cannot_live_in_a_home_nor_outside_a_venv(
    prefix: str, base: str, good: bool
) -> None:
    assert (misplaced(prefix, base, PROGRAM) == "") is good


def test_nor_can_it_borrow_the_python_of_a_home() -> None:
    told = misplaced("/opt/acsard/venv", "/root/.pyenv/versions/3.11.7", PROGRAM)
    assert "/root/.pyenv/versions/3.11.7" in told
    assert "/usr/bin/python3 -m venv --clear /opt/acsard/venv" in told


def test_a_link_to_a_python_in_a_home_is_followed(tmp_path: Path) -> None:
    home = tmp_path / "home" / "anna"
    home.mkdir(parents=True)
    (home / "python3").symlink_to(PROGRAM)
    (tmp_path / "python").symlink_to(home / "python3")
    there = misplaced("/opt/v", "/usr", str(tmp_path / "python"), hidden=("/usr/bin",))
    assert "/usr/bin" in there


def test_a_directory_that_others_may_not_enter_is_named(tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    venv.mkdir()
    tmp_path.chmod(0o700)
    told = misplaced(str(venv), "/usr", PROGRAM, hidden=())
    assert "may not enter" in told
    assert "chmod o+rx" in told
