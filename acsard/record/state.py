"""A robot between two steps -> bytes, and back: where a recording that begins later begins.

Written by pickle, which copies a robot in a fraction of a millisecond. Read by one that makes
nothing but values and the robot's own parts: what a stranger's file asks for beyond that is
refused.
"""

from __future__ import annotations

import copyreg
import io
import pickle
from typing import Any, NamedTuple

from acsard.drive.modes import Mode, Trigger
from acsard.robot import Robot
from acsard.values import AcsardError

ROOMS = ("acsard.values", "acsard.robot", "acsard.config.settings", "acsard.drive.", "acsard.mcu.")
"""Whose classes a robot is made of; none of them does anything when it is made."""

BESIDE = {("collections", "Counter"), ("collections", "deque")}

PROTOCOL = 5

TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
    Trigger: lambda trigger: (Trigger, (trigger.value,)),
}
"""Python 3.11 before 3.11.4, Debian 12's own, writes members of an enum by `getattr`."""


class StateError(AcsardError):
    """These bytes hold no robot, or one of other parts."""


class State(NamedTuple):
    """All that the steps to come depend on, beside what comes in."""

    robot: Robot
    last: bytes
    """The line that went last: the guard compares with it."""


def freeze(robot: Robot, last: bytes) -> bytes:
    """The robot as it is now."""
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PROTOCOL)
    pickler.dispatch_table = TABLE
    pickler.dump((robot, last))
    return written.getvalue()


def thaw(data: bytes) -> State:
    """The robot as it was; raises `StateError` if that cannot be made here."""
    try:
        robot, last = _Reader(io.BytesIO(data)).load()
    except Exception as error:  # noqa: BLE001 - pickle raises whatever its bytes lead to
        raise StateError(f"this version cannot read the state at its start: {error}") from None
    if not isinstance(robot, Robot) or not isinstance(last, bytes):
        raise StateError("the state at its start is not that of a robot")
    return State(robot, last)


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """A class of ours by its own name, no function, nothing found by way of another."""
        ours = module in ROOMS or any(r.endswith(".") and module.startswith(r) for r in ROOMS)
        if "." in name or not (ours or (module, name) in BESIDE):
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a robot")
        found = super().find_class(module, name)
        at_home = isinstance(found, type) and found.__module__ == module
        if not at_home:
            raise pickle.UnpicklingError(f"{module}.{name} is not a class of that module")
        return found
