"""The words that a shell offers for values. They are known without asking a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args, get_type_hints

from acsard.core.config.live import flat, live
from acsard.core.config.named_faults import ARGUMENTS, FAULTS
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, LogConfig
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.topics import PUBLISHED, TOPICS, json_key, source_keys

NUMBERS = "acsard recording 2>/dev/null | sed -n 's/^0*\\([0-9][0-9]*\\)-.*/\\1/p'"
"""Shell command that lists the recordings by number. The shell offers local files as well."""

RECORDING: dict[str, str | dict[str, str]] = {
    "bash": "_acsard_recordings",
    "zsh": "_acsard_recordings",
    "fish": f"({NUMBERS}; __fish_complete_path (commandline -ct))",
    "preamble": {
        "bash": f"""
_acsard_recordings() {{
  compgen -W "$({NUMBERS})" -- "$1"
  _shtab_compgen_files "$1"
}}""",
        "zsh": f"""
_acsard_recordings() {{
  compadd -- ${{(f)"$({NUMBERS})"}}
  _files
}}""",
    },
}
"""Completion of a recording for each shell, in the form that shtab expects."""


def words() -> Mapping[tuple[str, str], list[str]]:
    """Return the words for each (verb, argument).

    The names of sources are those of the defaults.
    """
    config = Config()
    sources = [source.name for source in config.commands.sources]
    published = [topic.key for topic in PUBLISHED]
    incoming = [*source_keys(sources), "imu"]
    followed = [*published, *map(json_key, published), *incoming]
    asked = [t.key for t in TOPICS if t.direction == "query" and "<" not in t.key]
    settings = [key for key, _ in flat(effective(config)) if live(key)]
    levels = [str(level) for level in get_args(get_type_hints(LogConfig)["level"])]
    return {
        ("get", "key"): [*published, *asked, *(f"schema/{name}" for name in SCHEMAS)],
        ("echo", "topic"): followed,
        ("hz", "topic"): followed,
        ("set", "settings"): [*settings, *levels],
        ("drive", "source"): sources,
        ("calibrate", "positions"): published,
        ("calibrate", "imu"): ["imu"],
        ("sim", "fault"): [*FAULTS, *(f"{name}=" for name in ARGUMENTS)],
    }
