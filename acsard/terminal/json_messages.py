"""The lines that a check or a calibration prints with `--json-lines`, one JSON object each.

The page's server relays the lines and describes them for programs (`web/openapi.py`). The lines in
the other direction are `json_prompt.Line`.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup.findings import Finding


class Subject(Struct, frozen=True):
    """The first line: the tested subject."""

    subject: str
    simulated: bool


class JobMessage(Struct, frozen=True):
    """A message that stays on the screen."""

    message: str


class Doing(Struct, frozen=True):
    """The current activity; the next one replaces it."""

    doing: str


class Progress(Struct, frozen=True):
    """Completed share of the leg or of the check, 0 to 1."""

    progress: float


class Question(Struct, frozen=True, omit_defaults=True, kw_only=True):
    """A question. The reply is one of `answers`, or a number if `answers` is empty."""

    question: int
    """Number that the answer must quote."""
    words: str
    answers: Sequence[str] = ()
    unit: str = ""
    least: float | None = None
    most: float | None = None
    usual: float | None = None
    """Default for an empty answer."""
    leg: bool = False
    """True if the robot drives after the answer; a key press stops it."""
    by_key: bool = False
    """True if a key press is the intended end of the leg."""
    wrong: str = ""
    """Explanation of why the previous answer was rejected."""


class Found(Struct, frozen=True):
    """One finding of a check, sent as soon as it is made."""

    finding: Finding


class Result(Struct, frozen=True):
    """The complete result as printed at a terminal; nothing moves any more."""

    result: str
