"""A finding of `acsard doctor`."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")
"""The levels of findings, from mild to severe. The index of a level is also its number in ROS
diagnostics."""


class Finding(Struct, frozen=True):
    """One result of `acsard doctor`.

    `subject` is the name of the examined part, `text` is the result in words, and `mend` is the
    advice to the user, or "" if no advice is needed.
    """

    subject: str
    level: Level
    text: str
    mend: str = ""
