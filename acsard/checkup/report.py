"""The result of all findings, as text and as an object for programs."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct
from rich.table import Table
from rich.text import Text

from acsard.checkup import advice, lateness
from acsard.checkup.findings import REST, Finding
from acsard.config.writing import excerpt
from acsard.terminal.tables import table

COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red", "SKIPPED": "bright_black"}


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


def row(finding: Finding) -> Table:
    """Return the verdict with name and figure, then the meaning and the remedy."""
    verdict = Text(f"{finding.verdict:<7}", COLOURS[finding.verdict])
    below = [finding.text, f"-> {finding.mend}" if finding.mend else ""]
    head = f"{finding.name:<22} {finding.figure}"
    return table([(verdict, head), *(("", text) for text in below if text)], gap=1)


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
