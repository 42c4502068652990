"""What the check needs from outside: a serial line, and a person at the robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Wire(Protocol):
    """A serial line."""

    def open(self, baud_rate: int) -> None:
        """Open the line, or go on at another rate; raises a `MendableError`."""

    def close(self) -> None:
        """Let the last bytes out, and close."""

    def now_ns(self) -> int:
        """The monotonic time."""

    def send(self, data: bytes) -> None:
        """Put bytes on the line now; raises `WireLostError`."""

    def late_ns(self) -> int:
        """For how long the board, where it is a program of this computer, has waited for a
        processor since this was asked last; else 0."""

    def listen(self, until_ns: int) -> Sequence[tuple[int, bytes]]:
        """Wait until then; what came, in pieces with their times. Raises `WireLostError`."""


class Operator(Protocol):
    """The person at the robot."""

    def say(self, text: str) -> None:
        """Tell what happens now."""

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """One of the answers; None when nobody is there who sees it."""
