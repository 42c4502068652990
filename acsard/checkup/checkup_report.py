"""Makes the report of the check, as text and as an object, and advises changes to `acsard.toml`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import attrgetter, getitem
from typing import Any, get_args

from msgspec import Struct, ValidationError

from acsard.checkup import lateness
from acsard.checkup.findings import REST, Finding, Verdict
from acsard.core.config.contradictions import contradictions
from acsard.core.config.parsing import effective, from_builtins
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import excerpt

Changes = dict[str, object]
"""Maps dotted keys, such as `mcu.port`, to new configuration values."""

OPTIONAL = ("mcu.encoder_counts", "mcu.link_check")
"""Keys that improve the link but make its lines longer. If the wire is too slow, the advice leaves
out the first key. If that is not enough, it leaves out the second key too."""


def answered(findings: Iterable[Finding]) -> bool:
    """Return whether a board answered at the port, so that the check found its baud rate."""
    return any(finding.name == "baud rate" and finding.keys for finding in findings)


def changes(findings: Sequence[Finding], config: Config, port: str = "") -> Changes:
    """Return the suggested changes of the configuration.

    The changes include `mcu.port` with the value `port`, unless `port` is "" or no board answered
    at the port.
    """
    wanted: Changes = {"mcu.port": port} if port and answered(findings) else {}
    for finding in findings:
        wanted |= finding.keys
    differing = {key: value for key, value in wanted.items() if attrgetter(key)(config) != value}

    def fits(given: Changes) -> bool:
        changed = applied(given, config)
        return changed is not None and not contradictions(changed)

    # Longer or slower lines may take too long for the control rate. Then leave out the optional
    # keys, the least important one first.
    for optional in ("", *OPTIONAL):
        if optional and attrgetter(optional)(config) in (0, "off"):
            differing.pop(optional, None)
        if fits(differing):
            return differing
    slower: Changes = {**differing, "control.rate": "auto"}
    return slower if fits(slower) else differing


def withheld(simulated: bool, config: Config) -> str:
    """Return why the findings do not apply to the robot of this configuration, or "" if they do.

    `simulated` is true if the check tested the simulator.
    """
    if not simulated or config.mcu.simulated:
        return ""
    return (
        f"the tool checked the simulator, but the configured mcu.port is {config.mcu.port}: the "
        "results do not apply to the robot on that port"
    )


def applied(given: Changes, config: Config) -> Config | None:
    """Return `config` with the new values `given`, or None if a value is not permitted."""
    plain: Any = effective(config)
    for key, value in given.items():
        where, _, name = key.rpartition(".")
        reduce(getitem, where.split("."), plain)[name] = value
    try:
        return from_builtins(plain)
    except ValidationError:
        return None


class Report(Struct, frozen=True):
    """The result of a check.

    `changes` are the suggested configuration values, and `toml` contains them as lines of TOML.
    `written` is the path of the file that now contains the changes, or None. `error` describes a
    failure outside the board, such as a port that cannot be opened or a file that cannot be
    written.
    """

    port: str
    passed: bool
    findings: Sequence[Finding]
    changes: Changes
    toml: str
    written: str | None = None
    error: str | None = None
    withheld: str | None = None
    """Reason why the findings do not apply to the robot of the configuration file; None if they
    do."""


def report(
    port: str,
    findings: Sequence[Finding],
    changes: Changes,
    written: str,
    error: str,
    withheld: str = "",
) -> Report:
    """Return the report of a check.

    A check has passed if the board answered, every step was run and judged, and no step failed. The
    report contains None instead of an empty `written`, `error` or `withheld`.
    """
    judged = answered(findings) and not lateness.unjudged(findings)
    passed = judged and not any(one.verdict == "FAIL" or one.name == REST for one in findings)
    toml = "\n".join(excerpt(changes))
    return Report(
        port, passed, findings, changes, toml, written or None, error or None, withheld or None
    )


def summary(found: Report, where: str) -> str:
    """Return the last lines that the check prints. `where` names the configuration file."""
    verdicts = [finding.verdict for finding in found.findings]
    counts = ", ".join(f"{verdicts.count(v)} {v}" for v in get_args(Verdict) if v in verdicts)
    if late := lateness.unjudged(found.findings):
        again = "so the check has not passed: repeat it when this computer is idle"
        counts += f"\nfor {len(late)} of the steps there is no result, {again}"
    if found.withheld:
        return f"\n{counts}\n{where} stays unchanged: {found.withheld}"
    if not found.toml:
        return f"\n{counts}\nacsard.toml: nothing to change"
    head = f"{where}: written" if found.written else "for acsard.toml:"
    return f"\n{counts}\n\n{head}\n{found.toml}"
