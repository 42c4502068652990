"""Makes the report of the check, as an object and as text, and suggests configuration values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import attrgetter, getitem
from typing import Any, get_args

from msgspec import Struct, ValidationError

from acsard.checkup import lateness
from acsard.checkup.findings import SKIPPED_STEPS, Finding, Verdict
from acsard.core.config.contradictions import contradictions
from acsard.core.config.parsing import effective, from_builtins
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import excerpt

# Maps dotted keys of the configuration, such as "mcu.port", to new values.
Changes = dict[str, object]

# They make lines longer, so `changes` leaves them out, one after the other, on a slow wire.
OPTIONAL_KEYS = ("mcu.encoder_counts", "mcu.link_check")


def answered(findings: Iterable[Finding]) -> bool:
    """Return whether a board answered the check, so that its baud rate is known."""
    return any(finding.name == "baud rate" and finding.keys for finding in findings)


def changes(findings: Sequence[Finding], config: Config, port: str = "") -> Changes:
    """Return the suggested values that differ from the configuration `config`.

    `port` is the suggestion for `mcu.port` if a board answered. If the suggestions contradict each
    other, for example because lines with a checksum are too long for the control rate, those for
    `OPTIONAL_KEYS` are left out, or `control.rate` becomes "auto".
    """
    wanted: Changes = {"mcu.port": port} if port and answered(findings) else {}
    for finding in findings:
        wanted |= finding.keys
    differing = {key: value for key, value in wanted.items() if attrgetter(key)(config) != value}

    def fits(candidate: Changes) -> bool:
        changed = applied(candidate, config)
        return changed is not None and not contradictions(changed)

    # Longer or slower lines may take too long for the control rate. Then leave out one optional key
    # after the other, the least important one first.
    for optional in ("", *OPTIONAL_KEYS):
        if optional and attrgetter(optional)(config) in (0, "off"):
            differing.pop(optional, None)
        if fits(differing):
            return differing
    slower: Changes = {**differing, "control.rate": "auto"}
    return slower if fits(slower) else differing


def withheld(simulated: bool, config: Config) -> str:
    """Return the reason why the findings do not apply to the configured robot, or ""."""
    if not simulated or config.mcu.simulated:
        return ""
    return (
        f"the tool checked the simulator, but the configured mcu.port is {config.mcu.port}: the "
        "results do not apply to the robot on that port"
    )


def applied(updates: Changes, config: Config) -> Config | None:
    """Return a copy of `config` with the values `updates`, or None if a value is not permitted."""
    plain: Any = effective(config)
    for key, value in updates.items():
        where, _, name = key.rpartition(".")
        reduce(getitem, where.split("."), plain)[name] = value
    try:
        return from_builtins(plain)
    except ValidationError:
        return None


class CheckupReport(Struct, frozen=True):
    """The result of a check.

    `passed` says whether the check has passed. `changes` are the suggested configuration values,
    and `toml` contains them as lines of TOML. `written` is the path of the configuration file if
    the changes were written into it, else None. `error` describes a failure outside the board, such
    as a port that cannot be opened or a file that cannot be written. It is None without a failure.
    """

    port: str
    passed: bool
    findings: Sequence[Finding]
    changes: Changes
    toml: str
    written: str | None = None
    error: str | None = None
    # Reason why the findings do not apply to the robot of the configuration file, else None.
    withheld: str | None = None


def report(
    port: str,
    findings: Sequence[Finding],
    changes: Changes,
    written: str,
    error: str,
    withheld: str = "",
) -> CheckupReport:
    """Return the report. The check has passed if every step was run and judged, and none failed."""
    passed = _complete(findings) and not any(finding.verdict == "FAIL" for finding in findings)
    toml = "\n".join(excerpt(changes))
    return CheckupReport(
        port, passed, findings, changes, toml, written or None, error or None, withheld or None
    )


def _complete(findings: Sequence[Finding]) -> bool:
    # Whether every step was run and judged.
    skipped = any(finding.name == SKIPPED_STEPS for finding in findings)
    return answered(findings) and not skipped and not lateness.unjudged(findings)


def summary(result: CheckupReport, where: str) -> str:
    """Return the text that the check prints last: number of findings, suggested changes."""
    verdicts = [finding.verdict for finding in result.findings]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in get_args(Verdict) if v in verdicts)
    if late := lateness.unjudged(result.findings):
        again = "so the check has not passed: repeat it when this computer is idle"
        counts += f"\nfor {len(late)} of the steps there is no result, {again}"
    if result.withheld:
        return f"\n{counts}\n{where} stays unchanged: {result.withheld}"
    if not result.toml:
        rest = "nothing to change"
        if not _complete(result.findings):
            rest = "no suggestion, because the check did not judge every step"
        return f"\n{counts}\n{where}: {rest}"
    head = f"{where}: written" if result.written else "for acsard.toml:"
    return f"\n{counts}\n\n{head}\n{result.toml}"
