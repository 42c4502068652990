"""A finding of `acsard doctor`."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")
"""The levels, in order of severity. The index of a level is its number in ROS diagnostics."""


class Finding(Struct, frozen=True):
    """Result of `acsard doctor` for one subject. `mend` is the advice to the user, or ""."""

    subject: str
    level: Level
    text: str
    mend: str = ""
