"""The doctor's findings about this computer: real-time scheduling, and causes of lateness."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from acsard.host import real_time
from acsard.host.kernel_counters import Kernel
from acsard.machine.examination import scheduling, slowness
from tests.unit.host.kernel_files import HWMON, POLICY, QUIET, write

WANTED = True


@pytest.mark.parametrize(
    ("capable", "limit", "level"),
    [(False, 0, "warning"), (False, 9, "warning"), (False, 10, "ok"), (False, -1, "ok"),
     (True, 0, "ok")],
)  # fmt: skip
def test_root_without_the_capability_is_held_to_the_limit(
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
def test_of_a_daemon_that_runs_what_it_has_is_reported(
    policy: int, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: policy)
    (finding,) = scheduling(WANTED, 77)
    assert (finding.level, "pid 77" in finding.text) == (level, True)


def test_who_does_not_want_it_is_not_warned() -> None:
    (finding,) = scheduling(False, 77)
    assert finding.level == "ok"


def test_a_computer_that_nothing_slows_is_ok(tmp_path: Path) -> None:
    (finding,) = slowness(Kernel(write(tmp_path, QUIET)))
    assert (finding.subject, finding.level) == ("computer", "ok")


def test_each_cause_of_lateness_that_is_present_is_a_warning_with_its_mend(tmp_path: Path) -> None:
    files = {HWMON + "in0_lcrit_alarm": "1\n", POLICY + "scaling_governor": "powersave\n"}
    findings = list(slowness(Kernel(write(tmp_path, QUIET | files))))
    assert [one.level for one in findings] == ["warning", "warning"]
    assert "supply voltage is too low" in findings[0].text
    assert "power supply" in findings[0].mend
    assert "powersave keeps the processor at 600 of 1500 MHz" in findings[1].text
    assert "schedutil" in findings[1].mend
