"""Tests of the service's files and installation steps, and of where acsard may be installed."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.host.errors import MendableError
from acsard.machine import service_installation
from acsard.machine.deploy_files import source
from acsard.machine.service_installation import (
    GATEWAY,
    GROUP,
    INSTALL_COMMANDS,
    PAGE,
    REMOVE_COMMANDS,
    SETPRIV,
    STATE_DIRECTORIES,
    UNIT,
    File,
    Found,
    InstallCopy,
    Keep,
    Remove,
    Run,
    Write,
    admitted,
    files,
    foreign_entries,
    installing,
    missing_prerequisite,
    present,
    uninstalling,
    wrong_modes,
)

PROGRAM = "/usr/bin/env"
"""A program that every user may run."""


def test_a_missing_group_or_program_of_the_units_is_reported_with_a_remedy() -> None:
    assert missing_prerequisite(group="root", program=PROGRAM) == ""
    assert "groupadd --system nobodyhome" in missing_prerequisite(
        group="nobodyhome", program=PROGRAM
    )
    assert "install the package util-linux" in missing_prerequisite(program="/nowhere/setpriv")
    unit = (source() / "systemd" / UNIT).read_text()
    assert f"ExecStopPost=+{SETPRIV} " in unit
    assert f"SupplementaryGroups={GROUP}" in unit


ETC = Path("/etc/x")
UNIT_FILE = File(ETC / UNIT, b"unit")
STOP_FILE = File(ETC / "stop", b"stop", 0o755)
RULES = File(ETC / "rules", b"rules")
OWN = File(ETC / "acsard.toml", b"first", kept=True)
GATEWAY_FILE = File(ETC / GATEWAY, b"gateway")
PAGE_FILE = File(ETC / PAGE, b"page")
ALL = [UNIT_FILE, GATEWAY_FILE, PAGE_FILE, STOP_FILE, RULES, OWN]


def installed_files(**other: bytes | None) -> Found:
    """Return a machine with all files installed. `other` replaces the content of some files."""
    names = {
        "unit": UNIT_FILE,
        "gateway": GATEWAY_FILE,
        "page": PAGE_FILE,
        "stop": STOP_FILE,
        "rules": RULES,
        "own": OWN,
    }
    changes = {names[name].path: content for name, content in other.items()}
    return {file.path: file.content for file in ALL} | changes


NOTHING: Found = {file.path: None for file in ALL}


def test_a_first_installation_writes_all_files_and_then_runs_the_commands() -> None:
    assert installing(ALL, NOTHING, (), force=False) == [
        InstallCopy(),
        *map(Write, ALL),
        *INSTALL_COMMANDS,
    ]


def test_the_daemon_starts_before_the_page_whose_unit_mounts_its_directory() -> None:
    steps = list(INSTALL_COMMANDS)
    everything = Run(("systemctl", "enable", "--now", UNIT, GATEWAY, PAGE))
    alone = Run(("systemctl", "start", UNIT), may_fail=True)
    assert steps.index(alone) < steps.index(everything)


def test_unchanged_files_are_kept_and_the_commands_run_again() -> None:
    assert installing(ALL, installed_files(), (), force=False) == [
        InstallCopy(),
        *(Keep(f.path) for f in ALL),
        *INSTALL_COMMANDS,
    ]


def test_a_file_with_a_wrong_mode_is_written_again_unless_its_content_differs() -> None:
    # Without its mode the stop script sends no zeros after the daemon's end.
    steps = installing(ALL, installed_files(), {STOP_FILE.path, OWN.path}, force=False)
    (step,) = (step for step in steps if isinstance(step, Write))
    assert step.file == STOP_FILE
    assert str(step).endswith("(4 bytes, mode 755; it has a wrong mode or owner)")
    with pytest.raises(MendableError, match="differ"):
        installing(ALL, installed_files(stop=b"mine"), {STOP_FILE.path}, force=False)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize(
    "spoil", [lambda path: path.chmod(0o644), lambda path: os.chown(path, 1, 1)]
)
def test_a_wrong_mode_or_owner_is_detected_and_corrected(
    tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    file = File(tmp_path / "stop", b"stop", 0o755)
    assert wrong_modes([file]) == set()
    Write(file).do()
    assert (wrong_modes([file]), file.condition()) == (set(), "as installed")
    spoil(file.path)
    assert (wrong_modes([file]), file.condition()) == ({file.path}, "wrong mode or owner")
    Write(file).do()
    assert (wrong_modes([file]), file.condition()) == (set(), "as installed")
    file.path.rename(tmp_path / "elsewhere")
    file.path.symlink_to(tmp_path / "elsewhere")
    spoil(file.path)
    assert wrong_modes([file]) == set()
    assert wrong_modes([File(tmp_path / "elsewhere", b"stop", 0o755)])


def test_a_file_with_other_content_is_overwritten_only_by_force() -> None:
    state = installed_files(unit=b"mine", own=None)
    with pytest.raises(MendableError, match=f"this version of acsard installs: {UNIT_FILE.path};"):
        installing(ALL, state, (), force=False)
    steps = installing(ALL, state, (), force=True)
    assert [step for step in steps if isinstance(step, Write)] == [Write(UNIT_FILE), Write(OWN)]


@pytest.mark.parametrize("force", [False, True])
def test_an_edited_configuration_is_never_replaced(force: bool) -> None:
    assert Keep(OWN.path) in installing(ALL, installed_files(own=b"mine"), (), force=force)


def test_all_unchanged_files_are_removed() -> None:
    removed = [Remove(file.path) for file in ALL]
    leaving = Run(("systemctl", "disable", "--now", PAGE, GATEWAY, UNIT))
    assert uninstalling(ALL, installed_files(), (), force=False) == [
        leaving,
        *removed,
        *REMOVE_COMMANDS,
    ]


def test_a_missing_unit_is_not_disabled() -> None:
    """The machine has an older version, which had no units for the TLS gateway and the page."""
    leaving, *_ = uninstalling(ALL, installed_files(gateway=None, page=None), force=False)
    assert leaving == Run(("systemctl", "disable", "--now", UNIT))


def test_without_installed_files_no_unit_is_stopped_and_no_file_is_removed() -> None:
    assert uninstalling(ALL, NOTHING, (), force=False) == [*REMOVE_COMMANDS]


def kept_paths(state: Found, *, force: bool) -> set[Path]:
    steps = uninstalling(ALL, state, (), force=force)
    return {step.path for step in steps if isinstance(step, Keep)}


def test_a_changed_file_is_kept_unless_forced() -> None:
    assert kept_paths(installed_files(rules=b"mine"), force=False) == {RULES.path}
    assert kept_paths(installed_files(rules=b"mine"), force=True) == set()


def test_a_changed_configuration_is_kept_even_if_forced() -> None:
    assert kept_paths(installed_files(own=b"mine"), force=True) == {OWN.path}


def test_a_unit_that_is_kept_also_keeps_its_program() -> None:
    program = Path("/opt/acsard/1.0.0")
    for unit, stays in ((b"mine", True), (UNIT_FILE.content, False)):
        state = installed_files(unit=unit)
        steps = uninstalling(ALL, state, (), force=False, programs=[program])
        assert (Remove(program) in steps) is not stays
        why = [step.why for step in steps if isinstance(step, Keep) and step.path == program]
        assert why == ([f"{UNIT} stays and needs this directory"] if stays else [])


def test_the_files_are_those_of_deploy_with_the_port_of_a_real_robot() -> None:
    unit, gateway, page, _, configuration = files()
    assert (unit.path.name, gateway.path.name, page.path.name) == (UNIT, GATEWAY, PAGE)
    assert b'port = "/dev/acsar"' in configuration.content
    assert set(present([unit])) == {unit.path}


def test_an_installation_never_selects_the_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = tmp_path / "acsard.toml"
    changed.write_text("[mcu]\nport='sim'\n")
    monkeypatch.setattr(service_installation, "reference", lambda deploy: changed)
    with pytest.raises(AssertionError):
        files()


def test_each_kept_path_is_reported_with_its_reason_and_how_to_remove_it() -> None:
    tls, own = Path("/etc/acsard/tls"), ETC / "own.conf"
    state = installed_files(unit=b"mine", own=b"mine")
    steps = uninstalling(ALL, state, [tls, own], force=False)
    assert {step.path: step.why for step in steps if isinstance(step, Keep)} == {
        UNIT_FILE.path: "the file differs from what this version installs; --force removes it",
        OWN.path: "it is your configuration; --purge removes it",
        tls: "certificates and their authority; --purge removes it",
        own: "not a file of the service; --purge removes it",
    }


def test_a_forced_purge_keeps_no_file() -> None:
    tls, state = Path("/etc/acsard/tls"), installed_files(unit=b"mine", own=b"mine")
    steps = uninstalling(ALL, state, [tls], force=True, purge=True)
    assert not [step for step in steps if isinstance(step, Keep)]
    assert {step.path for step in steps if isinstance(step, (Remove, Remove))} == {
        *(file.path for file in ALL),
        tls,
    }


def test_a_purge_reinstalls_a_unit_so_that_systemd_can_clean_its_state() -> None:
    steps = uninstalling(
        ALL, dict.fromkeys(installed_files()), force=True, purge=True, stateful=[UNIT]
    )
    clean = Run(("systemctl", "clean", "--what=state", UNIT))
    before, after = steps[: steps.index(clean)], steps[steps.index(clean) :]
    assert before[:2] == [Write(UNIT_FILE), Run(("systemctl", "daemon-reload"))]
    assert Remove(UNIT_FILE.path) in after


@pytest.mark.parametrize("purge", [False, True])
def test_recordings_and_invitations_are_kept_unless_purged(purge: bool) -> None:
    steps = uninstalling(
        ALL, installed_files(), (), force=False, purge=purge, stateful=STATE_DIRECTORIES
    )
    paths = {step.path for step in steps if isinstance(step, Keep)}
    cleans = {Run(("systemctl", "clean", "--what=state", unit)) for unit in (UNIT, PAGE)}
    assert paths == (set() if purge else {where for where, _ in STATE_DIRECTORIES.values()})
    assert cleans & {*steps} == (cleans if purge else set())
    if purge:  # the units have stopped, but systemd still knows them
        assert {*steps[1:3]} == cleans


def test_other_files_in_the_directories_of_the_service_are_found(tmp_path: Path) -> None:
    (tmp_path / "tls").mkdir()
    (tmp_path / "acsard.toml").touch()
    ours = File(tmp_path / "acsard.toml", b"", kept=True)
    assert foreign_entries([ours], [tmp_path, tmp_path / "missing"]) == [tmp_path / "tls"]


DROP_IN = File(
    ETC / "lan.conf",
    b"IPAddressAllow=10.0.0.0/8\nLoadCredential=key.pem:/a/b/key.pem\n"
    b"ExecReload=+/bin/sh -c 'cd \"/a/b\" && install key.pem %t/%N'\n",
)


def test_the_drop_in_of_the_gateway_has_the_directory_of_the_certificates() -> None:
    step = admitted(DROP_IN, None, Path("/srv/tls"))
    assert isinstance(step, Write)
    assert b"LoadCredential=key.pem:/srv/tls/key.pem\n" in step.file.content
    assert b"'cd \"/srv/tls\" && install key.pem %t/%N'\n" in step.file.content


def test_networks_that_the_user_has_restricted_are_kept() -> None:
    own = b"IPAddressAllow=10.1.2.0/24\nLoadCredential=key.pem:/srv/tls/key.pem\n"
    assert isinstance(admitted(DROP_IN, own, Path("/srv/tls")), Keep)
    moved = admitted(DROP_IN, own, Path("/etc/tls"))
    assert isinstance(moved, Write)
    assert moved.file.content == own.replace(b"/srv/tls", b"/etc/tls")


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
    assert [path.name for path in tmp_path.iterdir()] == ["elsewhere"]


def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path) -> None:
    # A part of the configuration would be kept as the user's own. An empty one is the simulator.
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            Write(File(tmp_path / "acsard.toml", bytes(20_000), kept=True)).do()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_a_directory_with_other_files_is_not_removed(tmp_path: Path) -> None:
    file = File(tmp_path / "bin" / "tool", b"new")
    Write(file).do()
    (tmp_path / "bin" / "other").touch()
    Remove(file.path).do()
    assert [path.name for path in (tmp_path / "bin").iterdir()] == ["other"]


@pytest.mark.parametrize("words", [("false",), ("sh", "-c", "kill -9 $$")])
def test_a_command_that_fails_without_a_message_ends_the_installation(
    words: tuple[str, ...],
) -> None:
    with pytest.raises(MendableError, match=words[0]):
        Run(words).do()


def test_a_failing_command_ends_the_installation_unless_its_failure_is_permitted() -> None:
    words = ("sh", "-c", "echo no >&2; exit 1")
    with pytest.raises(MendableError, match="no"):
        Run(words).do()
    Run(words, may_fail=True).do()
    with pytest.raises(MendableError, match="no such program"):
        Run(("no such program",)).do()


def test_removing_a_directory_also_removes_its_empty_parent_of_the_service(tmp_path: Path) -> None:
    place = tmp_path / "acsard" / "tls"
    (place / "clients").mkdir(parents=True)
    (place / "clients" / "key.pem").touch()
    Remove(place).do()
    assert not list(tmp_path.iterdir())


def test_an_unreadable_file_is_reported_in_a_sentence(tmp_path: Path) -> None:
    place = File(tmp_path / "acsard.toml", b"")
    place.path.mkdir()
    assert place.condition() == "unreadable"
    with pytest.raises(MendableError, match=r"cannot read .*acsard\.toml"):
        place.current_content()
