"""The control period as a value: what its timer tells and the control loop hears."""

from __future__ import annotations

from msgspec import Struct


class Period(Struct, frozen=True):
    """`expired` periods ended since the last look (0: none), the first of them due at `due_ns`."""

    expired: int
    due_ns: int


NO_PERIOD = Period(0, 0)
"""None has ended: something else was the reason to look."""
