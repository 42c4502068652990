"""Decodes the text of `acsard.toml` to a `Config`, or to an error with every mistake and fix."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from typing import Any

from msgspec import convert, to_builtins

from acsard.core.config.contradictions import contradictions
from acsard.core.config.partial import view_without
from acsard.core.config.settings import Config
from acsard.core.config.validation import build_partly, known_part
from acsard.core.values import AcsardError

MAX_BYTES = 65536  # the `acsard.toml` in the repository has a third of this


class ConfigError(AcsardError):
    """A configuration that cannot be used. `problems` lists each mistake with its fix."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def parse(text: bytes, overrides: dict[str, dict[str, object]] | None = None) -> Config:
    """Decode and check an `acsard.toml`; `overrides` win, by table and key.

    Raises `ConfigError`, which lists every mistake.
    """
    table = toml_table(text)
    for section, values in (overrides or {}).items():
        inner = table.setdefault(section, {})
        if isinstance(inner, dict):
            inner.update(values)
    return _checked(table)


def parse_recorded(text: bytes) -> Config:
    """Decode and check a configuration that a daemon of any version has written.

    Keys that this version does not have are ignored. Raises `ConfigError`.
    """
    return _checked(known_part(Config, toml_table(text)))


def toml_table(text: bytes) -> dict[str, Any]:
    """Return what the file sets, without defaults. Raises `ConfigError` if it is not TOML."""
    if len(text) > MAX_BYTES:
        raise ConfigError(
            [f"more than {MAX_BYTES} bytes: too large for a configuration; shorten the file"]
        )
    if not text:
        return {}
    import tomllib  # it loads for 2 ms, and a computer without a file does not need it

    try:
        toml = text.removeprefix(BOM_UTF8).decode("utf-8")
        return tomllib.loads(toml)
    except UnicodeDecodeError as error:
        raise ConfigError([f"not UTF-8 text: {error}; save the file as UTF-8"]) from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            [
                _repeated(toml, str(error))
                or f"not TOML: {error}; write texts in quotes, but true and false without quotes, "
                "and numbers with a decimal point and no unit: 0.05"
            ]
        ) from None
    # Python limits the length of numbers and the depth of nesting.
    except (ValueError, RecursionError):
        raise ConfigError(
            ["not TOML: a number is too long or lists are nested too deep; shorten them"]
        ) from None


def _repeated(toml: str, error: str) -> str:
    # tomllib names the second place only. The last line before it with the same name is the first.
    # Of a value of several lines, tomllib names the last line, which has no name.
    if "twice" not in error and "overwrite" not in error:
        return ""
    number = re.search(r"line (\d+)", error)
    lines = toml.rstrip().split("\n")[: int(number[1]) if number else None]
    *before, name = (line.split("#")[0].split("=")[0].strip() for line in lines)
    if name not in before or not (name[0] == "[" or "=" in lines[-1]):
        return ""
    first = len(before) - before[::-1].index(name)
    return f"line {len(lines)} repeats {name}, which is at line {first} already: change it there"


def _checked(table: object) -> Config:
    if table == {}:
        return Config()  # the defaults are valid
    problems: list[str] = []
    invalid: set[str] = set()
    try:
        config = build_partly(Config, table, "", problems, invalid)
    except RecursionError:
        raise ConfigError(
            ["lists or tables are nested too deep; no key needs so many levels"]
        ) from None
    if config is not None:
        problems += contradictions(view_without(config, invalid))
    if config is None or problems:
        raise ConfigError(problems)
    return config


def from_builtins(data: object) -> Config:
    """Convert the result of `effective`, in a daemon of any version, back to a `Config`."""
    return convert(known_part(Config, data), Config)


def effective(config: Config) -> dict[str, object]:
    """Return a configuration as nested dictionaries, with a value for every key."""
    plain = to_builtins(config)
    assert isinstance(plain, dict)
    return plain
