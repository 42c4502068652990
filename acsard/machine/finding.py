"""A finding of the doctor."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")
"""Levels in the order of their numbers in ROS diagnostics, which begin with 0."""


class Finding(Struct, frozen=True):
    """The doctor's result for one subject.

    `mend` is the remedy, or advice if the level is ok. It is "" if there is neither.
    """

    subject: str
    level: Level
    text: str
    mend: str = ""
