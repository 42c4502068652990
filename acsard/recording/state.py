"""Encodes a `Robot` between two steps, decodes it, and applies another configuration to it.

When a run of the daemon begins a second or later file, the file begins with an encoded robot. Every
file contains further encoded robots, about one every 20 s, so that a replay can go on after a
damaged place.

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
"""Names of modules and packages whose classes may be parts of a robot. The name of a package ends
with a dot. The constructors of these classes have no side effects."""

OTHER_PARTS: dict[tuple[str, str], type] = {
    ("collections", "Counter"): Counter,
    ("collections", "deque"): deque,
}
"""Other classes that may be parts of a robot. Each key is the pair (module name, class name)."""

PROTOCOL = 5
"""Version of the pickle format that `unpickling.py` reads."""

MAX_TEXT = 200
"""Number of characters to which the text of an error is cut."""

TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
}
"""Dispatch table with which pickle encodes a mode as a call of `Mode` with the mode's value.

Python 3.11 before 3.11.4, as in Debian 12, would encode a call of `getattr`, which `unpickling.py`
refuses.
"""


class StateError(AcsardError):
    """The saved state of a robot is damaged, or this version of acsard cannot use it."""


class State(NamedTuple):
    """The state between two control steps: a robot, and the memory of the guard of its lines.

    If two runs of the control steps begin with equal states and receive equal inputs, they produce
    equal outputs.
    """

    robot: Robot
    memory: Memory


class Checkpoint(Struct, frozen=True, array_like=True):
    """The saved state of a robot between two control steps.

    It is the content of one message on the channel `state` of a recording.
    """

    number: Annotated[int, Meta(ge=0)]
    """Number of the step that follows the saved state."""
    data: bytes
    """The robot and its guard's memory, encoded by `freeze`."""

    def encode(self) -> bytes:
        return msgspec.msgpack.encode(self)


_checkpoint = msgspec.msgpack.Decoder(Checkpoint)


def checkpoint(data: bytes) -> Checkpoint:
    """Decode a message of the channel `state`, but not the robot in it.

    Raises `StateError` if the message is damaged.
    """
    try:
        return _checkpoint.decode(data)
    except msgspec.MsgspecError as error:
        raise StateError(
            "this version of acsard cannot read the robot state at the start of the recording: "
            f"{short(error)}"
        ) from None


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Encode the robot and the memory of its guard as they are now."""
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PROTOCOL)
    pickler.dispatch_table = TABLE
    pickler.dump((robot, memory))
    return written.getvalue()


def thaw(data: bytes) -> State:
    """Decode a robot and its guard's memory; raise `StateError` if this is not possible."""
    try:
        made = unpickle(data, part_class)
    except ValueError as error:
        text = (
            "this version of acsard cannot read the robot state at the start of the recording: "
            f"{short(error)}"
        )
        raise StateError(text) from None
    match made:
        case (Robot() as robot, Memory() as memory):
            return State(robot, memory)
    raise StateError("the robot state at the start of the recording is not valid")


def short(error: Exception) -> str:
    """Return the text of an error, shortened and printable, because it may quote a forged file."""
    return printable(str(error))[:MAX_TEXT]


def part_class(module: str, name: str) -> type:
    """Return the class `name` of the module `module` if it may be a part of a robot.

    Raises `ValueError` if the module is not loaded, or if `name` is anything else: for example a
    function, a class that the module imports, or an attribute of an attribute. This function
    imports nothing.
    """
    if (module, name) in OTHER_PARTS:
        return OTHER_PARTS[module, name]
    ours = module in PART_MODULES or any(
        r.endswith(".") and module.startswith(r) for r in PART_MODULES
    )
    found = vars(sys.modules[module]).get(name) if ours and module in sys.modules else None
    if not isinstance(found, type) or found.__module__ != module or found.__name__ != name:
        raise ValueError(f"{module:.50}.{name:.50} is not a class of a robot's state")
    return found


PLAIN = (bool, int, float, str, bytes, type(None))


def adopt(robot: Robot, begun: Robot, other: Robot) -> None:
    """Apply another configuration to the recorded robot `robot`, in place.

    The three robots are compared attribute by attribute. If an attribute of `robot` still equals
    that of `begun`, it gets the value from `other`. If the recorded run has changed the attribute,
    it keeps its value.

    Args:
        robot: the recorded robot.
        begun: a new robot with the recorded configuration.
        other: a new robot with the other configuration. Afterwards `robot` may share parts with
            `other`.
    """
    _Walk().into(robot, begun, other)


class _Walk:
    """Walks through the three robots of `adopt()`, and visits each of their objects once."""

    def __init__(self) -> None:
        self._visited: dict[int, Any] = {}
        """Maps the `id()` of each visited object to this object, which stays alive so that its
        `id()` stays unique."""

    def into(self, now: Any, begun: Any, other: Any) -> None:
        """Merge the attributes of three corresponding objects into `now`, in place.

        `now` is a part of the recorded robot, and `begun` and `other` of the two new robots.
        """
        if id(now) in self._visited:
            return
        self._visited[id(now)] = now
        for name in _names(other):
            new = getattr(other, name)
            # Another version may have recorded the robot without this attribute. The new robot has
            # it.
            if not hasattr(now, name):
                setattr(now, name, new)
                continue
            recorded = getattr(now, name)
            merged = self.merged(recorded, getattr(begun, name, recorded), new)
            if merged is not recorded:
                setattr(now, name, merged)

    def merged(self, now: Any, begun: Any, other: Any) -> Any:
        """Return the merged value of an attribute, given its value in each of the three robots.

        The result is `now`, perhaps with changed parts, or `other`.
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
            case _ if isinstance(now, PLAIN):
                return other if _same(now, begun) else now
        if _names(now):
            self.into(now, begun, other)
        return now


def _same(now: Any, begun: Any) -> bool:
    return type(now) is type(begun) and bool(now == begun)


def _names(item: object) -> list[str]:
    """Return the names of the attributes that the object stores, without class attributes."""
    slots = [name for kind in type(item).__mro__ for name in getattr(kind, "__slots__", ())]
    names = [*getattr(item, "__dict__", ()), *slots]
    return [name for name in names if hasattr(item, name)]
