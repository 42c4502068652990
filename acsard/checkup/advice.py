"""What the findings say of the configuration: the lines of `acsard.toml` that should differ."""

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
"""Dotted key -> value, in the order of the file."""

OPTIONAL = ("mcu.encoder_counts", "mcu.link_check")
"""Better with, but good without: left out where the wire has no room for the longer lines."""


def answered(findings: Iterable[Finding]) -> bool:
    """A board is at the port: its rate was found."""
    return any(finding.name == "baud rate" and finding.keys for finding in findings)


def changes(findings: Sequence[Finding], config: Config, port: str = "") -> Changes:
    """The keys that should be other than configured; the `port` too if a board answered there."""
    wanted: Changes = {"mcu.port": port} if port and answered(findings) else {}
    for finding in findings:
        wanted |= finding.keys
    differing = {key: value for key, value in wanted.items() if attrgetter(key)(config) != value}

    def fits(given: Changes) -> bool:
        changed = applied(given, config)
        return changed is not None and not contradictions(changed)

    # What makes lines longer or slower can leave no room for the rate: give up the least first.
    for optional in ("", *OPTIONAL):
        if optional and attrgetter(optional)(config) in (0, "off"):
            differing.pop(optional, None)
        if fits(differing):
            return differing
    slower: Changes = {**differing, "control.rate": "auto"}
    return slower if fits(slower) else differing


def withheld(simulated: bool, config: Config) -> str:
    """Why nothing that was found is for this configuration: it is another's; "" where it is not."""
    if not simulated or config.mcu.simulated:
        return ""
    return (
        f"the simulator was checked, and mcu.port here is {config.mcu.port}: what the simulator "
        "likes says nothing of that robot"
    )


def applied(given: Changes, config: Config) -> Config | None:
    """The configuration with these keys; None when they cannot be its values."""
    plain: Any = effective(config)
    for key, value in given.items():
        where, _, name = key.rpartition(".")
        reduce(getitem, where.split("."), plain)[name] = value
    try:
        return from_builtins(plain)
    except ValidationError:
        return None
