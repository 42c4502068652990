"""Encodes a `Robot` between two steps as bytes, and decodes such bytes.

The module also applies another configuration to a decoded robot. A recording file begins with an
encoded robot; only the first file of a run of the daemon may begin without one. About every 20 s a
file contains another encoded robot, so that a replay can go on after a damaged place.

`freeze` uses pickle, which takes a fraction of a millisecond. `thaw` uses `unpickling.py` instead,
because a forged file could run code through pickle.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections import Counter, deque
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta, Struct

from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.motion.modes import Mode
from acsard.core.robot import Robot
from acsard.core.values import AcsardError
from acsard.recording.unpickling import unpickle

PART_MODULES = (
    "acsard.core.values", "acsard.core.robot", "acsard.core.guard", "acsard.core.config.settings",
    "acsard.core.motion.", "acsard.core.link.",
)  # fmt: skip
"""Names of the modules and packages whose classes may be parts of a robot. The name of a package
ends with a dot. A class in these modules must have a constructor without side effects."""

OTHER_PARTS: dict[tuple[str, str], type] = {
    ("collections", "Counter"): Counter,
    ("collections", "deque"): deque,
}
"""Maps the pair (module name, class name) to each further class that may be a part of a robot."""

PICKLE_PROTOCOL = 5
"""Version of the pickle format that `unpickling.py` reads."""

MAX_ERROR_LENGTH = 200
"""Number of characters to which the text of an error is cut."""

# Without this table, Python 3.11 before 3.11.4, as in Debian 12, would encode a mode as a call of
# `getattr`, which `unpickling.py` refuses.
DISPATCH_TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
}
"""Dispatch table for pickle. It encodes a mode as a call of `Mode` with the mode's value."""


class StateError(AcsardError):
    """The recorded state of a robot is damaged, or this version of acsard cannot use this state."""


class State(NamedTuple):
    """The complete state of a robot between two control steps.

    The state and the inputs of the following steps determine all outputs of these steps.
    """

    robot: Robot
    memory: Memory
    """Memory of the guard, which checks the robot's lines to the board."""


class Checkpoint(Struct, frozen=True, array_like=True):
    """The saved state of a robot between two control steps, and the number of the next step.

    A recording contains checkpoints as messages on the channel `state`.
    """

    number: Annotated[int, Meta(ge=0)]
    """Number of the step that follows the saved state."""
    data: bytes
    """The robot and the memory of its guard, encoded by `freeze`."""

    def encode(self) -> bytes:
        """Return the content of a message on the channel `state`, in MessagePack."""
        return msgspec.msgpack.encode(self)


_checkpoint = msgspec.msgpack.Decoder(Checkpoint)


def checkpoint(data: bytes) -> Checkpoint:
    """Decode a message of the channel `state` of a recording.

    The robot in the checkpoint stays encoded; `thaw` decodes it. Raises `StateError` if the message
    is damaged.
    """
    try:
        return _checkpoint.decode(data)
    except msgspec.MsgspecError as error:
        raise _unreadable(error) from None


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Encode the state of a robot, and the memory of the guard that checks its lines to the board.

    `thaw` decodes the result.
    """
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PICKLE_PROTOCOL)
    pickler.dispatch_table = DISPATCH_TABLE
    pickler.dump((robot, memory))
    return written.getvalue()


def thaw(data: bytes) -> State:
    """Decode a robot and its guard's memory, which `freeze` has encoded. The bytes may be forged.

    Raises `StateError` if the bytes are damaged or forged, or if another version of acsard encoded
    them and this version cannot use them.
    """
    try:
        made = unpickle(data, part_class)
    except ValueError as error:
        raise _unreadable(error) from None
    match made:
        case (Robot() as robot, Memory() as memory):
            return State(robot, memory)
    raise StateError("the robot state at the start of the recording is not valid")


def _unreadable(error: Exception) -> StateError:
    return StateError(
        "this version of acsard cannot read the robot state at the start of the recording: "
        f"{short(error)}"
    )


def short(error: Exception) -> str:
    """Return the text of an error without control characters.

    The text has at most `MAX_ERROR_LENGTH` characters.
    """
    # The text may quote a forged file.
    return printable(str(error))[:MAX_ERROR_LENGTH]


def part_class(module: str, name: str) -> type:
    """Return the class with the name `name` in the module `module`, for `unpickle`.

    Raises `ValueError` if objects of this class cannot be parts of a robot, or if `module` does not
    define this class. Also raises `ValueError` if `module` is not loaded, because this function
    imports nothing.
    """
    if (module, name) in OTHER_PARTS:
        return OTHER_PARTS[module, name]
    ours = module in PART_MODULES or any(
        r.endswith(".") and module.startswith(r) for r in PART_MODULES
    )
    part = vars(sys.modules[module]).get(name) if ours and module in sys.modules else None
    if not isinstance(part, type) or part.__module__ != module or part.__name__ != name:
        raise ValueError(f"{module:.50}.{name:.50} is not a class of a robot's state")
    return part


PLAIN_TYPES = (bool, int, float, str, bytes, type(None))


def adopt(robot: Robot, begun: Robot, other: Robot) -> None:
    """Change the configuration of a recorded robot, in place.

    The recorded run has changed an attribute if its values in `robot` and `begun` differ. Such an
    attribute keeps its value. Every other attribute gets its value from `other`.

    Args:
        robot: the recorded robot, which is changed.
        begun: a new robot with the recorded configuration, as `robot` was before the run.
        other: a new robot with the new configuration. Do not use it later, because `robot` may
            share objects with it.
    """
    _Walk().into(robot, begun, other)


class _Walk:
    """Does the work of `adopt()`: walks through its three robots at the same time.

    It visits each part of the recorded robot once, and changes it.
    """

    def __init__(self) -> None:
        self._visited: dict[int, Any] = {}
        """Maps the `id()` of each visited object to the object. A reference keeps the object alive,
        so that no other object gets the same `id()`."""

    def into(self, now: Any, begun: Any, other: Any) -> None:
        """Change the attributes of the object `now` as `adopt()` describes.

        `now`, `begun` and `other` are the same part of the three robots of `adopt()`.
        """
        if id(now) in self._visited:
            return
        self._visited[id(now)] = now
        for name in _names(other):
            new = getattr(other, name)
            # Another version of acsard may have recorded the robot without this attribute.
            if not hasattr(now, name):
                setattr(now, name, new)
                continue
            recorded = getattr(now, name)
            merged = self.merged(recorded, getattr(begun, name, recorded), new)
            if merged is not recorded:
                setattr(now, name, merged)

    def merged(self, now: Any, begun: Any, other: Any) -> Any:
        """Return the new value of an attribute. Parts of `now` may be changed in place.

        `now`, `begun` and `other` are the values of the attribute in the three robots of `adopt()`.
        """
        if type(now) is not type(other):
            return other if _same(now, begun) else now
        match now:
            case dict():
                for key, new in other.items():
                    recorded = now.get(key, new)
                    now[key] = self.merged(recorded, begun.get(key, recorded), new)
                return now
            case list() | tuple() if len(now) == len(begun) == len(other):
                parts = [self.merged(*three) for three in zip(now, begun, other, strict=True)]
                if all(a is b for a, b in zip(parts, now, strict=True)):
                    return now
                return parts if isinstance(now, list) else type(now)(parts)
            case list() | tuple() | set() | frozenset() | deque() | msgspec.Struct():
                return other if now == begun else now
            case _ if isinstance(now, PLAIN_TYPES):
                return other if _same(now, begun) else now
        if _names(now):
            self.into(now, begun, other)
        return now


def _same(now: Any, begun: Any) -> bool:
    return type(now) is type(begun) and bool(now == begun)


def _names(item: object) -> list[str]:
    slots = [name for kind in type(item).__mro__ for name in getattr(kind, "__slots__", ())]
    names = [*getattr(item, "__dict__", ()), *slots]
    return [name for name in names if hasattr(item, name)]
