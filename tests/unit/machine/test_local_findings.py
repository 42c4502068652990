"""The doctor's findings about this computer: the port, real time, and causes of lateness."""

from __future__ import annotations

import os
import pty
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from acsard.host import real_time
from acsard.host.kernel_counters import Kernel
from acsard.machine import versions
from acsard.machine.local_findings import scheduling, serial_port, slowness, unused_version
from tests.unit.host.kernel_files import HWMON, POLICY, QUIET, write

WANTED = True


@pytest.mark.parametrize(
    ("capable", "limit", "level"),
    [(False, 0, "warning"), (False, 9, "warning"), (False, 10, "ok"), (False, -1, "ok"),
     (True, 0, "ok")],
)  # fmt: skip
def test_root_without_the_capability_needs_a_real_time_limit(
    capable: bool, limit: int, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    monkeypatch.setattr(real_time, "_capable", lambda _: capable)
    (finding,) = scheduling(WANTED, None)
    assert finding.level == level
    assert bool(finding.mend) == (level == "warning")


@pytest.mark.parametrize(
    ("policy", "level"),
    [(os.SCHED_OTHER, "warning"), (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, "ok")],
)
def test_the_scheduling_policy_of_a_running_daemon_is_reported(
    policy: int, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: policy)
    (finding,) = scheduling(WANTED, 77)
    assert (finding.level, "pid 77" in finding.text) == (level, True)


# A person's own simulator of their board often keeps both ends of its pty open.
OWN_BOARD = """
import os, pty, sys
board, port = pty.openpty()
print(os.ttyname(port), flush=True)
sys.stdin.read()
"""


def test_the_simulator_of_a_person_s_own_board_is_not_to_be_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OWN_BOARD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as board:
        assert board.stdout is not None
        findings = list(serial_port(board.stdout.readline().strip(), simulated=False))
        assert board.stdin is not None
        board.stdin.close()
    (used,) = [finding for finding in findings if f"(pid {board.pid})" in finding.text]
    assert (used.level, used.mend) == ("ok", "")
    assert "simulates the board" in used.text


def test_a_program_that_uses_the_port_in_place_of_the_daemon_is_a_failure() -> None:
    board, port = pty.openpty()
    path = os.ttyname(port)
    opened = f"os.open({path!r}, os.O_RDWR | os.O_NOCTTY)"
    code = f"import os, sys; {opened}; print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        findings = list(serial_port(path, simulated=False))
        assert other.stdin is not None
        other.stdin.close()
    for end in (board, port):
        os.close(end)
    (used,) = [finding for finding in findings if f"(pid {other.pid})" in finding.text]
    assert (used.level, f"kill {other.pid}" in used.mend) == ("failure", True)


def test_without_real_time_in_the_configuration_no_warning_is_given() -> None:
    (finding,) = scheduling(False, 77)
    assert finding.level == "ok"


def test_a_computer_without_causes_of_lateness_is_ok(tmp_path: Path) -> None:
    (finding,) = slowness(Kernel(write(tmp_path, QUIET)))
    assert (finding.subject, finding.level) == ("computer", "ok")


def test_each_present_cause_of_lateness_is_a_warning_with_a_remedy(tmp_path: Path) -> None:
    files = {HWMON + "in0_lcrit_alarm": "1\n", POLICY + "scaling_governor": "powersave\n"}
    findings = list(slowness(Kernel(write(tmp_path, QUIET | files))))
    assert [finding.level for finding in findings] == ["warning", "warning"]
    assert "supply voltage is too low" in findings[0].text
    assert "power supply" in findings[0].mend
    assert "powersave keeps the processor at 600 of 1500 MHz" in findings[1].text
    assert "schedutil" in findings[1].mend


def test_a_newer_version_that_is_not_in_use_is_a_warning_with_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert list(unused_version()) == []
    monkeypatch.setattr(versions, "unused", lambda: "0.3.0")
    (finding,) = unused_version()
    assert finding.level == "warning"
    assert "`sudo acsard service upgrade /opt/acsard/0.3.0`" in finding.mend
