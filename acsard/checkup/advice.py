"""Changes to `acsard.toml` that the findings suggest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import attrgetter, getitem
from typing import Any

from msgspec import ValidationError

from acsard.checkup.findings import Finding
from acsard.config.contradictions import contradictions
from acsard.config.parsing import effective, from_builtins
from acsard.config.settings import Config

Changes = dict[str, object]
"""New values by dotted key, in the order of the file."""

OPTIONAL = ("mcu.encoder_counts", "mcu.link_check")
"""Keys that improve the link but are not necessary.

They are left out if the wire has no room for the longer lines.
"""


def answered(findings: Iterable[Finding]) -> bool:
    """Return whether a board answered at the port, that is, whether its baud rate was found."""
    return any(finding.name == "baud rate" and finding.keys for finding in findings)


def changes(findings: Sequence[Finding], config: Config, port: str = "") -> Changes:
    """Return the keys that should differ from the configuration.

    `port` is included if it is not "" and a board answered there.
    """
    wanted: Changes = {"mcu.port": port} if port and answered(findings) else {}
    for finding in findings:
        wanted |= finding.keys
    differing = {key: value for key, value in wanted.items() if attrgetter(key)(config) != value}

    def fits(given: Changes) -> bool:
        changed = applied(given, config)
        return changed is not None and not contradictions(changed)

    # Longer or slower lines may leave no room for the control rate. Give up the least important
    # first.
    for optional in ("", *OPTIONAL):
        if optional and attrgetter(optional)(config) in (0, "off"):
            differing.pop(optional, None)
        if fits(differing):
            return differing
    slower: Changes = {**differing, "control.rate": "auto"}
    return slower if fits(slower) else differing


def withheld(simulated: bool, config: Config) -> str:
    """Return why the findings do not apply to this configuration, or "" if they do.

    Findings about the simulator do not apply to the configuration of a real robot.
    """
    if not simulated or config.mcu.simulated:
        return ""
    return (
        f"the simulator was checked, and mcu.port here is {config.mcu.port}: what the simulator "
        "likes says nothing of that robot"
    )


def applied(given: Changes, config: Config) -> Config | None:
    """Return the configuration with these keys, or None if a value is not permitted."""
    plain: Any = effective(config)
    for key, value in given.items():
        where, _, name = key.rpartition(".")
        reduce(getitem, where.split("."), plain)[name] = value
    try:
        return from_builtins(plain)
    except ValidationError:
        return None
