"""Tests of the printed findings."""

from __future__ import annotations

import pytest

from acsard.checkup import lateness
from acsard.checkup.findings import REST, Finding
from acsard.checkup.report import report, row, summary
from acsard.terminal.output import plain

RATE = Finding("baud rate", "PASS", keys={"mcu.baud_rate": 57600})


def test_a_row_has_the_verdict_what_it_means_and_the_mend() -> None:
    finding = Finding("watchdog", "FAIL", "none", "it drives on " * 20, "give it one")
    head, *rest = plain(row(finding), width=100).splitlines()
    assert head == "FAIL    watchdog               none"
    assert all(line.startswith(" " * 8) for line in rest)
    assert rest[-1] == "        -> give it one"


def test_a_board_passes_that_answered_and_failed_in_nothing() -> None:
    late = Finding("watchdog", "FAIL")
    assert report("sim", [RATE], {}, "", "").passed
    assert not report("sim", [RATE, late], {}, "", "").passed
    assert not report("sim", [], {}, "", "no such port").passed


@pytest.mark.parametrize(
    ("more", "passed"),
    [
        ([lateness.finding("watchdog", 0.08)], False),
        ([Finding(REST, "SKIPPED", "2 steps", "the check ended early: link")], False),
        ([lateness.finding("trailing comma", 0.08), Finding("trailing comma", "PASS")], True),
        ([Finding("round trip", "SKIPPED")], True),
    ],
)
def test_what_was_not_judged_or_not_tried_has_not_passed(more: list[Finding], passed: bool) -> None:
    assert report("sim", [RATE, *more], {}, "", "").passed is passed


def test_the_end_says_how_many_were_not_judged_and_what_to_do() -> None:
    late = [lateness.finding(name, 0.08) for name in ("watchdog", "lost lines")]
    told = summary(report("sim", [RATE, *late], {}, "", ""), "acsard.toml").splitlines()
    assert told[1:3] == [
        "1 PASS, 2 WARN",
        "2 not judged, so it has not passed: try again when this computer is free",
    ]


def test_the_end_counts_the_verdicts_and_has_the_lines_of_toml() -> None:
    found = report("sim", [RATE, Finding("watchdog", "FAIL")], {"mcu.baud_rate": 57600}, "", "")
    told = "\n1 PASS, 1 FAIL\n\nfor acsard.toml:\n[mcu]\nbaud_rate = 57600"
    assert summary(found, "acsard.toml") == told
    assert "nothing to change" in summary(report("sim", [RATE], {}, "", ""), "acsard.toml")
