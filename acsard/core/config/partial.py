"""Runs the rules that relate several keys of `acsard.toml` to each other.

One that reads an invalid key is skipped, because another error reports the key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from typing import Any, cast

from acsard.core.config.settings import Config
from acsard.core.values import AcsardError

Rule = Callable[[Config], Iterable[str]]  # returns one error line for each mistake


class InvalidKeyError(AcsardError):
    """A rule has read a key whose value is not valid."""


def view_without(config: Config, invalid: Set[str]) -> Config:
    """Return a view of `config` in which reading an `invalid` key raises `InvalidKeyError`."""
    return cast(Config, _View(config, "", invalid)) if invalid else config


def mistakes(rules: Iterable[Rule], config: Config) -> list[str]:
    """Return the error lines of all rules that read only valid keys."""
    errors: list[str] = []
    for rule in rules:
        try:
            errors += rule(config)
        except InvalidKeyError:
            continue
    return errors


class _View:
    # One table of the configuration; `path` is its dotted name plus a dot, or "".
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
