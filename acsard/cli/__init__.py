"""The command line: one verb per file, each with `add` (its options) and `main` (its work).

Only the verb that is called is imported, and what is heavy inside its `main`.
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
from acsard.config.nearest import nearest
from acsard.host.errors import MendableError
from acsard.host.exits import Exit
from acsard.messages.text import lines
from acsard.values import AcsardError

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
    "odom",
    "calibrate",
    "log",
    "lan",
    "door",
    "router",
    "service",
    "completion",
)
"""Each is the module of its name in here, in the order of the help."""

_EPILOG = """\
exit codes: 0 done, 1 failure, 2 usage, 66 no such port, 69 daemon unreachable, 75 port,
bus address or robot id in use, 77 no permission, 78 bad configuration

try:  acsard run                (the robot, on the built-in simulator)
      acsard drive              (in a second terminal: the keyboard drives it)
      acsard top                (in a third: all of it on one screen)
      acsard echo odom --short  (where is it?)
"""


class _Parser(argparse.ArgumentParser):
    """Says what was probably meant, for verbs and all that is one of a few."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            near = nearest(str(value), map(str, action.choices or ()))
            if near:
                error.message = f"invalid choice: {value!r}; did you mean {near[0]}?"
            raise


def parser(names: Sequence[str] = VERBS) -> argparse.ArgumentParser:
    """These verbs with their options."""
    whole = _Parser(
        prog="acsard",
        description="The hardware interface of a four-wheel differential-drive robot: serial "
        "microcontroller below, Zenoh bus above. Without a verb: run.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action="version", version=f"acsard {__version__}")
    verbs = whole.add_subparsers(title="verbs", metavar="VERB", dest="verb")
    for name in names:
        import_module(f"acsard.cli.{name}").add(verbs)
    return whole


def main(argv: list[str] | None = None) -> int:
    """Entry point of the `acsard` command; returns the exit code."""
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
        # The reader (head, less) has left, or there is no room: nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return int(Exit.OK if isinstance(error, BrokenPipeError) else Exit.FAILURE)
    except KeyboardInterrupt:
        return 130


def _needed(word: str) -> Sequence[str]:
    """The verbs to import for this first word: for a verb only itself."""
    if word == "--version":
        return ()
    return (word,) if word in VERBS else VERBS


_EXPONENT = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}")


def _decimal(word: str) -> str:
    """A negative number without its exponent, with which argparse takes it for an option."""
    return f"{Decimal(word):f}" if _EXPONENT.fullmatch(word) else word


def entry() -> NoReturn:
    """What the `acsard` script runs: `main`, and an end that nothing can hold up.

    Zenoh's threads may still be calling into Python while the interpreter takes itself apart,
    which aborts the process; all that matters has been closed and flushed by now.
    """
    _fill_closed_streams()
    try:
        code = main()
    except SystemExit as end:  # argparse: --help, --version, usage
        code = end.code if isinstance(end.code, int) else int(Exit.FAILURE)
    except BaseException:  # noqa: BLE001 - what Python would do with it, then the same end
        traceback.print_exc()
        code = int(Exit.FAILURE)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass  # closed, or full
    os._exit(code)


def _fill_closed_streams() -> None:
    """Open /dev/null where a standard stream is closed, or the serial port would take its number.

    Then whatever prints would write to the motors.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
