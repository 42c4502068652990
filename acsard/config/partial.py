"""A configuration of which some keys could not be read: rules see the others, and only those.

A rule that looks at a key which has no valid value says nothing about the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from typing import Any, cast

from acsard.config.settings import Config
from acsard.values import AcsardError

Rule = Callable[[Config], Iterable[str]]
"""What is wrong with a configuration: a line each."""


class SpoiltError(AcsardError):
    """There is no valid value to look at."""


def without(config: Config, spoilt: Set[str]) -> Config:
    """The same to read, but the keys that are `spoilt` (dotted) raise `SpoiltError`."""
    return cast(Config, _View(config, "", spoilt)) if spoilt else config


def told(rules: Iterable[Rule], config: Config) -> list[str]:
    """What every rule says whose keys can be read."""
    found: list[str] = []
    for rule in rules:
        try:
            found += rule(config)
        except SpoiltError:
            continue
    return found


class _View:
    """One table."""

    def __init__(self, table: object, path: str, spoilt: Set[str]) -> None:
        self._table, self._path, self._spoilt = table, path, spoilt

    def __getattr__(self, name: str) -> Any:
        static = getattr(type(self._table), name, None)
        if isinstance(static, property) and static.fget:
            return static.fget(self)  # so that what it reads is looked at as well
        where = f"{self._path}{name}"
        if where in self._spoilt:
            raise SpoiltError(where)
        value = getattr(self._table, name)
        inner = f"{where}."
        below = any(one.startswith(inner) for one in self._spoilt)
        return _View(value, inner, self._spoilt) if below else value
