"""The live settings as a viewer's parameters, and its changes as settings. This module is pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from acsard.core.config.live import flat, live


def values(config: object) -> dict[str, Any]:
    """Return the settings that can be changed at run time, by key, tuples as lists."""
    found = ((key, value) for key, value in flat(config) if live(key))
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found}


def asked(known: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the settings with these names, or all of them if `names` is empty."""
    return {key: value for key, value in known.items() if key in names or not names}


def news(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings whose value has changed."""
    return {key: value for key, value in now.items() if before.get(key) != value}
