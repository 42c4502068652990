"""Runs the rules that relate several keys of `acsard.toml` to each other. A rule is skipped if it
reads a key that has no valid value."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from typing import Any, cast

from acsard.core.config.settings import Config
from acsard.core.values import AcsardError

Rule = Callable[[Config], Iterable[str]]
"""Function that returns the mistakes in a configuration, one line each."""


class InvalidKeyError(AcsardError):
    """Error that a rule causes when it reads a key that has no valid value."""


def view_without(config: Config, invalid: Set[str]) -> Config:
    """Return a view of `config` that raises `InvalidKeyError` for the dotted keys in `invalid`."""
    return cast(Config, _View(config, "", invalid)) if invalid else config


def mistakes(rules: Iterable[Rule], config: Config) -> list[str]:
    """Return the mistakes that all `rules` find in `config`, one line each.

    A rule is skipped if it reads a key that has no valid value.
    """
    found: list[str] = []
    for rule in rules:
        try:
            found += rule(config)
        except InvalidKeyError:
            continue
    return found


class _View:
    """A view of one table, from which an invalid key cannot be read.

    `path` is the dotted name of the table plus a dot, or "" for the whole document. `invalid`
    contains the dotted keys whose reading raises `InvalidKeyError`.
    """

    def __init__(self, table: object, path: str, invalid: Set[str]) -> None:
        self._table, self._path, self._invalid = table, path, invalid

    def __getattr__(self, name: str) -> Any:
        static = getattr(type(self._table), name, None)
        if isinstance(static, property) and static.fget:
            # Run the property on the view, so that the keys that it reads are checked as well.
            return static.fget(self)
        where = f"{self._path}{name}"
        if where in self._invalid:
            raise InvalidKeyError(where)
        value = getattr(self._table, name)
        inner = f"{where}."
        below = any(key.startswith(inner) for key in self._invalid)
        return _View(value, inner, self._invalid) if below else value
