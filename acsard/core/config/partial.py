"""A view of a configuration in which some keys have no valid value.

A rule that reads such a key is skipped, because its result would be meaningless. All other rules
still run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from typing import Any, cast

from acsard.core.config.settings import Config
from acsard.core.values import AcsardError

Rule = Callable[[Config], Iterable[str]]
"""Function that returns the mistakes in a configuration, one line each."""


class SpoiltError(AcsardError):
    """Raised when a rule reads a key without a valid value."""


def without(config: Config, spoilt: Set[str]) -> Config:
    """Return a view of the configuration that raises `SpoiltError` for these dotted keys."""
    return cast(Config, _View(config, "", spoilt)) if spoilt else config


def told(rules: Iterable[Rule], config: Config) -> list[str]:
    """Return the results of all rules that read only valid keys."""
    found: list[str] = []
    for rule in rules:
        try:
            found += rule(config)
        except SpoiltError:
            continue
    return found


class _View:
    """View of one table."""

    def __init__(self, table: object, path: str, spoilt: Set[str]) -> None:
        self._table, self._path, self._spoilt = table, path, spoilt

    def __getattr__(self, name: str) -> Any:
        static = getattr(type(self._table), name, None)
        if isinstance(static, property) and static.fget:
            # Run the property on the view, so that the keys that it reads are checked as well.
            return static.fget(self)
        where = f"{self._path}{name}"
        if where in self._spoilt:
            raise SpoiltError(where)
        value = getattr(self._table, name)
        inner = f"{where}."
        below = any(one.startswith(inner) for one in self._spoilt)
        return _View(value, inner, self._spoilt) if below else value
