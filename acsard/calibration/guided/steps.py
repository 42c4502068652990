"""What a way of calibrating yields: legs to be driven, numbers to be asked for."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, TypeVar

from msgspec import Struct

from acsard.calibration.runs import Run
from acsard.calibration.solve import Calibration
from acsard.values import AcsardError

T = TypeVar("T")


class GuideError(AcsardError):
    """It cannot go on; the text says why and what to do. Nothing has been written."""


class Move(Struct, frozen=True):
    """A command held for so long."""

    seconds: float
    linear: float = 0.0
    """m/s"""
    angular: float = 0.0
    """rad/s, left is +."""


class Leg(Struct, frozen=True):
    """Moves that a person starts by Enter, and any key ends."""

    words: str
    """What the person has to see to before, and what the robot will do."""
    moves: tuple[Move, ...]
    by_key: bool = False
    """A key is how the last move is meant to end, and its time only how it ends otherwise."""

    @property
    def seconds(self) -> float:
        return sum(move.seconds for move in self.moves)


class Ask(Struct, frozen=True):
    """A number that the person reads off, within bounds."""

    words: str
    unit: str
    least: float
    most: float
    usual: float | None = None
    """What Enter alone stands for."""


Step = Leg | Ask

Way = Generator[Step, Any, Calibration]
"""Sent a `Run` for each `Leg`, a number for each `Ask`; raises `GuideError`, `LogError` and
`RefusedError`."""

Part = Generator[Step, Any, T]
"""A piece of a way."""


def ride(leg: Leg) -> Part[Run]:
    """What the wheels and sensors told of a leg."""
    run: Run = yield leg
    return run


def ask(
    words: str, unit: str, least: float, most: float, usual: float | None = None
) -> Part[float]:
    """What was read off."""
    number: float = yield Ask(words, unit, least, most, usual)
    return number
