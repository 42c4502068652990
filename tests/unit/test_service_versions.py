"""Versions side by side, an upgrade, and the way back."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from acsard.host.errors import MendableError
from acsard.machine import upgrade, versions
from acsard.machine.upgrade import Look, UnitState, prepare, worse
from tests.unit.screens import STATE


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
    versions.go_back("0.2.0", "0.1.0", tmp_path)
    assert (versions.current(tmp_path), versions.previous(tmp_path)) == ("0.2.0", "0.1.0")
    versions.go_back("0.3.0", "", tmp_path)
    assert (versions.current(tmp_path), versions.previous(tmp_path)) == ("0.3.0", "")


def test_the_link_is_never_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    versions_in(tmp_path, "0.2.0", "0.3.0")
    versions.use("0.2.0", tmp_path)
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        versions.use("0.3.0", tmp_path)
    assert versions.current(tmp_path) == "0.2.0"
    monkeypatch.undo()
    versions.use("0.3.0", tmp_path)  # what the killed program left does not disturb
    assert versions.current(tmp_path) == "0.3.0"


def test_a_newer_version_that_is_not_in_use_is_found(tmp_path: Path) -> None:
    versions_in(tmp_path, "0.2.0", "0.3.0", ".unfinished-x", "dist", "venv")
    assert versions.unused(tmp_path) == "", "there is no service"
    versions.use("0.3.0", tmp_path)
    assert versions.unused(tmp_path) == ""
    versions.use("0.2.0", tmp_path)
    assert versions.unused(tmp_path) == "0.3.0"
    versions_in(tmp_path, "0.1.0")
    assert versions.unused(tmp_path) == "0.3.0"


def test_the_newest_version_has_the_highest_number_not_the_latest_files(tmp_path: Path) -> None:
    versions_in(tmp_path, "0.10.0", "0.3.0", "0.9.1", "0.3.0.dev2+gb", "0.3.0.dev2+ga")
    commits = ["0.3.0.dev2+gb", "0.3.0.dev2+ga"]  # they have no order but that of their files
    assert versions.installed(tmp_path) == [*commits, "0.3.0", "0.9.1", "0.10.0"]


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


def test_one_program_changes_versions_at_a_time_and_clears_what_a_killed_one_left(
    tmp_path: Path,
) -> None:
    home = tmp_path / "opt" / "acsard"
    for _ in range(2):
        versions.make_home(home)
    assert home.stat().st_mode & 0o777 == 0o755
    (home / ".unfinished-x" / "lib").mkdir(parents=True)
    with versions.changing(home):
        assert list(home.iterdir()) == []
        with (
            pytest.raises(MendableError, match="another program changes the version in"),
            versions.changing(home),
        ):
            raise AssertionError
    with versions.changing(home):
        pass


def test_only_versions_that_nothing_needs_are_removed(tmp_path: Path) -> None:
    versions_in(tmp_path, "0.1.0", "0.2.0", "0.3.0", "0.4.0")
    for name in ("0.2.0", "0.3.0"):
        versions.use(name, tmp_path)
    (tmp_path / versions.PACKAGE / "0.4.0").mkdir(parents=True)
    versions.remove_others(tmp_path)
    assert versions.installed(tmp_path) == ["0.2.0", "0.3.0", "0.4.0"]
    assert not list(tmp_path.glob(".*"))


def seen(
    link: str = "up",
    wheels: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    missed: int = 0,
    commanded: bool = False,
) -> Look:
    """Return what a daemon answers that has sent 3,000 lines."""
    counters = {"lines_sent": 3000} | ({"missed_periods": missed} if missed else {})
    state = msgspec.structs.replace(STATE, link=link, wheels=[*wheels], counters=counters)
    return Look(state, commanded)


@pytest.mark.parametrize(
    ("look", "stands"),
    [
        (seen(), True),
        (seen(wheels=()), True),
        (seen(wheels=(0.0, 0.0, -0.2, 0.0)), False),
        (seen(commanded=True), False),
    ],
)
def test_a_robot_stands_if_no_wheel_turns_and_no_speed_is_sent(look: Look, stands: bool) -> None:
    assert look.stands is stands


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        (seen(), seen(), ""),
        (seen(), None, "does not answer"),
        (None, seen("down"), ""),
        (seen(), seen("stale"), "no link"),
        (seen("down"), seen("down"), ""),
        (seen(), seen(missed=30), ""),
        (seen(), seen(missed=31), "missed 31 control periods"),
        (seen(missed=40), seen(missed=40), ""),
        (seen(missed=40), seen(missed=41), "missed 41 control periods"),
    ],
)
def test_a_version_is_worse_without_the_link_or_with_more_missed_periods(
    before: Look | None, after: Look | None, why: str
) -> None:
    found = worse(before, after)
    assert why in found
    assert bool(found) is bool(why)


def test_a_version_that_is_installed_is_named_by_its_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions_in(tmp_path, "0.3.0")
    (tmp_path / "0.4.0").mkdir()  # its copy was not finished
    monkeypatch.setattr(versions, "HOME", tmp_path)
    monkeypatch.setattr(versions.installed, "__defaults__", (tmp_path,))
    assert prepare(tmp_path / "0.3.0") == "0.3.0"
    namesake = tmp_path / "venvs" / "0.3.0"
    namesake.mkdir(parents=True)
    for other in (tmp_path / "0.4.0", namesake):
        with pytest.raises(MendableError, match="neither a"):
            prepare(other)


def test_only_a_package_or_an_environment_is_a_new_version(tmp_path: Path) -> None:
    with pytest.raises(MendableError, match=r"neither a \.deb nor an environment"):
        prepare(tmp_path)
    (tmp_path / "x.deb").write_text("no package")
    with pytest.raises(MendableError, match="dpkg-deb"):
        prepare(tmp_path / "x.deb")


@pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="needs dpkg-deb")
def test_the_package_of_another_program_is_refused_before_apt_gets_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    control = tmp_path / "other" / "DEBIAN" / "control"
    control.parent.mkdir(parents=True)
    fields = {"Package": "other", "Version": "1", "Architecture": "all", "Description": "x"}
    fields["Maintainer"] = "x <x@example.org>"
    control.write_text("".join(f"{name}: {value}\n" for name, value in fields.items()))
    package = tmp_path / "other.deb"
    words = ["dpkg-deb", "--root-owner-group", "--build", str(control.parent.parent), str(package)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    programs = tmp_path / "bin"  # without apt
    programs.mkdir()
    for name in ("dpkg-deb", "tar"):
        (programs / name).symlink_to(shutil.which(name) or "")
    monkeypatch.setenv("PATH", str(programs))
    with pytest.raises(MendableError, match=r"other\.deb is the package other; name a package of"):
        prepare(package)


def test_the_last_word_of_an_environment_is_the_version_that_it_copied(tmp_path: Path) -> None:
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text("#!/bin/sh\necho 1 warning of a library\necho 0.3.0\n")
    python.chmod(0o755)
    assert prepare(tmp_path) == "0.3.0"


def test_an_environment_whose_program_cannot_copy_itself_is_refused(tmp_path: Path) -> None:
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.symlink_to("/usr/bin/false")
    with pytest.raises(MendableError, match=r"acsard\.machine\.versions: ended with exit code 1"):
        prepare(tmp_path)


@pytest.mark.parametrize(
    ("full", "after"),
    [
        (("1.1.0",), r"1\.0\.0 is in use again\."),
        (("1.1.0", "1.0.0"), r"1\.0\.0 is in use again, but cannot be started .*No space"),
    ],
)
def test_a_version_that_cannot_be_started_is_left_again(
    full: tuple[str, ...], after: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = ["1.0.0"]
    started = []

    def start(old: str, new: str, running: list[str], say: object) -> None:
        started.append(new)
        if new in full:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(versions, "current", lambda: used[-1])
    monkeypatch.setattr(versions, "previous", lambda: "0.9.0")
    monkeypatch.setattr(versions, "use", used.append)
    monkeypatch.setattr(versions, "go_back", lambda name, older: used.extend([older, name]))
    monkeypatch.setattr(upgrade, "unit_state", lambda unit: UnitState("inactive", 0, 0))
    monkeypatch.setattr(upgrade, "config_of", lambda pid: Path("/nonexistent"))
    monkeypatch.setattr(upgrade, "_start", start)
    with pytest.raises(MendableError, match=rf"1\.1\.0 cannot be started .*No space.*{after}"):
        upgrade.change("1.1.0", print)
    assert used == ["1.0.0", "1.1.0", "0.9.0", "1.0.0"]
    assert started == ["1.1.0", "1.0.0"]
