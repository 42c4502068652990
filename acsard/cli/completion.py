"""`acsard completion` and `acsard man`: shell completion scripts and the man page."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from acsard.host.errors import Exit, ExitError
from acsard.host.extras import install

SHELLS = {
    "bash": "~/.local/share/bash-completion/completions/acsard",
    "zsh": "a directory of your $fpath, as _acsard",
    "fish": "~/.config/fish/completions/acsard.fish",
}
"""Where each shell looks for its completion script."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare both verbs and their options."""
    places = "; ".join(f"{shell}: {place}" for shell, place in SHELLS.items())
    completion = verbs.add_parser(
        "completion",
        help="print the script for completion with Tab in a shell",
        description="Print the script with which a shell completes verbs, options, keys, settings, "
        "recordings and files when you press Tab. Write it to the file that the shell "
        f"reads ({places}). Needs the library shtab; if it is missing, a message gives the "
        "command that installs it.",
    )
    completion.add_argument("shell", choices=tuple(SHELLS), metavar="SHELL", help=", ".join(SHELLS))
    completion.set_defaults(main=main_completion)
    page = verbs.add_parser(
        "man",
        help="print the text of every --help as a man page",
        description="Print a man page of every verb and option, for example into "
        "~/.local/share/man/man1/acsard.1. Needs the library argparse-manpage; if it is "
        "missing, a message gives the command that installs it.",
    )
    page.set_defaults(main=main_man)


def main_completion(args: argparse.Namespace) -> int:
    """Print the completion script of a shell."""
    from acsard.cli import parser
    from acsard.cli.values import RECORDING, words

    try:
        import shtab
    except ImportError:
        raise _missing("shtab") from None
    whole = parser()
    kinds = {"FILE": shtab.FILE, "DIR": shtab.DIRECTORY, "DIRECTORY": shtab.DIRECTORY}
    known = words()
    for verb, action in _actions(whole):
        kind = kinds.get(str(action.metavar))
        if verb == "recording" and action.dest == "file":
            kind = RECORDING
        if kind:
            action.complete = kind  # type: ignore[attr-defined]
        elif (verb, action.dest) in known:
            # The shell only offers these words; this parser does not parse any.
            action.choices = known[verb, action.dest]
    script = shtab.complete(whole, args.shell)
    if args.shell == "zsh":
        script = every_word(script)
    print(script)
    return 0


def every_word(script: str) -> str:
    """Return the zsh script with completion for every word of a repeated argument.

    shtab writes `(*)`, which completes the first word and excludes all others. `*` completes every
    word.
    """
    return script.replace('  "(*)::', '  "*:').replace('  "(*):', '  "*:')


def main_man(args: argparse.Namespace) -> int:
    """Print the man page."""
    from acsard import __version__
    from acsard.cli import parser

    try:
        from argparse_manpage.manpage import Manpage
    except ImportError:
        raise _missing("argparse-manpage") from None
    about = {"project_name": "acsard", "version": __version__, "manual_title": "ACSAR robot"}
    print(Manpage(parser(), about))
    return 0


def _missing(library: str) -> ExitError:
    return ExitError(Exit.FAILURE, f"needs the library {library}; run: {install('shell')}")


def _actions(
    parser: argparse.ArgumentParser, verb: str = ""
) -> Iterator[tuple[str, argparse.Action]]:
    """Yield every option and argument with its verb.

    Those of `recording show` belong to `recording`.
    """
    for action in parser._actions:
        yield verb, action
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from _actions(below, verb or name)
