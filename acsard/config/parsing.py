"""`acsard.toml` bytes -> one frozen `Config`, or an error that names every key and its mend.

What lives here: decoding. The keys are in `settings.py`, the rules between them in
`contradictions.py`. What must not: reading files (the command line does), or anything that uses
the values.
"""

from __future__ import annotations

import tomllib

from msgspec import convert, to_builtins

from acsard.config.contradictions import contradictions
from acsard.config.partial import without
from acsard.config.settings import Config
from acsard.config.validation import build_partly
from acsard.values import AcsardError

MAX_BYTES = 65536
"""The reference file is a tenth of this."""


class ConfigError(AcsardError):
    """The configuration cannot be used; `problems` has one line per mistake."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def parse(text: bytes, overrides: dict[str, dict[str, object]] | None = None) -> Config:
    """Decode a configuration file; raises `ConfigError` with every problem found.

    `overrides` are values from the command line, by table and key; they win over the file.
    """
    if len(text) > MAX_BYTES:
        raise ConfigError([f"{len(text)} bytes: not a configuration; at most {MAX_BYTES}"])
    try:
        table = tomllib.loads(text.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError([f"not UTF-8 text: {error}; save the file as UTF-8"]) from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"not TOML: {error}; texts need quotes, true/false none"]) from None
    except (ValueError, RecursionError):  # numbers and nesting beyond what Python takes
        raise ConfigError(["not TOML: a number too long or lists too deep; mend it"]) from None
    for section, values in (overrides or {}).items():
        inner = table.setdefault(section, {})
        if isinstance(inner, dict):
            inner.update(values)
    problems: list[str] = []
    spoilt: set[str] = set()
    try:
        config = build_partly(Config, table, "", problems, spoilt)
    except RecursionError:
        raise ConfigError(["lists or tables nested too deep; no key needs that"]) from None
    if config is not None:
        problems += contradictions(without(config, spoilt))
    if config is None or problems:
        raise ConfigError(problems)
    return config


def from_builtins(data: object) -> Config:
    """The `Config` that `effective` described."""
    return convert(data, Config)


def effective(config: Config) -> dict[str, object]:
    """The configuration in force as plain tables, defaults filled in."""
    plain = to_builtins(config)
    assert isinstance(plain, dict)
    return plain
