"""Print the script with which a shell completes subcommands, options, keys, settings, recordings
and files when you press Tab. Write it to the file that the shell reads. Needs the library shtab; if
it is missing, a message gives the command that installs it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import get_args, get_type_hints

from acsard.cli import parser
from acsard.core.config.live import find_live_setting, flat
from acsard.core.config.named_faults import ARGUMENTS, FAULTS
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, LogConfig
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import PUBLISHED, TOPICS, json_key, source_keys
from acsard.host.extras import missing

SHELLS = {
    "bash": "~/.local/share/bash-completion/completions/acsard",
    "zsh": "the file _acsard in a directory of your $fpath",
    "fish": "~/.config/fish/completions/acsard.fish",
}
"""Maps each shell to the file from which the shell loads the completion script of acsard."""

_NUMBERS = "acsard recording 2>/dev/null | sed -n 's/^0*\\([0-9][0-9]*\\)-.*/\\1/p'"
"""Shell command that prints the numbers of all recordings, one per line."""

_RECORDING: dict[str, str | dict[str, str]] = {
    "bash": "_acsard_recordings",
    "zsh": "_acsard_recordings",
    "fish": f"({_NUMBERS}; __fish_complete_path (commandline -ct))",
    "preamble": {
        "bash": f"""
_acsard_recordings() {{
  compgen -W "$({_NUMBERS})" -- "$1"
  _shtab_compgen_files "$1"
}}""",
        "zsh": f"""
_acsard_recordings() {{
  compadd -- ${{(f)"$({_NUMBERS})"}}
  _files
}}""",
    },
}
"""Maps each shell to code that completes the number or the file name of a recording.

shtab defines the format of this mapping.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    places = "; ".join(f"{shell}: {place}" for shell, place in SHELLS.items())
    parser.epilog = f"Write the script to the file that your shell reads: {places}."
    parser.add_argument("shell", choices=tuple(SHELLS), metavar="SHELL", help=", ".join(SHELLS))


def main(args: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError:
        raise missing("shtab", "shell") from None
    whole = parser()
    kinds = {"FILE": shtab.FILE, "DIR": shtab.DIRECTORY, "DIRECTORY": shtab.DIRECTORY}
    known = _candidates()
    for verb, action in _actions(whole):
        kind = kinds.get(str(action.metavar))
        if verb == "recording" and action.dest == "file":
            kind = _RECORDING
        if kind:
            action.complete = kind  # type: ignore[attr-defined]
        elif (verb, action.dest) in known:
            # The choices are only for the completion. They cannot refuse other words, because this
            # parser does not parse a command line.
            action.choices = known[verb, action.dest]
    script = shtab.complete(whole, args.shell)
    if args.shell == "zsh":
        # shtab writes `(*)`, which completes the first word and excludes all others. `*` completes
        # every word of a repeated argument.
        script = script.replace('  "(*)::', '  "*:').replace('  "(*):', '  "*:')
    print(script)
    return 0


def _candidates() -> Mapping[tuple[str, str], list[str]]:
    config = Config()
    sources = [source.name for source in config.commands.sources]
    published = [topic.key for topic in PUBLISHED]
    incoming = [*source_keys(sources), "imu"]
    followed = [*published, *map(json_key, published), *incoming]
    asked = [t.key for t in TOPICS if t.direction == "query" and "<" not in t.key]
    settings = [key for key, _ in flat(effective(config)) if find_live_setting(key)]
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


def _actions(
    parser: argparse.ArgumentParser, verb: str = ""
) -> Iterator[tuple[str, argparse.Action]]:
    """Yield pairs: the name of a subcommand, and one of its options or arguments.

    For an option of an action, such as `recording show`, the name is that of the subcommand,
    `recording`.
    """
    for action in parser._actions:
        yield verb, action
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from _actions(below, verb or name)
