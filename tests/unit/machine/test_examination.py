"""The doctor's findings about this computer: real-time scheduling, and causes of lateness."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from acsard.host import real_time
from acsard.host.kernel_counters import Kernel
from acsard.machine import versions
from acsard.machine.examination import scheduling, slowness, unused_version
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
