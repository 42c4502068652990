"""The control period as a value, passed from the timer to the control loop."""

from __future__ import annotations

from msgspec import Struct


class Period(Struct, frozen=True):
    """The periods that ended since the last step, 0 if none.

    The first of them was due at `due_ns`.
    """

    expired: int
    due_ns: int


NO_PERIOD = Period(0, 0)
"""The value for a step that another event than the timer caused."""
