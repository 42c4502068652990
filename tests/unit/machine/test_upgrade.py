"""Tests of when a robot stands, and of when a new version is worse than the one before it."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from acsard.bus.address import Address
from acsard.host.errors import MendableError
from acsard.machine import upgrade, versions
from acsard.machine.upgrade import Look, UnitState, configuration_file, prepare, worse
from tests.unit.screens import STATE


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


@pytest.mark.parametrize(
    ("state", "runs"),
    [("active", True), ("activating", True), ("inactive", False), ("failed", False)],
)
def test_a_unit_that_is_restarted_again_and_again_counts_as_running(state: str, runs: bool) -> None:
    assert UnitState(state, 0, 0).runs is runs


def test_the_configuration_file_is_the_one_that_the_daemon_s_environment_names() -> None:
    assert configuration_file(0) == Path("/etc/acsard/acsard.toml")
    environment = os.environ | {"ACSARD_CONFIG": "/srv/robot.toml"}
    # The kernel may show a process without its environment until its first line.
    words = [sys.executable, "-c", "print(flush=True); input()"]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, env=environment, stdin=pipe, stdout=pipe) as daemon:
        assert daemon.stdout is not None
        daemon.stdout.readline()
        assert configuration_file(daemon.pid) == Path("/srv/robot.toml")
        daemon.communicate(b"\n", 10.0)


def test_only_a_package_or_an_environment_is_a_new_version(tmp_path: Path) -> None:
    with pytest.raises(MendableError, match=r"neither a \.deb nor an environment"):
        prepare(tmp_path)
    (tmp_path / "x.deb").write_text("no package")
    with pytest.raises(MendableError, match="dpkg-deb"):
        prepare(tmp_path / "x.deb")


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
    monkeypatch.setattr(upgrade, "configuration_file", lambda pid: Path("/nonexistent"))
    monkeypatch.setattr(upgrade, "_start", start)
    with pytest.raises(MendableError, match=rf"1\.1\.0 cannot be started .*No space.*{after}"):
        upgrade.change("1.1.0", print)
    assert used == ["1.0.0", "1.1.0", "0.9.0", "1.0.0"]
    assert started == ["1.1.0", "1.0.0"]


def test_a_version_under_which_systemd_does_not_answer_does_not_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def silent(unit: str) -> UnitState:
        raise MendableError("systemctl show: timed out")

    monkeypatch.setattr(upgrade, "unit_state", silent)
    assert "timed out" in upgrade.watch(Address("tcp/127.0.0.1:1", "r", ""), None, ["x"], 0.0)
