"""Write the man page of acsard and its completion scripts for bash, zsh and fish into a directory.

A release runs `python deploy/shell_files.py DIRECTORY` in an environment with acsard, shtab and
argparse-manpage (the extra `test` has both).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import shtab
from argparse_manpage.manpage import Manpage

from acsard.cli import parser
from acsard.host.version import version

FILES = {"bash": "acsard", "zsh": "_acsard", "fish": "acsard.fish"}
"""Maps each shell to the name under which it looks for the completion script."""

KINDS = {"FILE": shtab.FILE, "DIR": shtab.DIRECTORY, "DIRECTORY": shtab.DIRECTORY}


def actions(of: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in of._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from actions(below)


def main(directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    about = {"project_name": "acsard", "version": version(), "manual_title": "ACSAR robot"}
    about["description"] = "daemon and tools of a differential-drive robot"
    (directory / "acsard.1").write_text(f"{Manpage(parser(), about)}\n", encoding="utf-8")
    whole = parser()
    for action in actions(whole):
        if kind := KINDS.get(str(action.metavar)):
            action.complete = kind  # type: ignore[attr-defined]
    for shell, name in FILES.items():
        script = shtab.complete(whole, shell)
        if shell == "zsh":
            # shtab writes `(*)`, which completes the first word of a repeated argument and excludes
            # all others.
            script = script.replace('  "(*)::', '  "*:').replace('  "(*):', '  "*:')
        (directory / name).write_text(script + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
