"""The settings that can be changed at run time, as rows of a form. This module is pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import UNSET, Struct, UnsetType, inspect

from acsard.core.config.live import WHEN, flat, live
from acsard.core.ros.parameters import kind_of


class Setting(Struct, frozen=True, omit_defaults=True):
    """One setting, with its value, its explanation and its allowed values."""

    key: str
    value: Any
    what: str
    when: str
    low: float | UnsetType = UNSET
    high: float | UnsetType = UNSET
    choices: list[str] | UnsetType = UNSET


def rows(config: Mapping[str, Any]) -> list[Setting]:
    """Return the changeable settings in the order of `config`, a value of the key `config`."""
    return [_row(key, value) for key, value in flat(config) if live(key) is not None]


def _row(key: str, value: object) -> Setting:
    told, kind = live(key), kind_of(key)
    assert told is not None
    low: float | UnsetType = UNSET
    high: float | UnsetType = UNSET
    choices: list[str] | UnsetType = UNSET
    match kind.type if isinstance(kind, inspect.Metadata) else kind:
        case inspect.FloatType(ge=float(least), le=float(most)):
            low, high = least, most
        case inspect.LiteralType(values=values):
            choices = [str(one) for one in values]
    return Setting(key, value, told.what, WHEN[told.when], low, high, choices)
