"""Decodes `acsard.toml` to one frozen `Config`, or to an error that names every key and its fix.

The keys are in `settings.py` and the rules between them in `contradictions.py`. The command line
reads the file; this module only decodes it.
"""

from __future__ import annotations

import tomllib

from msgspec import convert, to_builtins

from acsard.core.config.contradictions import contradictions
from acsard.core.config.partial import without
from acsard.core.config.settings import Config
from acsard.core.config.validation import build_partly
from acsard.core.values import AcsardError

MAX_BYTES = 65536
"""Largest size of a configuration. The reference file has a tenth of this."""


class ConfigError(AcsardError):
    """A configuration that cannot be used; `problems` has one line per mistake."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def parse(text: bytes, overrides: dict[str, dict[str, object]] | None = None) -> Config:
    """Decode a configuration file.

    Raises `ConfigError` with every problem found. `overrides` are values from the command line, by
    table and key; they win over the file.
    """
    if len(text) > MAX_BYTES:
        raise ConfigError(
            [f"{len(text)} bytes: too large for a configuration; at most {MAX_BYTES}"]
        )
    try:
        table = tomllib.loads(text.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError([f"not UTF-8 text: {error}; save the file as UTF-8"]) from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            [f"not TOML: {error}; write texts in quotes, and true or false without"]
        ) from None
    # Python limits the length of numbers and the depth of nesting.
    except (ValueError, RecursionError):
        raise ConfigError(
            ["not TOML: a number is too long or lists are nested too deep; correct it"]
        ) from None
    for section, values in (overrides or {}).items():
        inner = table.setdefault(section, {})
        if isinstance(inner, dict):
            inner.update(values)
    problems: list[str] = []
    spoilt: set[str] = set()
    try:
        config = build_partly(Config, table, "", problems, spoilt)
    except RecursionError:
        raise ConfigError(["lists or tables are nested too deep; no key needs that"]) from None
    if config is not None:
        problems += contradictions(without(config, spoilt))
    if config is None or problems:
        raise ConfigError(problems)
    return config


def from_builtins(data: object) -> Config:
    """Convert the result of `effective` back to a `Config`."""
    return convert(data, Config)


def effective(config: Config) -> dict[str, object]:
    """Return the configuration in force as plain tables, with defaults filled in."""
    plain = to_builtins(config)
    assert isinstance(plain, dict)
    return plain
