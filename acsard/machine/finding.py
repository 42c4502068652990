"""A finding of `acsard doctor`."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")
"""The levels of findings, from the mildest to the most severe. The index of a level is its number
in ROS diagnostics."""


class Finding(Struct, frozen=True):
    """One result of `acsard doctor`.

    `subject` is the examined part, and `text` is the result in words. `mend` is the advice to the
    user, or "".
    """

    subject: str
    level: Level
    text: str
    mend: str = ""
