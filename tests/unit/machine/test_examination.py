"""The doctor's finding about real-time scheduling matches the scheduling that a daemon gets."""

from __future__ import annotations

import os
import resource

import pytest

from acsard.host import real_time
from acsard.machine.examination import scheduling

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
