"""What the findings are together, as lines for people and as one object for programs."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import advice, lateness
from acsard.checkup.findings import REST, Finding
from acsard.config.writing import excerpt

COLOURS = {"PASS": 32, "WARN": 33, "FAIL": 31, "SKIPPED": 90}


class Report(Struct, frozen=True):
    """A check that has ended; `written` is the file that has the changes, `error` what went wrong
    besides the board."""

    port: str
    passed: bool
    findings: Sequence[Finding]
    changes: advice.Changes
    toml: str
    written: str | None = None
    error: str | None = None
    withheld: str | None = None
    """Why there is nothing for the file, whatever was found."""


def report(
    port: str,
    findings: Sequence[Finding],
    changes: advice.Changes,
    written: str,
    error: str,
    withheld: str = "",
) -> Report:
    """Put together; a board that never answered has not passed, nor one that was not looked at
    to the end, or while this computer was late."""
    ended = not any(finding.name == REST for finding in findings)
    judged = ended and not lateness.unjudged(findings)
    passed = advice.answered(findings) and judged and not failed(findings)
    toml = "\n".join(excerpt(changes))
    return Report(
        port,
        passed,
        findings,
        changes,
        toml,
        written or None,
        error or None,
        withheld or None,
    )


def failed(findings: Sequence[Finding]) -> bool:
    """Something did."""
    return any(finding.verdict == "FAIL" for finding in findings)


def row(finding: Finding, colours: bool) -> str:
    """A finding for people: verdict, name and figure, then what it means and the mend."""
    mark = f"{finding.verdict:<7}"
    if colours:
        mark = f"\033[{COLOURS[finding.verdict]}m{mark}\033[0m"
    found = [f"{mark} {finding.name:<22} {finding.figure}".rstrip()]
    for lead, text in (("", finding.text), ("-> ", finding.mend)):
        first, others = " " * 8 + lead, " " * (8 + len(lead))
        found += textwrap.wrap(text, 100, initial_indent=first, subsequent_indent=others)
    return "\n".join(found)


def summary(found: Report, where: str) -> str:
    """How many of each verdict, how many were not judged, and the lines for `where`."""
    verdicts = [finding.verdict for finding in found.findings]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in COLOURS if v in verdicts)
    if late := lateness.unjudged(found.findings):
        again = "so it has not passed: try again when this computer is free"
        counts += f"\n{len(late)} not judged, {again}"
    if found.withheld:
        return f"\n{counts}\nnothing is for {where}: {found.withheld}"
    if not found.toml:
        return f"\n{counts}\nacsard.toml: nothing to change"
    head = f"{where}: written" if found.written else "for acsard.toml:"
    return f"\n{counts}\n\n{head}\n{found.toml}"
