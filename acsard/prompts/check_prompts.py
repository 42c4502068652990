"""The prompts of a check: a person at the terminal, or nobody; and the signals that end the check.

`json_lines.py` has the prompts that go to a program.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Self

from acsard.host.errors import Exit, ExitError

if TYPE_CHECKING:
    from acsard.checkup.checkup_report import Report
    from acsard.checkup.findings import Finding
    from acsard.prompts.json_lines import JsonPerson

SIMULATOR = "sim"

LEAVES = "q"


class Screen:
    """Output of a check.

    Findings go to standard output one by one, or all together as one JSON object. The present
    activity is a line on the terminal that the next output overwrites. It is left out if standard
    error is a pipe, and for JSON output.
    """

    def __init__(self, as_json: bool = False) -> None:
        self._as_json = as_json
        self._on = sys.stderr.isatty() and not as_json
        self._shown = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.clear()

    def begin(self, subject: str, *, simulated: bool) -> None:
        """Print the subject of the check."""
        if not self._as_json:
            print(subject, flush=True)

    def found(self, finding: Finding) -> None:
        """Print a finding as it is made."""
        from acsard.checkup.checkup_report import row
        from acsard.terminal.output import SENTENCES, show

        if not self._as_json:
            self.clear()
            show(row(finding), most=SENTENCES)

    def result(self, found: Report, where: str) -> None:
        """Print the summary of all findings."""
        import msgspec

        from acsard.checkup.checkup_report import summary

        self.clear()
        print(msgspec.json.encode(found).decode() if self._as_json else summary(found, where))

    def say(self, text: str) -> None:
        """Show the present activity."""
        if self._on:
            # Cut the line and never wrap it, because a wrapped line cannot be overwritten.
            room = (os.get_terminal_size(sys.stderr.fileno()).columns or 80) - 1
            print(f"\r\033[K{f'   ... {text}'[:room]}", end="", file=sys.stderr, flush=True)
            self._shown = True

    def clear(self) -> None:
        """Erase the activity line before other output."""
        if self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
            self._shown = False

    def offer(self, config: str | None, keys: Mapping[str, object]) -> bool:
        """Return False: at a terminal the option --write changes the file."""
        return False


class Person(Screen):
    """Terminal prompt. It asks on standard error, so that the findings can be redirected."""

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """Return one of the answers; q, or the end of the input, ends the check."""
        self.clear()
        choice = f" [{'/'.join((*answers, LEAVES))}]" if len(answers) > 1 else ""
        while True:
            print(f"\n{question}{choice} ", end="", file=sys.stderr, flush=True)
            line = sys.stdin.readline()
            word = line.strip().lower()
            if not line or word == LEAVES:
                raise KeyboardInterrupt
            if word in answers:
                return word
            print(f"   please type {' or '.join(answers)}; {LEAVES} leaves", file=sys.stderr)


class Nobody(Screen):
    """Prompt without a person. It confirms what the command line allows, and sees no wheel turn."""

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Return the only answer as a confirmation, or None if the question needs an observer."""
        return answers[0] if len(answers) == 1 else None


def answering(args: argparse.Namespace, port: str) -> Person | Nobody | JsonPerson:
    """Return the prompt for these options.

    Raises `ExitError` unless a person can answer, or nothing real can move.
    """
    if port == SIMULATOR and args.port != SIMULATOR:
        raise ExitError(
            Exit.USAGE,
            "no port is configured, so there is no board to check (mcu.port is the simulator, "
            '"sim"): `acsard ports` lists the serial devices, then `acsard mcu check --port '
            "DEVICE`; `--port sim` checks the built-in simulator",
        )
    if args.json_lines:
        from acsard.prompts.json_lines import JsonPerson

        if args.yes:
            raise ExitError(
                Exit.USAGE, "--yes asks nobody, and --json-lines a program: one of both"
            )
        return JsonPerson()
    if not args.yes:
        if not sys.stdin.isatty():
            raise ExitError(
                Exit.USAGE,
                "mcu check turns the wheels and asks a person who sees them: run it in a "
                "terminal; `--yes` without one is for the simulator (--port sim)",
            )
        return Person(args.json)
    if port == SIMULATOR or args.wheels_are_lifted or not os.path.exists(port):
        return Nobody(args.json)
    from acsard.host.processes import master_of

    master = master_of(port)
    if master is None or master.name != "acsard":
        what = f"a pty of {master.name}" if master else "no simulator of acsard's"
        raise ExitError(
            Exit.USAGE,
            f"{port} is {what}: a robot may be behind it, and --yes would turn its wheels without "
            "a question. Leave --yes out; or lift the wheels, stay with the robot, and add "
            "--wheels-are-lifted",
        )
    return Nobody(args.json)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """End the check on signals by an exception, so that zeros are sent; ignore further signals."""
    # Ctrl-Z is included because a suspended check would leave a wheel turning.
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
    before = [signal.getsignal(number) for number in numbers]

    def end(number: int, frame: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        # The program that started the check may be gone, or it may not read. The zeros must not
        # wait.
        with suppress(OSError, ValueError):
            if select.select([], [sys.stderr], [], 0.0)[1]:
                print("\nstopping: zeros go out, then the port is closed", file=sys.stderr)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
