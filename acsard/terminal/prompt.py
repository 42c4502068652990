"""Asks a person at a terminal, or answers questions itself, and ends a subcommand by signals.

Questions and texts go to standard error. Findings and the result go to standard output, so that
they can be redirected.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from types import FrameType
from typing import Self

from msgspec import Struct
from rich.table import Table
from rich.text import Text

from acsard.checkup.findings import Finding
from acsard.core.values import AcsardError
from acsard.terminal.output import MAX_TEXT_WIDTH, has_room, show, table

BAR_WIDTH = 30

QUIT_KEY = "q"

COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red", "SKIPPED": "bright_black"}

# They end a subcommand that moves something: also Ctrl-Z (SIGTSTP), because a suspended
# subcommand would leave a wheel turning.
PROMPT_END_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP


class NobodyError(AcsardError):
    """A question needs an answer, but no person can be asked."""


class NumberQuestion(Struct, frozen=True):
    """A question whose answer is a number from `least` to `most`, such as a measured distance."""

    words: str
    unit: str
    least: float
    most: float
    usual: float | None = None  # for an empty answer
    name: str = ""  # under which a method stores the answer

    def number(self, text: str) -> float:
        """Return the number of an answer, which may have a decimal comma, or the default.

        Raises `ValueError` with a description of valid numbers.
        """
        if not text and self.usual is not None:
            return self.usual
        try:
            number = float(text.replace(",", "."))
        except ValueError:
            number = None
        if number is None or not self.least <= number <= self.most:
            raise ValueError(f"type a number in {self.unit}, from {self.least:g} to {self.most:g}")
        return number


class Prompt:
    """Shows the output of a subcommand, and answers its questions without a person.

    It confirms a question with only one answer, starts drives without a wait, and returns defaults.
    If `as_json` is true, it shows only texts and questions, because the result is one JSON object.
    """

    def __init__(self, as_json: bool = False) -> None:
        self._as_json = as_json
        self._on = sys.stderr.isatty() and not as_json
        self._visible = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._clear()

    def begin(self, subject: str) -> None:
        if not self._as_json:
            print(subject, flush=True)

    def show_text(self, text: str) -> None:
        self._print(f"\n{_wrapped(text)}\n")

    def instruct(self, text: str) -> None:
        """Show what the person must do, if there is one."""

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

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Return one of `answers`, or None if no person can choose an answer."""
        return answers[0] if len(answers) == 1 else None

    def start(self, text: str) -> None:
        """Show a text, and wait until the person starts a drive, which any key press then stops."""
        self.show_text(text)

    def number(self, ask: NumberQuestion) -> float:
        """Raise `NobodyError` if there is neither a person nor a default."""
        if ask.usual is None:
            raise NobodyError(
                "this calibration method needs a person who measures: run it without --yes"
            )
        return ask.usual

    def keys(self, wait_s: float) -> str:
        """Wait for a key press. Return the pressed keys, or "" without a press."""
        select.select([], [], [], wait_s)
        return ""

    def progress(self, share: float) -> None:
        """Show the completed share of the present drive, from 0 to 1."""

    def _clear(self) -> None:
        if self._visible:
            self._print("\r\033[K")
            self._visible = False

    def _print(self, text: str) -> None:
        print(text, end="", file=sys.stderr, flush=True)


class TerminalPrompt(Prompt):
    """Asks a person on standard error, and reads the answers from standard input.

    A key press takes effect only after Enter, unless `host.terminal_modes.single_key_mode` is
    active.
    """

    def ask(self, question: str, answers: Sequence[str]) -> str:
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
                if len(names := word.split()) > 1:
                    word = "".join(name[0] for name in names)  # "front right" is fr
                near = [answer for answer in answers if answer.startswith(word)]
                if word in answers:
                    return word
                if len(near) == 1 < len(answers):
                    return near[0]
                self._print(f"   please type {' or '.join(answers)}; {QUIT_KEY} quits\n")

    def instruct(self, text: str) -> None:
        self.show_text(text)

    def start(self, text: str) -> None:
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
            done = int(BAR_WIDTH * share)  # full only at the end, when keys do nothing more
            bar = "#" * done + "." * (BAR_WIDTH - done)
            after = "any key stops " if share < 1.0 else "\033[K\n"
            self._print(f"\r[{bar}] {after}")


def row(finding: Finding) -> Table:
    """Return a table of a finding: verdict, name, measurement, meaning and remedy."""
    verdict = Text(f"{finding.verdict:<7}", COLOURS[finding.verdict])
    below = [finding.text, f"-> {finding.mend}" if finding.mend else ""]
    head = f"{finding.name:<22} {finding.figure}"
    return table([(verdict, head), *(("", text) for text in below if text)], gap=1)


@contextmanager
def _quits_if_closed() -> Iterator[None]:
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
    with suppress(OSError):
        return os.get_terminal_size(sys.stderr.fileno()).columns or 80
    return 80


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, min(_columns(), MAX_TEXT_WIDTH)))


@contextmanager
def ended_by_signals(
    notice: str = "", *, exits: bool = False, restores: bool = True
) -> Iterator[None]:
    """Raise `KeyboardInterrupt` in the `with` block when one of `PROMPT_END_SIGNALS` arrives.

    `notice` is then printed, and further signals are ignored until the end of the block, so that it
    can send zeros. If `exits` is true, a signal other than SIGINT raises `SystemExit` with 128 plus
    its number. If `restores` is false, signals stay ignored after the block.
    """
    before = [signal.getsignal(number) for number in PROMPT_END_SIGNALS]

    def end(number: int, frame: FrameType | None) -> None:
        for each in PROMPT_END_SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        # If the program that started this one is gone or does not read, printing would fail or
        # block. The zero speeds must not wait for that.
        with suppress(OSError, ValueError):
            if notice and has_room(sys.stderr):
                print(f"\n{notice}", file=sys.stderr)
        if exits and number != signal.SIGINT:
            raise SystemExit(128 + number)
        raise KeyboardInterrupt

    for number in PROMPT_END_SIGNALS:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in zip(PROMPT_END_SIGNALS, before, strict=True):
            signal.signal(number, handler if restores else signal.SIG_IGN)
