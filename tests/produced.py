"""The codes that tests produce by bytes, files and messages, not by constructing them.

A robot that hears bytes and messages, a world of scenarios, the doctor and the check of a board
report the codes that they find to `SEEN`. After a run of all tests of `tests/unit` and
`tests/scenarios`, a code of the tables that nothing produced fails the run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest

from acsard.checkup import outcomes
from acsard.checkup.outcomes import OUTCOMES_BY_CODE
from acsard.core import summary
from acsard.core.codes import CODES
from acsard.core.messages import certificate_expiry, diagnostics
from acsard.core.robot import Robot
from acsard.core.values import Heard, Instant, News
from acsard.machine import certificate_findings, examination, local_findings

SEEN: set[str] = set()

# No run of tests/unit and tests/scenarios produces them: a computer, a bus or a device does.
ELSEWHERE = {
    "nothing",
}

LEAST = 2000  # collected tests of a run of all


def _of_product() -> bool:
    return str(sys._getframe(2).f_globals["__name__"]).startswith("acsard.")


def _recorded(function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapper(*args: Any, **values: Any) -> Any:
        result = function(*args, **values)
        if _of_product():
            SEEN.add(result.code)
        return result

    return wrapper


def _hear(self: Robot, now: Instant, heard: Heard, hear: Callable[..., News] = Robot.hear) -> News:
    news = hear(self, now, heard)
    SEEN.add(self.status.code)
    SEEN.update(event.code for event in news.events)
    SEEN.update(cause.code for cause in self.latches.causes)
    return news


def install() -> None:
    """Let the product report its codes."""
    Robot.hear = _hear  # type: ignore[method-assign]
    for module, name in (
        (outcomes, "find"),
        (summary, "waiting"),
        (diagnostics, "reason"),
        (certificate_expiry, "reason"),
        (certificate_findings, "finding"),
        (certificate_findings, "about"),
        (examination, "finding"),
        (examination, "about"),
        (local_findings, "finding"),
        (local_findings, "about"),
    ):
        setattr(module, name, _recorded(getattr(module, name)))


install()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the codes of a test process."""
    SEEN.update(getattr(node, "workeroutput", {}).get("codes", ()))


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run of all tests in which no test produced a code of the tables."""
    if (worker := getattr(session.config, "workeroutput", None)) is not None:
        worker["codes"] = sorted(SEEN)
        return
    missing = {*CODES, *OUTCOMES_BY_CODE} - SEEN - ELSEWHERE
    if session.testscollected >= LEAST and missing:
        print(f"\nno test produced these codes by bytes, files or messages: {sorted(missing)}")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
