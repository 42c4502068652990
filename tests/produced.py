"""The codes that the product itself found while the tests ran.

`SEEN` gets each code that a robot's step, the doctor, the check of a board or a message's builder
returned, whatever its input was. So a code counts if the product's code chose it once. That proves
neither that the input can occur, because a test may build a `Snapshot` by hand, nor that a test
expects the code. A test that constructs a finding itself does not count.

After a usual run of all tests that only compute, a code of the tables that nothing found fails the
run, and so does a code of `SLOW` or `ELSEWHERE` that was found.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import pytest

from acsard.bus import tls_trouble
from acsard.checkup import outcomes, procedure
from acsard.checkup.outcomes import OUTCOMES_BY_CODE
from acsard.core import summary
from acsard.core.codes import CODES
from acsard.core.messages import certificate_expiry, diagnostics
from acsard.core.robot import Robot
from acsard.core.values import Heard, Instant, News
from acsard.machine import certificate_findings, examination, local_findings

SEEN: set[str] = set()

# Only slow and nightly tests make the product find these, most of them those of `acsard mcu check`.
SLOW = {
    "gyro_dead", "lost_lines_silent", "motor_dead_turns", "motor_other_motor",
    "motor_reversed_encoder", "motor_reversed_motor", "port_trouble", "replies_echo",
    "tls_handshake_hangs",
}  # fmt: skip

# No test of `tests/unit` and `tests/scenarios` is known to make the product find these. Real
# processes, or tests of one function below the wrapped ones do. A new code is not for this list.
ELSEWHERE = {
    "certificates_unreadable", "daemon_elsewhere", "emergency_stop_released", "guard_no_checksum",
    "guard_no_command", "guard_no_link", "guard_too_long", "gyro_in_degrees", "gyro_not_believed",
    "gyro_reversed", "lines_too_rare", "link_stops_at_zeros", "no_emergency_stop", "other_version",
    "port_slow", "recording_fails", "stopped_by_others", "too_many_clocks", "unknown_format",
}  # fmt: skip

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
    for event in news.events:
        SEEN.add(event.code)
    for cause in self.latches.causes:
        SEEN.add(cause.code)
    return news


def _check(
    wire: Any,
    operator: Any,
    config: Any,
    tell: Any,
    *more: Any,
    run: Any = procedure.run,
    **how: Any,
) -> None:
    def told(finding: Any) -> None:
        SEEN.add(finding.code)
        tell(finding)

    run(wire, operator, config, told, *more, **how)


def install() -> None:
    """Let the product report its codes."""
    Robot.hear = _hear  # type: ignore[method-assign]
    procedure.run = _check
    for module, name in (
        (outcomes, "find"),
        (tls_trouble, "reason"),
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
    """Fail a usual run of all tests of a change (`CI`) after which a list of codes is wrong.

    Elsewhere it is only printed: a test that is skipped there may be the one that finds a code.
    """
    if (worker := getattr(session.config, "workeroutput", None)) is not None:
        worker["codes"] = sorted(SEEN)
        return
    known, exempt = {*CODES, *OUTCOMES_BY_CODE}, SLOW | ELSEWHERE
    missing, stale = known - SEEN - exempt, exempt & SEEN | exempt - known
    options = session.config.option
    usual = options.markexpr.startswith("not (slow ") and not options.keyword
    if not usual or session.testscollected < LEAST or not missing | stale:
        return
    for problem, codes in (
        ("no test made the product find these codes", missing),
        ("remove from SLOW or ELSEWHERE: a usual test finds them, or no table has them", stale),
    ):
        if codes:
            print(f"\n{problem}: {sorted(codes)}")
    if os.environ.get("CI"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
