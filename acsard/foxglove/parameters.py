"""The live settings as a viewer's parameters, and its wishes as settings; pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from acsard.config.live import flat, live


def values(config: object) -> dict[str, Any]:
    """The settings that can be changed while the robot runs, by key; lists instead of tuples."""
    found = ((key, value) for key, value in flat(config) if live(key))
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found}


def asked(known: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Those of these names; all of them for none."""
    return {key: value for key, value in known.items() if key in names or not names}


def news(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Those that have another value than before."""
    return {key: value for key, value in now.items() if before.get(key) != value}
