"""The prompts of a calibration: a person at this terminal, or nobody.

`json_lines.py` has the prompts that go to a program.
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Protocol

from acsard.calibration.guided.legs import Ask, GuideError

COLUMNS = 88
BAR = 30

LEAVES = "q"


class Attendant(Protocol):
    """Interface of the prompts. All output goes to standard error."""

    def say(self, text: str) -> None:
        """Print a text."""

    def start(self, text: str, by_key: bool = False) -> None:
        """Return when the leg may begin.

        Raises `KeyboardInterrupt` if the person leaves. `by_key` says that a key press is the
        intended end of the leg.
        """

    def number(self, ask: Ask) -> float:
        """Return the number that the person read off.

        Raises `KeyboardInterrupt` if the person leaves, and `GuideError` if nobody can measure.
        """

    def keys(self, wait_s: float) -> str:
        """Return the keys that were pressed; wait up to `wait_s` s for the first one."""

    def progress(self, share: float) -> None:
        """Show which share of the leg is done, 0 to 1."""


class Nobody:
    """Prompt without a person: it agrees to every leg and measures nothing.

    It is for the simulator.
    """

    def say(self, text: str) -> None:
        _print(text)

    def start(self, text: str, by_key: bool = False) -> None:
        _print(text)

    def number(self, ask: Ask) -> float:
        if ask.usual is None:
            raise GuideError("this way needs a person who measures: leave --yes out")
        return ask.usual

    def keys(self, wait_s: float) -> str:
        select.select([], [], [], wait_s)
        return ""

    def progress(self, share: float) -> None:
        pass


class Person:
    """Terminal prompt on standard input: single keys while the robot drives, lines otherwise."""

    def __init__(self) -> None:
        self._input = sys.stdin.fileno()

    def say(self, text: str) -> None:
        _print(text)

    def start(self, text: str, by_key: bool = False) -> None:
        import termios

        _print(text)
        # Keys that were pressed before the text appeared must not start anything.
        termios.tcflush(self._input, termios.TCIFLUSH)
        _print("Enter starts it, any key then stops it; q leaves.", end="\n")
        while True:
            pressed = self._read()
            if not pressed.strip("\r\n"):
                return
            if LEAVES in pressed:
                raise KeyboardInterrupt

    def number(self, ask: Ask) -> float:
        import termios

        with _lines(self._input):
            termios.tcflush(self._input, termios.TCIFLUSH)
            while True:
                print(f"\n{_wrapped(ask.words)}\n{ask.unit}: ", end="", file=sys.stderr, flush=True)
                line = self._read().strip()
                if line == LEAVES:
                    raise KeyboardInterrupt
                number = number_of(line, ask.usual)
                if ask.least <= number <= ask.most:
                    return number
                _print(f"a number of {ask.unit} from {ask.least:g} to {ask.most:g} (q leaves)")

    def keys(self, wait_s: float) -> str:
        return self._read() if select.select([self._input], [], [], wait_s)[0] else ""

    def progress(self, share: float) -> None:
        if sys.stderr.isatty():
            done = round(BAR * share)
            bar = "#" * done + "." * (BAR - done)
            end = "\n" if share >= 1.0 else ""
            print(f"\r[{bar}] any key stops ", end=end, file=sys.stderr, flush=True)

    def _read(self) -> str:
        read = os.read(self._input, 256)
        # The terminal has been closed.
        if not read:
            raise KeyboardInterrupt
        return read.decode(errors="replace")


@contextmanager
def attending() -> Iterator[Person]:
    """Yield a terminal prompt that reads single keys, and restore the terminal at the end."""
    from acsard.host.terminal_modes import one_by_one

    with one_by_one():
        yield Person()


@contextmanager
def interrupted_by(numbers: Sequence[signal.Signals]) -> Iterator[None]:
    """End the block on these signals as on Ctrl-C, so that zeros are sent.

    The caller passes SIGTSTP (Ctrl-Z) too, because a suspended program would leave the robot
    driving. A second signal does not disturb the zeros.
    """

    def end(number: int, frame: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = [signal.signal(number, end) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def _lines(terminal: int) -> Iterator[None]:
    """Read whole lines from the terminal, and echo them while they are typed."""
    import termios

    before = termios.tcgetattr(terminal)
    cooked = termios.tcgetattr(terminal)
    cooked[3] |= termios.ICANON | termios.ECHO
    termios.tcsetattr(terminal, termios.TCSANOW, cooked)
    try:
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSANOW, before)


def number_of(line: str, usual: float | None) -> float:
    """Return the typed number, the default for an empty answer, or NaN if it is not a number."""
    if not line and usual is not None:
        return usual
    try:
        return float(line.replace(",", "."))
    except ValueError:
        return math.nan


def _print(text: str, end: str = "\n") -> None:
    print(f"\n{_wrapped(text)}", end=end, file=sys.stderr, flush=True)


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, COLUMNS))
