"""Asks a person at a terminal, or answers questions itself if no person can be asked.

Questions and texts go to standard error. Findings and the result go to standard output, so that
they can be redirected.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Self

from rich.table import Table
from rich.text import Text

from acsard.checkup.findings import Finding
from acsard.terminal.output import MAX_TEXT_WIDTH, has_room, show, table
from acsard.terminal.prompt import NobodyError, NumberQuestion

BAR_WIDTH = 30

QUIT_KEY = "q"


COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red", "SKIPPED": "bright_black"}


class Screen:
    """Shows the output of a subcommand that asks questions.

    On a terminal, the present activity is a line that the next output overwrites. If `as_json` is
    true, only texts and questions are shown, because the subcommand prints one JSON object as its
    result.
    """

    def __init__(self, as_json: bool = False) -> None:
        self._as_json = as_json
        self._on = sys.stderr.isatty() and not as_json
        self._visible = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._clear()

    def begin(self, subject: str, *, simulated: bool) -> None:
        if not self._as_json:
            print(subject, flush=True)

    def show_text(self, text: str) -> None:
        self._print(f"\n{_wrapped(text)}\n")

    def doing(self, text: str) -> None:
        if self._on and has_room(sys.stderr):
            # Cut the line and never wrap it, because a wrapped line cannot be overwritten.
            self._print(f"\r\033[K{f'   ... {text}'[: _columns() - 1]}")
            self._visible = True

    def show_finding(self, finding: Finding) -> None:
        if not self._as_json:
            self._clear()
            show(row(finding), most=MAX_TEXT_WIDTH)

    def result(self, text: str) -> None:
        self._clear()
        print(text)

    def offer(self, config: str | None, keys: Mapping[str, object], trouble: str = "") -> bool:
        """Return False, and do not ask. At a terminal, the option `--write` changes the file."""
        return False

    def _clear(self) -> None:
        if self._visible:
            self._print("\r\033[K")
            self._visible = False

    def _print(self, text: str) -> None:
        print(text, end="", file=sys.stderr, flush=True)


class NoPrompt(Screen):
    """Prompt that does not ask a person, but answers the questions itself.

    It confirms each question that has only one possible answer, starts every drive without a wait,
    and returns the default of each number. Other questions get no answer.
    """

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        return answers[0] if len(answers) == 1 else None

    def start(self, text: str, by_key: bool = False) -> None:
        self.show_text(text)

    def number(self, ask: NumberQuestion) -> float:
        if ask.usual is None:
            raise NobodyError(
                "this calibration method needs a person who measures: run it without --yes"
            )
        return ask.usual

    def keys(self, wait_s: float) -> str:
        select.select([], [], [], wait_s)
        return ""

    def progress(self, share: float) -> None:
        """Show nothing."""


class TerminalPrompt(Screen):
    """Prompt that asks a person on standard error and reads the answers from standard input.

    Outside the context `host.terminal_modes.single_key_mode`, a key press takes effect only after
    Enter. Use that context if a single key press must stop the robot.
    """

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """Ask a question until the person types one of `answers`, and return this answer.

        Raises `KeyboardInterrupt` if the person types "q", or if standard input ends.
        """
        self._clear()
        choice = f" [{'/'.join((*answers, QUIT_KEY))}]" if len(answers) > 1 else ""
        with _lines() if sys.stdin.isatty() else nullcontext():
            # A line that was typed before the question appeared must not answer it.
            _forget_input()
            while True:
                self._print(f"\n{question}{choice} ")
                line = _line()
                word = line.strip().lower()
                if not line or word == QUIT_KEY:
                    raise KeyboardInterrupt
                if word in answers:
                    return word
                self._print(f"   please type {' or '.join(answers)}; {QUIT_KEY} quits\n")

    def start(self, text: str, by_key: bool = False) -> None:
        self.show_text(text)
        # Keys that were pressed before the text appeared must not start anything.
        _forget_input()
        self.show_text("Enter starts this drive, then any key stops it; q quits.")
        while True:
            pressed = _read()
            if not pressed.strip("\r\n"):
                return
            if QUIT_KEY in pressed:
                raise KeyboardInterrupt

    def number(self, ask: NumberQuestion) -> float:
        with _lines():
            _forget_input()
            while True:
                self._print(f"\n{_wrapped(ask.words)}\n{ask.unit}: ")
                line = _read().strip()
                if line == QUIT_KEY:
                    raise KeyboardInterrupt
                try:
                    return ask.number(line)
                except ValueError as error:
                    self.show_text(f"{error} (q quits)")

    def keys(self, wait_s: float) -> str:
        return _read() if select.select([sys.stdin], [], [], wait_s)[0] else ""

    def progress(self, share: float) -> None:
        # A terminal that does not read, for example over a connection that hangs, must not keep a
        # key from stopping the robot.
        if sys.stderr.isatty() and has_room(sys.stderr):
            done = round(BAR_WIDTH * share)
            bar = "#" * done + "." * (BAR_WIDTH - done)
            self._print(f"\r[{bar}] any key stops {'' if share < 1.0 else chr(10)}")


def row(finding: Finding) -> Table:
    """Return a table that shows a finding: verdict, name, measurement, meaning and remedy."""
    verdict = Text(f"{finding.verdict:<7}", COLOURS[finding.verdict])
    below = [finding.text, f"-> {finding.mend}" if finding.mend else ""]
    head = f"{finding.name:<22} {finding.figure}"
    return table([(verdict, head), *(("", text) for text in below if text)], gap=1)


@contextmanager
def _quits_if_closed() -> Iterator[None]:
    """Raise `KeyboardInterrupt` if the terminal has been closed."""
    try:
        yield
    except (OSError, termios.error):
        raise KeyboardInterrupt from None


@_quits_if_closed()
def _read() -> str:
    read = os.read(sys.stdin.fileno(), 256)
    if not read:
        raise KeyboardInterrupt
    return read.decode(errors="replace")


@_quits_if_closed()
def _line() -> str:
    try:
        return sys.stdin.readline()
    except UnicodeDecodeError:
        return "?\n"  # not an answer to any question


@_quits_if_closed()
def _forget_input() -> None:
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


@contextmanager
def _lines() -> Iterator[None]:
    """Let the terminal deliver and echo whole lines of input in the `with` block."""
    with _quits_if_closed():
        before = termios.tcgetattr(sys.stdin)
        cooked = list(before)
        # Python 3.12.0 and 3.12.1 clear ICRNL in `tty.setcbreak`. Then Enter would not end a line.
        cooked[0] |= termios.ICRNL
        cooked[3] |= termios.ICANON | termios.ECHO
        termios.tcsetattr(sys.stdin, termios.TCSANOW, cooked)
    try:
        yield
    finally:
        # The terminal may have been closed.
        with suppress(OSError, termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSANOW, before)


def _columns() -> int:
    """Return the width of the terminal at stderr, or 80 if stderr is not a terminal."""
    with suppress(OSError):
        return os.get_terminal_size(sys.stderr.fileno()).columns or 80
    return 80


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, min(_columns(), MAX_TEXT_WIDTH)))
