"""The interface `Prompt`, and the signals that end a subcommand that asks a person.

Change the implementations of the interface together: `TerminalPrompt`, `NoPrompt` and `JsonPrompt`.
"""

from __future__ import annotations

import select
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Protocol

from msgspec import Struct

from acsard.checkup.findings import Finding
from acsard.core.values import AcsardError


class NobodyError(AcsardError):
    """No person is there to answer a question."""


class Ask(Struct, frozen=True):
    """A question whose answer is a number within bounds, such as a tape measurement."""

    words: str
    unit: str
    least: float
    most: float
    usual: float | None = None
    """Default, which an empty answer selects; None if there is no default."""
    name: str = ""
    """Name under which the method of calibration stores the answer."""

    def number(self, text: str) -> float:
        """Return the number in an answer, which may have a decimal comma.

        Raises `ValueError` with a description of valid numbers.
        """
        try:
            number = self.usual if not text else float(text.replace(",", "."))
        except ValueError:
            number = None
        if number is None or not self.least <= number <= self.most:
            raise ValueError(f"type a number in {self.unit}, from {self.least:g} to {self.most:g}")
        return number


class Prompt(Protocol):
    """Interface through which a subcommand asks the person near the robot.

    Every method that asks raises `KeyboardInterrupt` if the person quits. A leg is one drive of a
    guided calibration, which the person starts and any key stops.
    """

    def begin(self, subject: str, *, simulated: bool) -> None:
        """Show which robot or board the subcommand checks or calibrates."""

    def say(self, text: str) -> None:
        """Show a text that stays visible."""

    def doing(self, text: str) -> None:
        """Show a text about the present activity, which replaces the text of the last call."""

    def progress(self, share: float) -> None:
        """Show the completed share of the present drive or check, 0 to 1."""

    def found(self, finding: Finding) -> None:
        """Show a finding of a check, as soon as it is made."""

    def result(self, text: str) -> None:
        """Show the result. The caller promises that nothing moves any more."""

    def offer(self, config: str | None, keys: Mapping[str, object], trouble: str = "") -> bool:
        """Offer to write the settings `keys` into the configuration file.

        Return whether they were written. `config` is the file's path, or None to search for it.
        `trouble` is a reason not to write, or "".
        """

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Ask the question. Return one of `answers`, or None if no person is there to choose."""

    def start(self, text: str, by_key: bool = False) -> None:
        """Show the text, and wait until the person starts a drive.

        `by_key` is true if a key press is the intended end of this drive.
        """

    def number(self, ask: Ask) -> float:
        """Ask the question, and return the number, or the default of `ask` if no person is there.

        Raises `NobodyError` if there is neither a person nor a default.
        """

    def keys(self, wait_s: float) -> str:
        """Wait up to `wait_s` s for a key press; return the pressed keys, or "" if none."""


SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP
"""The signals that end a subcommand that moves something. The signal of Ctrl-Z is among them,
because a suspended subcommand would leave a wheel turning."""


@contextmanager
def ended_by_signals(says: str = "", *, exits: bool = False) -> Iterator[None]:
    """Raise `KeyboardInterrupt` in the `with` block on any of `SIGNALS`; ignore further signals.

    The cleanup of the block can then send zero speeds. `says` is printed when a signal arrives. If
    `exits` is true, a signal other than that of Ctrl-C raises `SystemExit` with the exit code of
    that signal instead.
    """
    before = [signal.getsignal(number) for number in SIGNALS]

    def end(number: int, frame: FrameType | None) -> None:
        for each in SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        # If the program that started this one is gone or does not read, printing would fail or
        # block. The zero speeds must not wait for that.
        with suppress(OSError, ValueError):
            if says and select.select([], [sys.stderr], [], 0.0)[1]:
                print(f"\n{says}", file=sys.stderr)
        if exits and number != signal.SIGINT:
            raise SystemExit(128 + number)
        raise KeyboardInterrupt

    for number in SIGNALS:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)
