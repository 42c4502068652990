"""Encodes a `Robot` between two steps as bytes, and decodes it, maybe with another configuration.

A recording begins with a robot (a run's first file may not), and has one about every 20 s, so that
a replay goes on after damage. The state is a record of plain data: the configuration in force, the
guard's memory and the parts of the robot. Forged bytes can only give wrong numbers.
"""

from __future__ import annotations

import zlib
from collections import Counter
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
from acsard.core.motion.consistency import ConsistencyChecks
from acsard.core.motion.event_throttle import EventThrottle
from acsard.core.motion.last_line import LastLine
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.motion.odometry import Odometry
from acsard.core.motion.sanity import Sanity
from acsard.core.robot import Robot
from acsard.core.values import AcsardError, Event, Ns, SpeedCap, Status

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
    "_checks": ConsistencyChecks,
    "_sanity": Sanity,
    "_inputs": BoardInputs,
    "_told": CommandEvents,
    "_life": Lifecycle,
    "_tally": EventThrottle,
}

# Not stored: they follow from the configuration or from the next step, and no line is pending
# between two steps.
DERIVED = (
    "config", "link_setup", "_kinematics", "_errors", "_steady",
    "_until_ns", "_silence", "_is_watched",
)  # fmt: skip

MAX_BYTES = 1 << 20  # usually 8 000 to 30 000, more with many senders

MAX_ERROR_LENGTH = 200  # characters of an error's text


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
    parts = {name: msgspec.Raw(msgspec.msgpack.encode(getattr(robot, name))) for name in PARTS}
    return msgspec.msgpack.encode(Frozen(robot.config, memory, parts, LAYOUT))


class _Written(Struct):
    layout: int = 0


_frozen, _written = msgspec.msgpack.Decoder(Frozen), msgspec.msgpack.Decoder(_Written)


def _counter(kind: type, data: object) -> Counter[str]:
    return kind(msgspec.convert(data, dict[str, int]))  # type: ignore[no-any-return]


_parts = {name: msgspec.msgpack.Decoder(part, dec_hook=_counter) for name, part in PARTS.items()}


def thaw(data: bytes, config: Config | None = None) -> State:
    """Decode a robot and its guard's memory, from bytes that may be forged.

    `config` replaces the configuration that was in force. Raises `LayoutError`, and `StateError` if
    it is damaged or forged.
    """
    try:
        if len(data) > MAX_BYTES:
            raise ValueError(f"it has {len(data)} bytes: the file is damaged or forged")
        if _written.decode(data).layout != LAYOUT:
            raise LayoutError("the recorded robot has another layout than this version of acsard")
        frozen = _frozen.decode(data)
        if problems := contradictions(frozen.config):
            raise ValueError(problems[0])
        robot = Robot(config or frozen.config)
        for name, raw in frozen.parts.items():
            if name in PARTS:
                setattr(robot, name, _parts[name].decode(raw))
    except (ValueError, RecursionError) as error:  # msgspec's errors are a `ValueError`
        raise _unreadable(error) from None
    return State(robot, frozen.memory)


def _unreadable(error: Exception) -> StateError:
    return StateError(
        f"this version of acsard cannot read the recorded state of the robot: {short(error)}"
    )


def short(error: Exception) -> str:
    """Return the text of an error without control characters, cut to `MAX_ERROR_LENGTH`."""
    # The text may quote a forged file.
    return printable(str(error))[:MAX_ERROR_LENGTH]
