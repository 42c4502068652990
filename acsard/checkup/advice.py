"""What the findings say of the configuration: the lines of `acsard.toml` that should differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from msgspec import ValidationError

from acsard.checkup.findings import Finding
from acsard.config.contradictions import contradictions
from acsard.config.parsing import effective, from_builtins
from acsard.config.settings import Config
from acsard.config.validation import write

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
    differing = {key: value for key, value in wanted.items() if _value(config, key) != value}
    # What makes lines longer or slower can leave no room for the rate: give up the least first.
    for optional in ("", *OPTIONAL):
        if optional and _value(config, optional) in (0, "off"):
            differing.pop(optional, None)
        if _fits(differing, config):
            return differing
    slower: Changes = {**differing, "control.rate": "auto"}
    return slower if _fits(slower, config) else differing


def _fits(given: Changes, config: Config) -> bool:
    changed = applied(given, config)
    return changed is not None and not contradictions(changed)


def applied(given: Changes, config: Config) -> Config | None:
    """The configuration with these keys; None when they cannot be its values."""
    plain = effective(config)
    for key, value in given.items():
        *path, name = key.split(".")
        table = plain
        for part in path:
            inner = table[part]
            assert isinstance(inner, dict)
            table = inner
        table[name] = value
    try:
        result = from_builtins(plain)
    except ValidationError:
        return None
    assert isinstance(result, Config)
    return result


def lines(given: Changes) -> list[str]:
    """The changes as lines of TOML, by table."""
    found: list[str] = []
    table = ""
    for key, value in sorted(given.items(), key=lambda item: item[0].count(".")):
        where, _, name = key.rpartition(".")
        if where != table:
            found += [""] * bool(found) + [f"[{where}]"]
            table = where
        found.append(f"{name} = {write(value)}")
    return found


def _value(config: Config, key: str) -> object:
    value: object = config
    for name in key.split("."):
        value = getattr(value, name)
    return value
