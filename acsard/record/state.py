"""A robot between two steps -> bytes, and back: where a recording that begins later begins.

Written by pickle, which copies a robot in a fraction of a millisecond. Read by `unpickling.py`,
which makes nothing but values and the robot's own parts: what a stranger's file asks for beyond
that is refused.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections import Counter, deque
from typing import NamedTuple

from acsard.drive.modes import Mode
from acsard.guard import Memory
from acsard.messages.text import printable
from acsard.record.unpickling import unpickled
from acsard.robot import Robot
from acsard.values import AcsardError

ROOMS = (
    "acsard.values", "acsard.robot", "acsard.guard", "acsard.config.settings",
    "acsard.drive.", "acsard.mcu.",
)  # fmt: skip
"""Whose classes a robot is made of; none of them does anything when it is made."""

BESIDE: dict[tuple[str, str], type] = {
    ("collections", "Counter"): Counter,
    ("collections", "deque"): deque,
}

PROTOCOL = 5

MOST_TEXT = 200
"""Characters of what is wrong with it."""

TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
}
"""Python 3.11 before 3.11.4, Debian 12's own, writes members of an enum by `getattr`."""


MOVED = {
    "acsard.mcu.frames": "acsard.mcu.codec",
    "acsard.mcu.link": "acsard.mcu.link_state",
    "acsard.drive.lying_wheels.witness": "acsard.drive.lying_wheels.verdict",
}
"""Modules by the names that they had when older recordings were made."""


class StateError(AcsardError):
    """These bytes hold no robot, or one of other parts."""


class State(NamedTuple):
    """All that the steps to come depend on, beside what comes in."""

    robot: Robot
    memory: Memory
    """What the guard remembers."""


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Write the robot and the memory of its guard as they are now."""
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PROTOCOL)
    pickler.dispatch_table = TABLE
    pickler.dump((robot, memory))
    return written.getvalue()


def thaw(data: bytes) -> State:
    """The robot as it was; raises `StateError` if that cannot be made here."""
    try:
        made = unpickled(data, part)
    except ValueError as error:
        text = f"this version cannot read the state at its start: {short(error)}"
        raise StateError(text) from None
    match made:
        case (Robot() as robot, Memory() as memory):
            return State(robot, memory)
    raise StateError("the state at its start is not that of a robot")


def short(error: Exception) -> str:
    """Its words, which may be a stranger's."""
    return printable(str(error))[:MOST_TEXT]


def part(module: str, name: str) -> type:
    """A class that a robot has parts of; raises `ValueError` for any other.

    By its own name, and of a module that is there: nothing is imported, nothing is found by way of
    another, and what only names or raises something is none.
    """
    module = MOVED.get(module, module)
    if (module, name) in BESIDE:
        return BESIDE[module, name]
    ours = module in ROOMS or any(r.endswith(".") and module.startswith(r) for r in ROOMS)
    found = vars(sys.modules[module]).get(name) if ours and module in sys.modules else None
    if not isinstance(found, type) or found.__module__ != module or found.__name__ != name:
        raise ValueError(f"{module:.50}.{name:.50} is no part of a robot")
    return found
