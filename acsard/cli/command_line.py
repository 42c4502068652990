"""Finds the subcommand that was typed, runs it, and turns its errors into exit codes.

In the module of a subcommand, the docstring is the text of `--help`, `add_options` declares the
options, and `main` (or a main function for each action, as of `acsard tls init`) runs it. Only the
module of the typed subcommand is imported. It imports at its top everything but libraries that may
be missing or that are slow to load. `acsard call stop` must leave quickly.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import re
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from copy import copy
from importlib import import_module
from types import ModuleType
from typing import NoReturn

from acsard.core.config.nearest import nearest
from acsard.core.formatting import lines
from acsard.core.values import AcsardError
from acsard.host.errors import Exit, MendableError

# Subcommands in the order of `acsard --help`; the name is the module's too.
VERBS = {
    "run": "run the daemon (the default)",
    "sim": "simulate a microcontroller on a pty, for a separate `acsard run --port …`",
    "check": "check the configuration and print it with all defaults",
    "topics": "list the robot's Zenoh keys: direction, type, rate, meaning",
    "echo": "print the messages on a Zenoh key as JSON lines",
    "get": "query a Zenoh key once and print the answer as JSON",
    "top": "show the robot's status on one screen, live",
    "fleet": "show one line per robot, live",
    "foxglove": "show the robot live in Foxglove or Lichtblick",
    "drive": "drive the robot with the keyboard",
    "move": "drive the robot a distance, or turn it by an angle, by its odometry",
    "web": "serve the robot's page: see, stop and drive the robot in a browser",
    "call": "call a service of the robot, such as stop or clear",
    "set": "change a setting of the running robot, or list the changeable settings",
    "doctor": "find problems on this machine and say how to fix them",
    "ports": "list the serial ports, the processes that use them, and the likely MCU",
    "mcu": "test the microcontroller on your own robot with its wheels lifted",
    "calibrate": "measure wheel radii and effective track width, from a guided or a recorded drive",
    "recording": "list, show, replay, export and draw recordings",
    "tls": "make the certificates that other machines need to connect to the robot",
    "router": "run a fleet's Zenoh router with its configuration file",
    "service": "install acsard as a system service, remove it, or show its status",
}

UNLISTED = ("gateway",)  # started only by systemd and `acsard run`

_EPILOG = """\
exit codes: 0 done, 1 failure, 2 wrong usage, 65 part of the recording was left out, 66 no such
port, 69 daemon unreachable, 75 port, bus address or robot id in use, 77 no permission, 78 bad
configuration

try:  acsard run                (start the robot on the built-in simulator)
      acsard drive              (in a second terminal: drive it with the keyboard)
      acsard top                (in a third terminal: show its full status on one screen)
      acsard echo odom --short  (print its position)
"""


class _Parser(argparse.ArgumentParser):
    # `parse_known_intermixed_args` is running, which may call `parse_known_args`: do not recurse.
    _intermixed = False

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        # `parse_known_args` of argparse does not accept positional arguments on both sides of an
        # option, such as `1` and `cal.csv` in `export 1 --csv cal.csv`. So if a word is unknown,
        # parse all words again with `parse_known_intermixed_args`.
        if self._intermixed:
            return super().parse_known_args(args, namespace)
        options, unknown = super().parse_known_args(args, copy(namespace))
        if unknown and self._subparsers is None:
            self._intermixed = True
            options, unknown = self.parse_known_intermixed_args(args, namespace)
            self._intermixed = False
        if unknown:
            text = f"unrecognized arguments: {' '.join(unknown)}"
            self.error(f"{text}; `{self.prog} --help` lists the options")
        return options, unknown

    def _check_value(self, action: argparse.Action, value: object) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            if action.dest == "verb":
                from acsard.cli.call import CALLABLE_SERVICES  # slow, and only this error needs it

                if value in CALLABLE_SERVICES:
                    error.message = f"invalid choice: {value!r}; type `acsard call {value}`"
                    raise
            near = nearest(str(value), map(str, action.choices or ()))
            if near:
                error.message = f"invalid choice: {value!r}; did you mean {near[0]}?"
            elif action.dest == "verb":
                error.message = f"invalid choice: {value!r}; `acsard --help` lists the subcommands"
            raise


class _Version(argparse.Action):
    # argparse's own action takes the text, for which a clone asks git, before it is needed.
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from acsard.host.version import version

        print(f"acsard {version()}")
        parser.exit()


def parser(
    called: Collection[str] = VERBS, names: Iterable[str] = (*VERBS, *UNLISTED)
) -> argparse.ArgumentParser:
    """Return the parser of `names`, with the options of the subcommands in `called` only.

    The modules of others are not imported.
    """
    whole = _Parser(
        prog="acsard",
        description="The hardware interface of a differential-drive robot with two or four driven "
        "wheels. It connects the robot's microcontroller (serial port) to a Zenoh bus. Without a "
        "subcommand, acsard runs the daemon.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    verbs = whole.add_subparsers(title="subcommands", metavar="SUBCOMMAND", dest="verb")
    for name in names:
        # argparse lists only subcommands that have a help.
        verb = verbs.add_parser(name, help=VERBS[name]) if name in VERBS else verbs.add_parser(name)
        if name in called:
            module = _module(name)
            verb.description = module.__doc__
            verb.set_defaults(main=getattr(module, "main", None))
            module.add_options(verb)
    return whole


def _module(name: str) -> ModuleType:
    try:
        return import_module(f"acsard.cli.{name}")
    except ModuleNotFoundError as error:
        if error.name != "numpy":
            raise
        # The Debian package leaves numpy to Debian. All other installations have it.
        raise MendableError(
            "this subcommand needs the library numpy: type `sudo apt install python3-numpy`"
        ) from None


def main(argv: list[str] | None = None) -> int:
    words = [_decimal(word) for word in (sys.argv[1:] if argv is None else argv)]
    known = {"-h", "--help", "--version"}
    if not words or (words[0].startswith("-") and words[0] not in known):
        words.insert(0, "run")
    code: int = Exit.OK
    try:
        try:
            is_known = words[0] in VERBS or words[0] in UNLISTED
            args = (parser(words[:1], words[:1]) if is_known else parser(())).parse_args(words)
            code = int(args.main(args))
        except AcsardError as error:
            print(f"acsard: {lines(str(error))}", file=sys.stderr)
            code = error.code if isinstance(error, MendableError) else Exit.FAILURE
        finally:
            sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError) and error.errno != errno.ENOSPC:
            raise
        # The program that reads this output (head, less) has ended, or the disk of the output or of
        # another file is full. An exit code that says what was done or judged must not be 0 then.
        if not isinstance(error, BrokenPipeError):
            with suppress(OSError):
                print(f"acsard: {error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return code or Exit.FAILURE
    except UnicodeEncodeError as error:
        print(f"acsard: an argument is not valid UTF-8: {error.object!a}", file=sys.stderr)
        return Exit.USAGE
    except KeyboardInterrupt:
        return 130
    return code


_EXPONENT = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}")


def _decimal(word: str) -> str:
    # argparse would mistake `-1e-3`, as a script may print a number, for an option.
    if not _EXPONENT.fullmatch(word):
        return word
    from decimal import Decimal

    return f"{Decimal(word):f}"


def entry() -> NoReturn:
    """Run `main`, flush the output, and end the process: the entry point of `acsard`."""
    # The process ends with `os._exit`, because Zenoh's threads may still call into Python. During a
    # normal shutdown of the interpreter, such a call would abort the process.
    _fill_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A terminal without UTF-8 shows "\u2026" instead of "…", as Python does for stderr.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = main()
    except SystemExit as end:  # argparse ends this way after --help, --version and usage errors
        code = end.code if isinstance(end.code, int) else Exit.FAILURE
    except BaseException:  # noqa: BLE001 - print the traceback as Python would
        import traceback

        traceback.print_exc()
        code = Exit.FAILURE
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass  # the stream is closed, or its disk is full
    os._exit(code)


def _fill_closed_streams() -> None:
    # Open /dev/null for each closed stream. Otherwise the serial port could get the file descriptor
    # of the closed stream, and printed text would go to the motors.
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The kernel opens a file with the lowest free descriptor. That descriptor is `number`,
            # because the loop has already filled all lower ones.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
