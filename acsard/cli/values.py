"""What a shell offers where a value goes: words that are known without asking a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args, get_type_hints

from acsard.config.live import flat, live
from acsard.config.named_faults import ARGUMENTS, FAULTS
from acsard.config.parsing import effective
from acsard.config.settings import Config, LogConfig
from acsard.messages.json_schema import SCHEMAS
from acsard.messages.topics import PUBLISHED, TOPICS, json_key, source_keys

NUMBERS = "acsard log 2>/dev/null | sed -n 's/^0*\\([0-9][0-9]*\\)-.*/\\1/p'"
"""The recordings by their numbers; the files here are offered beside them."""

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
"""In the words of shtab."""


def words() -> Mapping[tuple[str, str], list[str]]:
    """By verb and argument; the names of sources are those of the defaults."""
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
