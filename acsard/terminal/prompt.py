"""Defines how a subcommand asks a person, and which signals end a subcommand.

`TerminalPrompt`, `NoPrompt` and `JsonPrompt` implement the interface `Prompt`. Change all of them
together.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Protocol

from msgspec import Struct

from acsard.checkup.findings import Finding
from acsard.core.values import AcsardError
from acsard.terminal.output import has_room


class NobodyError(AcsardError):
    """A question needs an answer, but no person can be asked."""


class NumberQuestion(Struct, frozen=True):
    """A question whose answer is a number, such as a distance that a person measures by tape.

    `words` is the text of the question, and `unit` is the unit of the answer. The number must be
    from `least` to `most`.
    """

    words: str
    unit: str
    least: float
    most: float
    usual: float | None = None
    """Default, which an empty answer selects, or None without a default."""
    name: str = ""
    """Name under which the method of calibration stores the answer."""

    def number(self, text: str) -> float:
        """Return the number in the answer `text`, or the default if `text` is empty.

        The number may have a decimal comma. Raises `ValueError` with a description of valid numbers
        if the number is not valid, or if `text` is empty and a default is missing.
        """
        try:
            number = self.usual if not text else float(text.replace(",", "."))
        except ValueError:
            number = None
        if number is None or not self.least <= number <= self.most:
            raise ValueError(f"type a number in {self.unit}, from {self.least:g} to {self.most:g}")
        return number


class Prompt(Protocol):
    """Interface through which a subcommand informs and asks the person near the robot.

    Every method that asks raises `KeyboardInterrupt` if the person quits.
    """

    def begin(self, subject: str, *, simulated: bool) -> None:
        """Show `subject`, the name of the robot or board that is checked or calibrated.

        `simulated` says whether this robot or board is simulated.
        """

    def show_text(self, text: str) -> None:
        """Show a text that stays on the screen."""

    def doing(self, text: str) -> None:
        """Show the present activity. The text replaces the text of the previous call."""

    def progress(self, share: float) -> None:
        """Show the completed share of the present drive or check, from 0 to 1."""

    def show_finding(self, finding: Finding) -> None:
        """Show one finding of a check. Call this as soon as the finding is known."""

    def result(self, text: str) -> None:
        """Show the result. Call this only when nothing moves any more."""

    def offer(self, config: str | None, keys: Mapping[str, object], trouble: str = "") -> bool:
        """Offer to write settings into the configuration file, and return whether this was done.

        `config` is the path of the file, or None to search for the file. `keys` maps dotted keys of
        the configuration to values. `trouble` is a reason not to write, or "".
        """

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Ask a question. Return one of `answers`, or None if no person can choose an answer."""

    def start(self, text: str, by_key: bool = False) -> None:
        """Show a text, and wait until the person starts a drive.

        After the start, any key press stops the drive. If `by_key` is true, the person is expected
        to end the drive this way. Otherwise the drive ends by itself, and a key press aborts it.
        """

    def number(self, ask: NumberQuestion) -> float:
        """Ask for a number, and return it. Return the default of `ask` if no person can be asked.

        Raises `NobodyError` if there is neither a person nor a default.
        """

    def keys(self, wait_s: float) -> str:
        """Wait up to `wait_s` s for a key press. Return the pressed keys, or "" without a press."""


PROMPT_END_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP
"""The signals that end a subcommand that moves something.

The signal of Ctrl-Z (SIGTSTP) is one of them, because a suspended subcommand would leave a wheel
turning.
"""


@contextmanager
def ended_by_signals(notice: str = "", *, exits: bool = False) -> Iterator[None]:
    """Raise `KeyboardInterrupt` in the `with` block when one of `PROMPT_END_SIGNALS` arrives.

    Further signals are then ignored until the end of the block, so that the block's cleanup can
    send zero speeds. `notice` is printed when the signal arrives. If `exits` is true, a signal
    other than SIGINT raises `SystemExit` instead, with 128 plus the number of the signal.
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
            signal.signal(number, handler)
