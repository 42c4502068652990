"""Interfaces that the check needs: a serial line, and an operator at the robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Wire(Protocol):
    """A serial line."""

    def open(self, baud_rate: int) -> None:
        """Open the line, or continue at another rate. Raises a `MendableError`."""

    def close(self) -> None:
        """Send the last bytes and close the line."""

    def now_ns(self) -> int:
        """Return the monotonic time, ns."""

    def send(self, data: bytes) -> None:
        """Send bytes now. Raises `WireLostError`."""

    def late_ns(self) -> int:
        """Return how long the board has waited for a processor since the last call, ns.

        It is 0 unless the board is a program on this computer.
        """

    def listen(self, until_ns: int) -> Sequence[tuple[int, bytes]]:
        """Wait until this time and return the received pieces with their times, ns.

        Raises `WireLostError`.
        """


class Operator(Protocol):
    """The operator at the robot."""

    def say(self, text: str) -> None:
        """Show a message about the present action."""

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Return one of the answers, or None if no person watches the robot."""
