"""A finding of `acsard doctor`."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
# Mild to severe; the index is the number in ROS diagnostics.
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")


class Finding(Struct, frozen=True):
    """One result of `acsard doctor`, with advice in `mend` if any is needed."""

    subject: str
    level: Level
    text: str
    mend: str = ""
