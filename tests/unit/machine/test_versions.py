"""Tests of the versions in /opt/acsard: which is in use, which is newer, and what a copy has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from acsard.host.errors import MendableError
from acsard.machine import versions
from acsard.machine.deploy_files import PACKAGED
from tests.system.harness import ROOT


def versions_in(home: Path, *names: str) -> None:
    """Make versions that have only a stop program; each is newer than the one before."""
    for age, name in enumerate(names):
        program = home / name / "bin" / versions.STOP_PROGRAM
        program.parent.mkdir(parents=True)
        program.touch()
        os.utime(program, (age, age))


def test_a_new_version_in_use_makes_the_one_before_it_the_previous_one(tmp_path: Path) -> None:
    versions_in(tmp_path, "0.2.0", "0.3.0")
    assert (versions.current(tmp_path), versions.previous(tmp_path)) == ("", "")
    versions.use("0.2.0", tmp_path)
    assert (versions.current(tmp_path), versions.previous(tmp_path)) == ("0.2.0", "")
    for _ in range(2):
        versions.use("0.3.0", tmp_path)
        assert (versions.current(tmp_path), versions.previous(tmp_path)) == ("0.3.0", "0.2.0")
    assert (tmp_path / "current" / "bin").is_dir(), "the link is relative"


def test_the_link_is_never_missing_while_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions_in(tmp_path, "0.2.0", "0.3.0")
    versions.use("0.2.0", tmp_path)
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        versions.use("0.3.0", tmp_path)
    assert versions.current(tmp_path) == "0.2.0"
    monkeypatch.undo()
    versions.use("0.3.0", tmp_path)  # what the killed program left does not disturb
    assert versions.current(tmp_path) == "0.3.0"


@pytest.mark.parametrize(
    ("names", "newest"),
    [
        (("0.2.0", "0.10.0"), "0.10.0"),
        (("0.10.0", "0.2.0"), "0.10.0"),
        (("0.2.0", "0.2.0.dev0+gb"), "0.2.0"),
        (("0.2.0.dev0+gb", "0.2.0.dev0+ga"), "0.2.0.dev0+ga"),
    ],
)
def test_versions_are_sorted_by_number_and_then_by_age(
    tmp_path: Path, names: tuple[str, ...], newest: str
) -> None:
    versions_in(tmp_path, *names)
    assert versions.installed(tmp_path)[-1] == newest


def test_a_newer_version_that_is_not_in_use_is_found(tmp_path: Path) -> None:
    versions_in(tmp_path, "0.2.0", "0.3.0", ".unfinished-x", "dist", "venv")
    assert versions.unused(tmp_path) == "", "there is no service"
    versions.use("0.3.0", tmp_path)
    assert versions.unused(tmp_path) == ""
    versions.use("0.2.0", tmp_path)
    assert versions.unused(tmp_path) == "0.3.0"


def test_what_a_killed_removal_leaves_is_no_version_and_is_removed_by_the_next_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions_in(tmp_path, "0.1.0", "0.2.0", "0.3.0")
    versions.use("0.2.0", tmp_path)
    versions.use("0.3.0", tmp_path)
    monkeypatch.setattr(os, "unlink", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        versions.remove_others(tmp_path)
    assert versions.installed(tmp_path) == ["0.2.0", "0.3.0"]
    monkeypatch.undo()
    with versions.changing(tmp_path):
        left = {path.name for path in tmp_path.iterdir()}
    assert left == {"0.2.0", "0.3.0", "current", "previous"}


def test_the_launcher_imports_from_its_own_version_also_after_a_switch(tmp_path: Path) -> None:
    for name in ("1", "2"):
        package = tmp_path / name / "lib" / "acsard"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "cli.py").write_text("def entry():\n    import acsard.name\n")
        (package / "name.py").write_text(f"print({name!r})\n")
        program = tmp_path / name / "bin" / "acsard"
        program.parent.mkdir()
        program.write_text(versions.launcher(sys.executable))
        program.chmod(0o755)
    for name in ("1", "2", "1"):
        versions.use(name, tmp_path)
        done = subprocess.run(
            [tmp_path / "current/bin/acsard"], capture_output=True, text=True, check=True
        )
        assert done.stdout == f"{name}\n"


def test_a_python_in_a_home_directory_is_replaced_by_the_system_s_or_refused() -> None:
    assert versions.service_python(hidden=()) == os.path.realpath(sys.executable)
    with pytest.raises(MendableError, match="such as /usr/bin/python3") as refusal:
        versions.service_python(hidden=("/",))
    assert f"apt install python3.{sys.version_info.minor}" in str(refusal.value)


def test_the_copy_has_acsard_and_the_libraries_of_its_users_but_no_developer_s() -> None:
    names = {package.name.lower() for package in versions.closure()}
    assert {"acsard", "eclipse-zenoh", "numpy", "aiohttp", "foxglove-sdk"} <= names
    assert {"multidict", "markdown-it-py"} <= names, "the libraries of libraries"
    assert not {"pytest", "mypy", "hypothesis"} & names


def test_the_copy_of_a_clone_has_the_same_files_of_deploy_as_the_wheel() -> None:
    project = (ROOT / "pyproject.toml").read_text()
    for name in PACKAGED:
        assert f'"deploy/{name}" = "acsard/deploy/{name}"' in project


def test_a_full_disk_leaves_no_part_of_a_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(place: Path, python: str) -> None:
        (place / "lib").mkdir()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(versions, "_fill", full)
    with pytest.raises(MendableError, match="No space left on device"):
        versions.copy(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_copy_with_other_content_gets_a_name_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = "one"

    def fill(place: Path, python: str) -> None:
        (place / "lib").mkdir()
        (place / "lib" / "module.py").write_text(content)

    monkeypatch.setattr(versions, "_fill", fill)
    monkeypatch.setattr(versions, "_require_start", lambda place: None)
    first = versions.copy(tmp_path)
    assert versions.copy(tmp_path) == first
    content = "two"
    second = versions.copy(tmp_path)
    assert second != first
    assert versions.copy(tmp_path) == second
    assert (tmp_path / first / "lib" / "module.py").read_text() == "one"
    assert versions.is_own(first)
    assert versions.is_own(second)
    assert sorted(os.listdir(tmp_path)) == sorted((first, second))


def test_files_of_one_size_and_date_are_compared_by_their_content(tmp_path: Path) -> None:
    # All files of a package have one date, and each commit has one length.
    for name, commit in (("one", "a1b2"), ("other", "c3d4")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "commit").write_text(commit)
        os.utime(tmp_path / name / "commit", (0, 0))
    assert not versions.same(tmp_path / "one", tmp_path / "other")
    assert versions.same(tmp_path / "one", tmp_path / "one")
