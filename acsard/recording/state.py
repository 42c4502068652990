"""Encodes a robot between two steps as bytes, and decodes it, for files that begin during a drive.

`freeze` uses pickle, which copies a robot in a fraction of a millisecond. `thaw` uses
`unpickling.py`, which makes only values and the robot's own parts, and refuses anything else that a
forged file asks for.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections import Counter, deque
from typing import NamedTuple

from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.motion.modes import Mode
from acsard.core.robot import Robot
from acsard.core.values import AcsardError
from acsard.recording.unpickling import unpickled

ROOMS = (
    "acsard.core.values", "acsard.core.robot", "acsard.core.guard", "acsard.core.config.settings",
    "acsard.core.motion.", "acsard.core.link.",
)  # fmt: skip
"""Modules and packages that define the parts of a robot. Making an instance of such a class runs
no code with effects elsewhere.
"""

BESIDE: dict[tuple[str, str], type] = {
    ("collections", "Counter"): Counter,
    ("collections", "deque"): deque,
}

PROTOCOL = 5

MOST_TEXT = 200
"""Largest number of characters of an error's text."""

TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
}
"""Extra reducers. Python 3.11 before 3.11.4, as in Debian 12, pickles enum members through
`getattr`, which `unpickling.py` refuses.
"""


class StateError(AcsardError):
    """Bytes that do not hold a robot, or hold one that this version cannot make."""


class State(NamedTuple):
    """Everything besides the inputs that the next steps depend on."""

    robot: Robot
    memory: Memory
    """Memory of the guard."""


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Encode the robot and the memory of its guard as they are now."""
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PROTOCOL)
    pickler.dispatch_table = TABLE
    pickler.dump((robot, memory))
    return written.getvalue()


def thaw(data: bytes) -> State:
    """Decode a robot and its guard's memory.

    Raises `StateError` if this version cannot make them.
    """
    try:
        made = unpickled(data, part)
    except ValueError as error:
        text = f"this version cannot read the state at its start: {short(error)}"
        raise StateError(text) from None
    match made:
        case (Robot() as robot, Memory() as memory):
            return State(robot, memory)
    raise StateError("the state at its start is not the state of a robot")


def short(error: Exception) -> str:
    """Return the error's text, bounded and printable: it may quote a forged file."""
    return printable(str(error))[:MOST_TEXT]


def part(module: str, name: str) -> type:
    """Return the class of a part of a robot.

    Raises `ValueError` for any other name. The class must have been defined in that module under
    that name, and the module must be loaded already: nothing is imported. Re-exported names,
    functions and attributes of attributes are refused.
    """
    if (module, name) in BESIDE:
        return BESIDE[module, name]
    ours = module in ROOMS or any(r.endswith(".") and module.startswith(r) for r in ROOMS)
    found = vars(sys.modules[module]).get(name) if ours and module in sys.modules else None
    if not isinstance(found, type) or found.__module__ != module or found.__name__ != name:
        raise ValueError(f"{module:.50}.{name:.50} is not a part of a robot")
    return found
