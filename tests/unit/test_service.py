"""The service's files and the steps of its installation."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from acsard.cli import main
from acsard.host.errors import MendableError
from acsard.host.version import version
from acsard.machine import service_installation, versions
from acsard.machine.deploy_files import source
from acsard.machine.service_installation import (
    ALL_UNITS,
    COMMAND,
    GATEWAY,
    GROUP,
    INSTALL_COMMANDS,
    KEPT_BY_REMOVAL,
    PACKAGE_UNIT_DIRECTORY,
    PAGE,
    PRIVATE,
    PROGRAM,
    REMOVE_COMMANDS,
    RULES,
    SETPRIV,
    TLS_DIRECTORY,
    UNIT,
    UNIT_DIRECTORY,
    File,
    Keep,
    Remove,
    Run,
    Write,
    admitting,
    files,
    installing,
    linking,
    missing_prerequisite,
    uninstalling,
)
from tests.each import each


def test_a_missing_group_or_program_of_the_units_is_reported_with_a_remedy() -> None:
    assert missing_prerequisite(group="root", program="/usr/bin/env") == ""
    assert "groupadd --system nobodyhome" in missing_prerequisite(
        group="nobodyhome", program="/usr/bin/env"
    )
    assert "install the package util-linux" in missing_prerequisite(program="/nowhere/setpriv")
    unit = (source() / "systemd" / UNIT).read_text()
    assert f"ExecStopPost=+{SETPRIV} " in unit
    assert f"SupplementaryGroups={GROUP}" in unit


@pytest.mark.skipif(
    os.geteuid() != 0 or versions.HOME.exists(), reason="needs root, and no service"
)
@each("words", [("rollback",), ("upgrade", "/nowhere")])
def test_without_a_service_there_is_nothing_to_upgrade(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["service", *words]) == 1
    assert "`acsard service install` installs this version" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become another user")
@each("words", [("install",), ("uninstall",), ("upgrade", "/x"), ("rollback",)])
def test_only_root_may_change_the_service(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    os.seteuid(65534)
    try:
        assert main(["service", *words]) == 77
    finally:
        os.seteuid(0)
    assert "run this command with sudo" in capsys.readouterr().err


@pytest.fixture(name="wanted")
def _wanted(tmp_path: Path) -> list[File]:
    """Return a unit and a first configuration, neither of them written yet."""
    return [File(tmp_path / UNIT, b"unit"), File(tmp_path / "acsard.toml", b"first", kept=True)]


def test_the_daemon_starts_before_the_page_whose_unit_mounts_its_directory() -> None:
    steps = list(INSTALL_COMMANDS)
    everything = Run(("systemctl", "enable", "--now", UNIT, GATEWAY, PAGE))
    alone = Run(("systemctl", "start", UNIT), may_fail=True)
    assert steps.index(alone) < steps.index(everything)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_second_installation_corrects_mode_and_owner_and_keeps_the_configuration(
    wanted: list[File],
) -> None:
    unit, own = wanted
    for file in wanted:
        Write(file).do()
    own.path.write_text("mine")
    unit.path.chmod(0o600)
    os.chown(unit.path, 1, 1)
    _, write, keep, *_ = installing(wanted, force=False)
    assert keep == Keep(own.path)
    write.do()
    status = unit.path.stat()
    assert (status.st_mode & 0o777, status.st_uid, unit.condition()) == (0o644, 0, "as installed")


def test_a_unit_that_was_edited_is_overwritten_only_by_force(wanted: list[File]) -> None:
    unit, own = wanted
    unit.path.write_text("mine")
    with pytest.raises(MendableError, match=f"this version of acsard installs: {unit.path};"):
        installing(wanted, force=False)
    assert installing(wanted, force=True)[1:3] == [Write(unit), Write(own)]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become a user without permission")
def test_a_file_that_cannot_be_read_is_named_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "unit").touch(0o600)
    for path, remedy in ((tmp_path / "unit", "with sudo"), (tmp_path, "Is a directory; check")):
        file = File(path, b"unit")
        os.seteuid(65534 if path.is_file() else 0)
        try:
            assert file.condition() == "unreadable"
            with pytest.raises(MendableError, match=remedy):
                installing([file], force=True)
        finally:
            os.seteuid(0)


@each(("state", "code"), [("active", 0), ("failed", 1)])
def test_the_status_has_the_versions_and_whether_the_daemon_runs(
    state: str, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:  # fmt: skip
    for name in ("0.2.0", "0.3.0"):
        program = tmp_path / name / "bin" / versions.STOP_PROGRAM
        program.parent.mkdir(parents=True, exist_ok=True)
        program.touch()
    versions.use("0.2.0", tmp_path)
    for function in (versions.current, versions.unused):
        monkeypatch.setattr(function, "__defaults__", (tmp_path,))
    systemctl = tmp_path / "systemctl"
    systemctl.write_text(f"#!/bin/sh\necho ActiveState={state}\n")
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert main(["service", "status"]) == code
    out = capsys.readouterr().out
    assert out.startswith("version in use: 0.2.0\nversion 0.3.0 is installed, but not in use\n")
    assert f"{UNIT}:\nActiveState={state}\n" in out


@pytest.mark.parametrize("used", ["0.1.9", version()])
def test_an_installation_beside_another_version_names_the_upgrade_that_can_go_back(
    used: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "current").symlink_to(used)
    monkeypatch.setattr(versions.current, "__defaults__", (tmp_path,))
    monkeypatch.setattr(versions, "HOME", tmp_path)
    monkeypatch.setattr(service_installation, "UNIT_DIRECTORY", tmp_path)
    assert main(["service", "install", "--dry-run"]) == 0
    text = f"the service runs version {used}; to change to this one, type `acsard service upgrade "
    assert (text in capsys.readouterr().err) is (used != version())


@pytest.fixture(name="machine")
def _machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the root of a machine with the installed service, which has been used."""

    def below(path: Path) -> Path:
        return tmp_path / path.relative_to("/")

    kept = {below(path): what for path, what in KEPT_BY_REMOVAL.items()}
    for name, value in {
        "KEPT_BY_REMOVAL": kept, "PRIVATE": tuple(map(below, PRIVATE)), "RULES": below(RULES),
        "UNIT_DIRECTORY": below(UNIT_DIRECTORY), "COMMAND": below(COMMAND),
        "PACKAGE_UNIT_DIRECTORY": below(PACKAGE_UNIT_DIRECTORY),
    }.items():  # fmt: skip
        monkeypatch.setattr(service_installation, name, value)
    monkeypatch.setattr(versions, "HOME", below(versions.HOME))
    for place in [*kept, *service_installation.PRIVATE, versions.HOME]:
        if "lib" not in place.parts or "private" in place.parts:
            place.mkdir(parents=True)
            (place / "file").touch()
    for private in service_installation.PRIVATE:
        private.parents[1].joinpath(private.name).symlink_to(private)
    for file in (below(UNIT_DIRECTORY) / UNIT, below(UNIT_DIRECTORY) / PAGE, below(RULES)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    below(COMMAND).parent.mkdir(parents=True)
    below(COMMAND).symlink_to(PROGRAM)
    return tmp_path


def files_in(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_dir()}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root admits computers to the service")
def test_the_gateway_of_the_service_is_opened_once_and_for_its_own_certificates(
    machine: Path,
) -> None:
    own = Path(TLS_DIRECTORY)
    assert admitting(own) is None, "this service has no gateway"
    (machine / "etc/systemd/system" / GATEWAY).touch()
    assert admitting(Path("/home/me/tls")) is None
    step = admitting(own)
    assert step is not None
    step.do()
    written = machine / "etc/systemd/system" / f"{GATEWAY}.d" / "lan.conf"
    assert written.read_bytes() == (source() / "systemd" / "lan.conf").read_bytes()
    assert admitting(own) is None, "the user may have changed it"


def test_a_step_that_removes_a_directory_says_that_all_in_it_goes(machine: Path) -> None:
    (machine / "link").symlink_to(machine)
    assert str(Remove(machine)) == f"remove  {machine}/ and everything in it"
    assert str(Remove(machine / "link")) == f"remove  {machine / 'link'}"


def test_acsard_gets_into_the_path_unless_there_is_one(machine: Path) -> None:
    assert linking() == []
    command = machine / COMMAND.relative_to("/")
    command.unlink()
    for place in (command.parent, command.parents[1]):
        place.rmdir()
    (step,) = linking()
    step.do()
    assert command.readlink() == PROGRAM


def test_a_removal_says_what_it_leaves_and_a_purge_leaves_nothing(
    machine: Path,
) -> None:
    leaving, *steps = uninstalling(purge=False)
    assert leaving == Run(("systemctl", "disable", "--now", PAGE, UNIT))
    for step in steps:
        if not isinstance(step, Run):
            step.do()
    assert files_in(machine) == {
        "etc/acsard/file", *(f"etc/systemd/system/{unit}.d/file" for unit in ALL_UNITS),
        "var/lib/private/acsard/file", "var/lib/private/acsard-web/file",
    }  # fmt: skip
    kept = [str(step) for step in steps if isinstance(step, Keep)]
    assert len(kept) == len(KEPT_BY_REMOVAL)
    assert all("; --purge removes it" in text for text in kept)
    # The command of another installation stays.
    (machine / COMMAND.relative_to("/")).symlink_to("/usr/bin/another")
    # The units are gone, so nothing is stopped.
    for step in uninstalling(purge=True):
        assert step in REMOVE_COMMANDS or isinstance(step, Remove)
        if isinstance(step, Remove):
            step.do()
    assert files_in(machine) == {str(COMMAND.relative_to("/"))}


def test_the_files_are_those_of_deploy_with_the_port_of_a_real_robot() -> None:
    unit, gateway, page, rules, configuration = files()
    assert rules.path == RULES
    assert rules.content == (source() / "udev" / RULES.name).read_bytes()
    assert (unit.path.name, gateway.path.name, page.path.name) == (UNIT, GATEWAY, PAGE)
    assert b'port = "/dev/acsar"' in configuration.content


def test_force_replaces_each_changed_file_but_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("CONFIG_DIRECTORY", "UNIT_DIRECTORY"):
        monkeypatch.setattr(service_installation, name, tmp_path)
    monkeypatch.setattr(service_installation, "RULES", tmp_path / RULES.name)
    for file in files():
        file.path.write_text("mine")
    steps = installing(files(), force=True)
    kept = [step.path.name for step in steps if isinstance(step, Keep)]
    assert (kept, sum(isinstance(step, Write) for step in steps)) == (["acsard.toml"], 4)


def test_after_a_write_and_a_removal_the_directory_is_unchanged(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("untouched")
    file = File(tmp_path / "acsard" / "tool", b"new", 0o755)
    Write(file).do()
    assert file.current_content() == b"new"
    assert file.path.stat().st_mode & 0o777 == 0o755
    file.path.unlink()
    file.path.symlink_to(tmp_path / "elsewhere")
    assert file.condition() == "changed"
    Write(file).do()
    assert (tmp_path / "elsewhere").read_text() == "untouched"
    Remove(file.path).do()
    assert file.condition() == "missing"


def test_a_failing_command_ends_the_installation_unless_its_failure_is_permitted() -> None:
    words = ("sh", "-c", "echo no >&2; exit 1")
    with pytest.raises(MendableError, match="no"):
        Run(words).do()
    Run(words, may_fail=True).do()
    with pytest.raises(MendableError, match="no such program"):
        Run(("no such program",)).do()


@each("action", ["install", "uninstall"])
def test_the_service_of_the_debian_package_is_left_to_apt(
    action: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / versions.PACKAGE).mkdir(exist_ok=True)
    monkeypatch.setattr(versions, "HOME", tmp_path)
    assert main(["service", action, "--dry-run"]) == 1
    shown = capsys.readouterr()
    assert "`sudo apt remove acsard` removes it" in shown.err
    assert shown.out == ""
