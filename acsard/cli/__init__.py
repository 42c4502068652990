"""The command line: one module per verb, each with `add` (its options) and `main` (its work).

The parser imports only the module of the verb that is called. Each `main` imports heavy libraries
itself, so that `--help` stays fast.
"""

from __future__ import annotations

import argparse
import errno
import os
import re
import sys
import traceback
from collections.abc import Sequence
from decimal import Decimal
from importlib import import_module
from typing import NoReturn

from acsard import __version__
from acsard.cli.exits import code_of
from acsard.core.config.nearest import nearest
from acsard.core.formatting import lines
from acsard.core.values import AcsardError
from acsard.host.errors import Exit, MendableError

VERBS = (
    "run",
    "sim",
    "check",
    "topics",
    "echo",
    "get",
    "hz",
    "top",
    "fleet",
    "foxglove",
    "drive",
    "web",
    "call",
    "whoami",
    "set",
    "bench",
    "doctor",
    "ports",
    "mcu",
    "accuracy",
    "calibrate",
    "recording",
    "tls",
    "gateway",
    "router",
    "service",
    "completion",
)
"""The verbs in the order of the help text. Each one is the name of a module of this package."""

_EPILOG = """\
exit codes: 0 done, 1 failure, 2 wrong usage, 66 no such port, 69 daemon unreachable, 75 port,
bus address or robot id in use, 77 no permission, 78 bad configuration

try:  acsard run                (start the robot on the built-in simulator)
      acsard drive              (in a second terminal: drive it with the keyboard)
      acsard top                (in a third terminal: show its full status on one screen)
      acsard echo odom --short  (print its position)
"""


class _Parser(argparse.ArgumentParser):
    """An argument parser that suggests the nearest known word for a misspelt verb or choice."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            near = nearest(str(value), map(str, action.choices or ()))
            if near:
                error.message = f"invalid choice: {value!r}; did you mean {near[0]}?"
            raise


def parser(names: Sequence[str] = VERBS) -> argparse.ArgumentParser:
    """Return the parser of the `acsard` command with these verbs."""
    whole = _Parser(
        prog="acsard",
        description="The hardware interface of a four-wheel differential-drive robot. It connects "
        "the robot's microcontroller (serial port) to a Zenoh bus. Without a verb, acsard "
        "runs the daemon.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action="version", version=f"acsard {__version__}")
    verbs = whole.add_subparsers(title="verbs", metavar="VERB", dest="verb")
    for name in names:
        import_module(f"acsard.cli.{name}").add(verbs)
    return whole


def main(argv: list[str] | None = None) -> int:
    """Run the `acsard` command and return its exit code."""
    words = [_decimal(word) for word in (sys.argv[1:] if argv is None else argv)]
    known = {"-h", "--help", "--version"}
    if not words or (words[0].startswith("-") and words[0] not in known):
        words.insert(0, "run")
    try:
        try:
            args = parser(_needed(words[0])).parse_args(words)
            return int(args.main(args))
        except AcsardError as error:
            print(f"acsard: {lines(str(error))}", file=sys.stderr)
            return int(code_of(error) if isinstance(error, MendableError) else Exit.FAILURE)
        finally:
            sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError) and error.errno != errno.ENOSPC:
            raise
        # The program that reads our output (head, less) has ended, or the disk is full, so a
        # message could not be printed either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return int(Exit.OK if isinstance(error, BrokenPipeError) else Exit.FAILURE)
    except KeyboardInterrupt:
        return 130


def _needed(word: str) -> Sequence[str]:
    """Return the verbs to import for this first word: only the verb itself if it is a verb."""
    if word == "--version":
        return ()
    return (word,) if word in VERBS else VERBS


_EXPONENT = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}")


def _decimal(word: str) -> str:
    """Rewrite a negative number without its exponent: argparse takes `-1e-3` for an option."""
    return f"{Decimal(word):f}" if _EXPONENT.fullmatch(word) else word


def entry() -> NoReturn:
    """Run `main` and end the process at once: the entry point of the `acsard` script.

    The process ends with `os._exit`. Zenoh's threads may still call into Python while the
    interpreter shuts down, which would abort the process. Everything that matters has been closed
    and flushed by then.
    """
    _fill_closed_streams()
    try:
        code = main()
    except SystemExit as end:  # argparse ends this way after --help, --version and usage errors
        code = end.code if isinstance(end.code, int) else int(Exit.FAILURE)
    except BaseException:  # noqa: BLE001 - print the traceback as Python would, then end in the same way
        traceback.print_exc()
        code = int(Exit.FAILURE)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass  # the stream is closed, or its disk is full
    os._exit(code)


def _fill_closed_streams() -> None:
    """Open /dev/null in the place of each standard stream that is closed.

    Without this, the serial port would get the number of the closed stream, and printed text would
    go to the motors.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The kernel gives the lowest free number, which is this one.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
