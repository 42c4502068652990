"""A copy of acsard and its libraries, which the service runs."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import Distribution, PackageNotFoundError
from pathlib import Path

import pytest

import acsard
from acsard.host import version as own
from acsard.host.errors import MendableError
from acsard.machine import versions
from acsard.machine.deploy_files import PACKAGED


def test_a_python_in_a_home_directory_is_replaced_by_the_system_s_or_refused() -> None:
    # The Python of these tests may itself be in a home directory that the service cannot read.
    system = f"/usr/bin/python3.{sys.version_info.minor}"
    assert versions.service_python(hidden=()) in (os.path.realpath(sys.executable), system)
    with pytest.raises(MendableError, match="such as /usr/bin/python3") as refusal:
        versions.service_python(hidden=("/",))
    assert f"apt install python3.{sys.version_info.minor}" in str(refusal.value)


@pytest.mark.parametrize("closed", ["executable", "base_prefix"])
def test_neither_the_python_nor_its_library_may_be_hidden_from_the_service(
    closed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "python"
    place.touch()
    monkeypatch.setattr(sys, "executable", "/usr/bin/env")
    monkeypatch.setattr(sys, "base_prefix", "/usr")
    assert versions.service_python((str(tmp_path),)) == os.path.realpath("/usr/bin/env")
    monkeypatch.setattr(sys, closed, str(place))
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(MendableError, match="services have no access to home directories"):
        versions.service_python((str(tmp_path),))


def test_the_copy_has_acsard_and_the_libraries_of_its_users_but_no_developer_s() -> None:
    names = {package.name.lower() for package in versions.closure()}
    assert {"acsard", "eclipse-zenoh", "numpy", "aiohttp", "foxglove-sdk"} <= names
    assert {"multidict", "markdown-it-py"} <= names, "the libraries of libraries"
    assert not {"pytest", "mypy", "hypothesis"} & names


def installed(site: Path, name: str, *files: str) -> None:
    """Install a package with these files in a directory, as pip does."""
    about = f"{name}-1.dist-info"
    (site / about).mkdir(parents=True)
    (site / about / "METADATA").write_text(f"Name: {name}\nVersion: 1\n")
    for file in files:
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        (site / file).touch()
    listed = [*files, f"{about}/METADATA", f"{about}/RECORD"]
    (site / about / "RECORD").write_text("".join(f"{file},,\n" for file in listed))


def test_a_library_that_another_program_installed_cannot_be_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, "other")
    (tmp_path / "other-1.dist-info" / "RECORD").unlink()
    monkeypatch.setattr(
        versions, "closure", lambda: [Distribution.at(tmp_path / "other-1.dist-info")]
    )
    with pytest.raises(MendableError, match="the library other has no list of its files"):
        versions.copy(tmp_path)
    assert os.listdir(tmp_path) == ["other-1.dist-info"]


def test_a_copy_runs_by_itself_with_the_files_and_the_commit_of_its_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package of the environment is a small one that says its arguments."""
    package = tmp_path / "environment" / "acsard"
    for directory in PACKAGED:
        (package.parent / "deploy" / directory).mkdir(parents=True)
        (package.parent / "deploy" / directory / "README").write_text(directory)
    (package.parent / "deploy" / "systemd" / versions.STOP_PROGRAM).write_text("#!/bin/sh\n")
    (package.parent / "acsard.toml").write_text("# all defaults\n")
    (package / "__pycache__").mkdir(parents=True)
    (package / "__pycache__" / "old.pyc").touch()
    (package / "__init__.py").touch()
    (package / "cli.py").write_text("import sys\ndef entry():\n    print(*sys.argv[1:])\n")
    monkeypatch.setattr(acsard, "__file__", str(package / "__init__.py"))
    site = package.parent / "site"
    installed(site, "other", "other/__init__.py", "../../bin/other", "other.pth", "other/data.txt")
    # What pip writes about a clone, and of an installation what is copied from the package.
    installed(site, "acsard", "__editable__.acsard.pth", "acsard/cli.py")
    record = site / "other-1.dist-info" / "RECORD"
    record.write_text(f"{record.read_text()}other/__pycache__/module.pyc,,\n")
    closure = [Distribution.at(site / f"{name}-1.dist-info") for name in ("other", "acsard")]
    monkeypatch.setattr(versions, "closure", lambda: closure)
    for commit in ("", "0123456789.dirty"):
        monkeypatch.setattr(own, "source", lambda commit=commit: commit)
        home = tmp_path / f"opt{commit}"
        versions.make_home(home)
        copied = home / versions.copy(home)
        ours = copied / "lib" / "acsard"
        program = copied / "bin" / "acsard"
        done = subprocess.run([program, "a", "b"], capture_output=True, text=True, check=True)
        assert done.stdout == "a b\n"
        programs = {program, copied / "bin" / versions.STOP_PROGRAM}
        for path in copied.rglob("*"):
            runs = path in programs or path.is_dir()
            assert path.stat().st_mode & 0o7777 == (0o755 if runs else 0o644), path
        assert [path.name.partition(".")[0] for path in sorted(ours.glob("__pycache__/*"))] == [
            "__init__", "cli",
        ]  # fmt: skip
        kept = ours / own.COMMIT_FILE
        assert (kept.read_text() if kept.exists() else "") == (f"{commit}\n" if commit else "")
        lib = copied / "lib"
        assert {str(path.relative_to(lib)) for path in lib.glob("other*/*.*")} == {
            "other/__init__.py", "other/data.txt",
        }  # fmt: skip
        assert {path.name for path in lib.iterdir()} == {
            "acsard", "acsard-1.dist-info", "other", "other-1.dist-info"
        }  # fmt: skip
        assert (lib / "acsard-1.dist-info" / "METADATA").exists()
        assert sorted(path.name for path in program.parent.iterdir()) == ["acsard", "acsard-stop"]
        deploy = versions.deploy_of(copied.name, home)
        assert {path.parent.name for path in deploy.glob("*/README")} == {*PACKAGED}
        assert (deploy / "acsard.toml").read_text() == "# all defaults\n"


@pytest.mark.parametrize("succeeds", [True, False])
def test_a_copy_waits_for_the_disk_also_if_the_program_sync_cannot_wait_for_one_disk(
    succeeds: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, synced = tmp_path / "bin" / "sync", list[str]()
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho $@ >{tmp_path}/asked\nexit {int(not succeeds)}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    monkeypatch.setattr(os, "sync", lambda: synced.append("all disks"))
    monkeypatch.setattr(versions, "_fill", lambda place, python: (place / "lib").mkdir())
    monkeypatch.setattr(versions, "_require_start", lambda place: None)
    home = tmp_path / "opt"
    home.mkdir()
    versions.copy(home)
    assert (tmp_path / "asked").read_text().startswith(f"--file-system {home}/")
    assert synced == ["all disks"] * (not succeeds)


@pytest.mark.parametrize(
    ("missing", "error"), [("other", "the library other is missing in"), ("windows", "")]
)
def test_a_library_may_be_missing_only_if_another_system_needs_it(
    missing: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, "acsard")
    metadata = tmp_path / "acsard-1.dist-info" / "METADATA"
    needs = "Requires-Dist: other\nRequires-Dist: windows; sys_platform == 'win32'\n"
    metadata.write_text(f"{metadata.read_text()}{needs}")

    def distribution(name: str) -> Distribution:
        if name in (missing, "windows"):
            raise PackageNotFoundError(name)
        return Distribution.at(tmp_path / "acsard-1.dist-info")

    monkeypatch.setattr(versions, "distribution", distribution)
    if error:
        with pytest.raises(MendableError, match=error):
            versions.closure()
    else:
        assert len(versions.closure()) == 2


def test_a_full_disk_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    before = os.umask(0o077)
    try:
        first = versions.copy(tmp_path)
    finally:
        os.umask(before)
    # The service's user must be able to read what root has copied.
    paths = [tmp_path / first, *(tmp_path / first).rglob("*")]
    assert {path.stat().st_mode & 0o777 for path in paths} == {0o755, 0o644}
    assert versions.copy(tmp_path) == first
    content = "two"
    second = versions.copy(tmp_path)
    assert second != first
    assert versions.copy(tmp_path) == second
    assert (tmp_path / first / "lib" / "module.py").read_text() == "one"
    assert versions.is_own(first)
    assert versions.is_own(second)
    assert sorted(os.listdir(tmp_path)) == sorted((first, second))


def test_a_copy_that_does_not_start_is_refused_and_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(place: Path, python: str) -> None:
        (place / "bin").mkdir()
        (place / "bin" / "acsard").write_text("#!/bin/sh\necho no numpy >&2\nexit 3\n")
        (place / "bin" / "acsard").chmod(0o755)

    monkeypatch.setattr(versions, "_fill", fill)
    with pytest.raises(MendableError, match="the copy of acsard does not start: no numpy; correct"):
        versions.copy(tmp_path)
    assert list(tmp_path.iterdir()) == []
