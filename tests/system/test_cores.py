"""A failed test counts only if a core was idle during it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.system import cores
from tests.system.cores import Idle, cores_were_busy, idle, idle_class
from tests.system.harness import Program


def test_a_failure_counts_if_a_core_was_idle_for_a_while() -> None:
    cores = os.cpu_count() or 1
    assert cores_were_busy(Idle(100.0, 7.0), Idle(110.0, 7.0))
    assert cores_were_busy(Idle(100.0, 7.0), Idle(110.0, 7.0 + 0.2 * cores))
    assert not cores_were_busy(Idle(100.0, 7.0), Idle(110.0, 7.0 + 0.4 * cores))


def test_the_idle_time_grows_and_is_at_most_the_uptime_of_all_cores() -> None:
    first = idle()
    assert 0.0 <= first.idle_s <= first.at * (os.cpu_count() or 1) * 1.1
    assert idle() >= first


IN_THE_IDLE_CLASS = """\
import os, time
while time.process_time() < 0.3:
    pass
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
print("idle", flush=True)
time.sleep(60)
"""
"""It computes in the normal class, because a busy machine gives the idle class hardly any time."""


def test_the_time_of_a_program_in_the_idle_class_is_counted(tmp_path: Path) -> None:
    before = idle_class()
    with Program([sys.executable, "-S", "-c", IN_THE_IDLE_CLASS], tmp_path) as program:
        program.says("idle")
        assert idle_class() - before >= 0.25


def test_the_time_of_the_idle_class_counts_as_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "idle_class", lambda: 1e9)
    assert idle().idle_s >= 1e9
