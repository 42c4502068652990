"""What is printed of the findings."""

from __future__ import annotations

from acsard.checkup.findings import Finding
from acsard.checkup.report import report, row, summary

RATE = Finding("baud rate", "PASS", keys={"mcu.baud_rate": 57600})


def test_a_row_has_the_verdict_what_it_means_and_the_mend() -> None:
    finding = Finding("watchdog", "FAIL", "none", "it drives on " * 20, "give it one")
    head, *rest = row(finding, colours=False).splitlines()
    assert head == "FAIL    watchdog               none"
    assert all(line.startswith("        ") and len(line) <= 100 for line in rest)
    assert rest[-1] == "        -> give it one"
    assert "\033[31m" in row(finding, colours=True)


def test_a_board_passes_that_answered_and_failed_in_nothing() -> None:
    late = Finding("watchdog", "FAIL")
    assert report("sim", [RATE], {}, "", "").passed
    assert not report("sim", [RATE, late], {}, "", "").passed
    assert not report("sim", [], {}, "", "no such port").passed


def test_the_end_counts_the_verdicts_and_has_the_lines_of_toml() -> None:
    found = report("sim", [RATE, Finding("watchdog", "FAIL")], {"mcu.baud_rate": 57600}, "", "")
    told = "\n1 PASS, 1 FAIL\n\nfor acsard.toml:\n[mcu]\nbaud_rate = 57600"
    assert summary(found, "acsard.toml") == told
    assert "nothing to change" in summary(report("sim", [RATE], {}, "", ""), "acsard.toml")
