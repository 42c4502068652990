"""Encodes a `Robot` between two steps as bytes, decodes it, and applies another configuration.

A recording begins with a robot (a run's first file may not), and has one about every 20 s, so that
a replay goes on after damage. The state is a record: the configuration in force, the parts that are
plain data (`PARTS`), and a pickle of the others. `thaw` reads that with `unpickling.py`, because a
forged file could run code through pickle. When all parts are plain data, the pickle,
`unpickling.py` and `adopt` go.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
import zlib
from collections import Counter, deque
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from acsard.core.board_inputs import BoardInputs
from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import Config
from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.link.link_diagnosis import UnansweredLines
from acsard.core.link.session import McuSession
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.motion.arbiter_text import CommandEvents
from acsard.core.motion.event_throttle import EventThrottle
from acsard.core.motion.last_line import LastLine
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.motion.modes import Mode
from acsard.core.motion.odometry import Odometry
from acsard.core.motion.sanity import Sanity
from acsard.core.robot import Robot
from acsard.core.values import AcsardError, Event, Ns, SpeedCap, Status
from acsard.recording.unpickling import MAX_BYTES, unpickle

# Attributes of a robot that are plain data, without configuration inside, with their types.
PARTS: dict[str, Any] = {
    "session": McuSession,
    "counters": Counter,
    "_last": LastLine,
    "_cap": SpeedCap,
    "_choice": Choice,
    "_arbiter": Arbiter,
    "_announced": tuple[Event, ...],
    "status": Status,
    "_refused": tuple[str, Ns] | None,
    "_asked": tuple[str, str, Ns | None],
    "_linked_once": bool,
    "_answered": UnansweredLines,
    "_odometry": Odometry,
    "_sanity": Sanity,
    "_inputs": BoardInputs,
    "_told": CommandEvents,
    "_life": Lifecycle,
    "_tally": EventThrottle,
}

# Not stored: they follow from the configuration, and no line is pending between two steps.
DERIVED = ("config", "link_setup", "_kinematics", "_errors", "_steady")

# A package ends with a dot. The classes need constructors without side effects.
PART_MODULES = (
    "acsard.core.values", "acsard.core.codes", "acsard.core.config.settings",
    "acsard.core.motion.", "acsard.core.link.",
)  # fmt: skip

# Classes by module and name.
OTHER_PARTS: dict[tuple[str, str], type] = {
    ("collections", "Counter"): Counter,
    ("collections", "deque"): deque,
}

PICKLE_PROTOCOL = 5  # read by `unpickling.py`

MAX_ERROR_LENGTH = 200  # characters of an error's text

# Python before 3.11.4 would encode a mode as a call of `getattr`, which `unpickling.py` refuses.
# Here it is a call of `Mode`.
DISPATCH_TABLE = copyreg.dispatch_table | {
    Mode: lambda mode: (Mode, (mode.value,)),
}


class StateError(AcsardError):
    """The recorded state of a robot is damaged, or this version of acsard cannot use it."""


class LayoutError(StateError):
    """The parts of the recorded robot are other ones than in this version of acsard."""


class State(NamedTuple):
    """The state of a robot between two steps, which with the inputs gives all later outputs."""

    robot: Robot
    memory: Memory  # of the guard


class Frozen(Struct):
    """The fields that `freeze` encodes."""

    config: Config  # in force
    memory: Memory
    parts: dict[str, msgspec.Raw]
    rest: bytes  # pickled attributes of the robot
    layout: int = 0  # `LAYOUT` of the version that wrote it


def _layout() -> int:
    # The fields of all parts with their types. A description is no difference.
    def bare(item: object) -> object:
        if isinstance(item, dict):
            return {key: bare(value) for key, value in item.items() if key != "description"}
        return [bare(value) for value in item] if isinstance(item, list | tuple) else item

    schemas, components = msgspec.json.schema_components(
        PARTS.values(), schema_hook=lambda kind: {"type": kind.__name__}
    )
    parts = dict(zip(PARTS, schemas, strict=True))
    return zlib.crc32(msgspec.json.encode(bare([parts, components]), order="deterministic"))


LAYOUT = _layout()


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Encode the state of a robot and of its guard, for `thaw`."""
    rest = {name: part for name, part in vars(robot).items() if name not in DERIVED}
    parts = {name: msgspec.Raw(msgspec.msgpack.encode(rest.pop(name))) for name in PARTS}
    written = io.BytesIO()
    pickler = pickle.Pickler(written, PICKLE_PROTOCOL)
    pickler.dispatch_table = DISPATCH_TABLE
    pickler.dump(rest)
    return msgspec.msgpack.encode(Frozen(robot.config, memory, parts, written.getvalue(), LAYOUT))


class _Written(Struct):
    layout: int = 0


_frozen, _written = msgspec.msgpack.Decoder(Frozen), msgspec.msgpack.Decoder(_Written)


def _counter(kind: type, data: object) -> Counter[str]:
    return kind(msgspec.convert(data, dict[str, int]))  # type: ignore[no-any-return]


_parts = {name: msgspec.msgpack.Decoder(part, dec_hook=_counter) for name, part in PARTS.items()}


def thaw(data: bytes) -> State:
    """Decode a robot and its guard's memory, from bytes that may be forged.

    Raises `LayoutError`, and `StateError` if it is damaged or forged.
    """
    try:
        if len(data) > MAX_BYTES:
            raise ValueError(f"it has {len(data)} bytes: the file is damaged or forged")
        if _written.decode(data).layout != LAYOUT:
            raise LayoutError("the recorded robot has another layout than this version of acsard")
        frozen = _frozen.decode(data)
        if problems := contradictions(frozen.config):
            raise ValueError(problems[0])
        robot = Robot(frozen.config)
        for name, raw in frozen.parts.items():
            if name in PARTS:
                setattr(robot, name, _parts[name].decode(raw))
        rest = unpickle(frozen.rest, part_class)
    except (ValueError, RecursionError) as error:  # msgspec's errors are a `ValueError`
        raise _unreadable(error) from None
    if not isinstance(rest, dict):
        raise StateError("the recorded state of the robot is not valid")
    for name in vars(robot).keys() - PARTS.keys() - {*DERIVED}:
        # What an older version has not recorded is as in a new robot.
        if name in rest:
            setattr(robot, name, rest[name])
    return State(robot, frozen.memory)


def _unreadable(error: Exception) -> StateError:
    return StateError(
        f"this version of acsard cannot read the recorded state of the robot: {short(error)}"
    )


def short(error: Exception) -> str:
    """Return the text of an error without control characters, cut to `MAX_ERROR_LENGTH`."""
    # The text may quote a forged file.
    return printable(str(error))[:MAX_ERROR_LENGTH]


def part_class(module: str, name: str) -> type:
    """Return a class that may be a part of a robot, for `unpickle`; this imports nothing.

    Raises `ValueError`.
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

    An attribute that differs from `begun`, a new robot with the recorded configuration, keeps its
    value. Others get that of `other`, a new robot with the new one, which must not be used later.
    """
    _Walk().into(robot, begun, other)


class _Walk:
    # Walks through the three robots of `adopt()` and changes each part of the first once.
    def __init__(self) -> None:
        self._visited: dict[int, Any] = {}  # by `id()`, which the reference keeps valid

    def into(self, now: Any, begun: Any, other: Any) -> None:
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
        """Return the new value of an attribute; parts of `now` may change in place."""
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
