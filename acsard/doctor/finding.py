"""What the doctor says of one thing."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")
"""As diagnostics number them."""


class Finding(Struct, frozen=True):
    """One thing that was looked at; `mend` is what to do, or can be done where it is ok."""

    subject: str
    level: Level
    text: str
    mend: str = ""
