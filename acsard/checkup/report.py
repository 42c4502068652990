"""The result of all findings, as text and as an object for programs."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import advice, lateness
from acsard.checkup.findings import REST, Finding
from acsard.config.writing import excerpt

COLOURS = {"PASS": 32, "WARN": 33, "FAIL": 31, "SKIPPED": 90}


class Report(Struct, frozen=True):
    """A check that has ended.

    `written` is the file that the changes were written to, and `error` a failure that is not about
    the board.
    """

    port: str
    passed: bool
    findings: Sequence[Finding]
    changes: advice.Changes
    toml: str
    written: str | None = None
    error: str | None = None
    withheld: str | None = None
    """Why no finding applies to the configuration file, or None."""


def report(
    port: str,
    findings: Sequence[Finding],
    changes: advice.Changes,
    written: str,
    error: str,
    withheld: str = "",
) -> Report:
    """Return the report of a check.

    A check has passed only if the board answered, every step was reached and judged, and none
    failed.
    """
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
    """Return whether any finding failed."""
    return any(finding.verdict == "FAIL" for finding in findings)


def row(finding: Finding, colours: bool) -> str:
    """Return a finding as text: verdict, name and figure, then its meaning and its remedy."""
    mark = f"{finding.verdict:<7}"
    if colours:
        mark = f"\033[{COLOURS[finding.verdict]}m{mark}\033[0m"
    found = [f"{mark} {finding.name:<22} {finding.figure}".rstrip()]
    for lead, text in (("", finding.text), ("-> ", finding.mend)):
        first, others = " " * 8 + lead, " " * (8 + len(lead))
        found += textwrap.wrap(text, 100, initial_indent=first, subsequent_indent=others)
    return "\n".join(found)


def summary(found: Report, where: str) -> str:
    """Return the number of each verdict and of unjudged findings, and the lines for `where`."""
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
