"""The steps that a method of calibration yields: legs to drive and numbers to ask for."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, TypeVar

from msgspec import Struct

from acsard.calibration.runs import Run
from acsard.calibration.solve import Calibration
from acsard.values import AcsardError

T = TypeVar("T")


class GuideError(AcsardError):
    """End of a guided drive that cannot continue. The text says why and what to do.

    Nothing has been written.
    """


class Move(Struct, frozen=True):
    """A command that is held for a time."""

    seconds: float
    linear: float = 0.0
    """Linear speed, m/s."""
    angular: float = 0.0
    """Turn rate, rad/s, positive to the left."""


class Leg(Struct, frozen=True):
    """A series of moves that a person starts with Enter and stops with any key."""

    words: str
    """Instructions to the person, and an announcement of the moves."""
    moves: tuple[Move, ...]
    by_key: bool = False
    """Whether a key press is the normal end of the last move, whose duration is then a timeout."""

    @property
    def seconds(self) -> float:
        return sum(move.seconds for move in self.moves)


class Ask(Struct, frozen=True):
    """A number within bounds that the person reads off."""

    words: str
    unit: str
    least: float
    most: float
    usual: float | None = None
    """The number that Enter alone stands for, or None."""


Step = Leg | Ask

Way = Generator[Step, Any, Calibration]
"""A method of calibration.

It is sent a `Run` for each `Leg` and a number for each `Ask`. Raises `GuideError`, `LogError` and
`RefusedError`.
"""

Part = Generator[Step, Any, T]
"""A part of a method, with a result of its own."""


def ride(leg: Leg) -> Part[Run]:
    """Yield a leg and return its recording."""
    run: Run = yield leg
    return run


def ask(
    words: str, unit: str, least: float, most: float, usual: float | None = None
) -> Part[float]:
    """Yield a question and return the number that the person read off."""
    number: float = yield Ask(words, unit, least, most, usual)
    return number
