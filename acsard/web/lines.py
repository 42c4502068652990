"""What a check or a calibration says with `--json-lines`, one object a line; pure.

In this room since the robot's page hands them on and describes them for programs (openapi.py); the
other way they are `json_lines.Line`.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup.findings import Finding


class Subject(Struct, frozen=True):
    """First of all: what it is about."""

    subject: str
    simulated: bool


class Told(Struct, frozen=True):
    """What stays."""

    told: str


class Doing(Struct, frozen=True):
    """What happens now."""

    doing: str


class Progress(Struct, frozen=True):
    """So much of the leg or of the check is done, 0 to 1."""

    progress: float


class Question(Struct, frozen=True, omit_defaults=True, kw_only=True):
    """What is asked: one of the answers, or a number where there are none."""

    question: int
    """Its answer has this number."""
    words: str
    answers: Sequence[str] = ()
    unit: str = ""
    least: float | None = None
    most: float | None = None
    usual: float | None = None
    """What no value stands for."""
    leg: bool = False
    """With its answer the robot drives; a key stops it."""
    by_key: bool = False
    """A key is how the leg is meant to end."""
    wrong: str = ""
    """What the answer before has to be and is not."""


class Found(Struct, frozen=True):
    """Of a check, as it is made."""

    finding: Finding


class Result(Struct, frozen=True):
    """All that was found, as at a terminal; nothing moves any more."""

    result: str
