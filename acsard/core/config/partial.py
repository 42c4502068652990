"""Runs the rules that relate several keys of `acsard.toml` to each other.

A rule is skipped if it reads a key whose value is not valid. Another error line already reports
this key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from typing import Any, cast

from acsard.core.config.settings import Config
from acsard.core.values import AcsardError

Rule = Callable[[Config], Iterable[str]]
"""Function that checks a configuration and returns one error line for each mistake."""


class InvalidKeyError(AcsardError):
    """Error that occurs when a rule reads a key whose value is not valid."""


def view_without(config: Config, invalid: Set[str]) -> Config:
    """Return a view of `config` in which the keys in `invalid` cannot be read.

    `invalid` contains dotted keys. Reading one of these keys raises `InvalidKeyError`.
    """
    return cast(Config, _View(config, "", invalid)) if invalid else config


def mistakes(rules: Iterable[Rule], config: Config) -> list[str]:
    """Return the error lines of all `rules` for `config`.

    A rule is skipped if it reads a key whose value is not valid.
    """
    errors: list[str] = []
    for rule in rules:
        try:
            errors += rule(config)
        except InvalidKeyError:
            continue
    return errors


class _View:
    """A view of one table of the configuration. Reading an invalid key raises `InvalidKeyError`.

    `path` is the dotted name of the table plus a dot, or "" for the whole document.
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
