"""Encodes a `Robot` between two steps as bytes, and decodes it, maybe with another configuration.

A recording begins with a robot (a run's first file may not), and has one about every 20 s, so that
a replay goes on after damage. The bytes contain the configuration in force, the guard's memory and
the `State` of the robot. Forged bytes can only give wrong numbers.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import msgspec
from msgspec import Struct

from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import Config
from acsard.core.formatting import printable
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.robot_memory import State
from acsard.core.values import AcsardError

MAX_BYTES = 1 << 20  # usually 8 000 to 30 000, more with many senders

MAX_ERROR_LENGTH = 200  # characters of an error's text


class StateError(AcsardError):
    """The recorded state of a robot is damaged, or this version of acsard cannot use it."""


class LayoutError(StateError):
    """The recorded state has other fields than in this version of acsard."""


class Restored(NamedTuple):
    """A robot between two steps and its guard, which with the inputs give all later outputs."""

    robot: Robot
    memory: Memory


class Frozen(Struct):
    """The fields that `freeze` encodes."""

    config: Config  # in force
    memory: Memory
    state: State
    layout: int = 0  # `LAYOUT` of the version that wrote it


def layout_of(kind: type[Struct]) -> int:
    """Return a checksum of all fields with their types; descriptions do not count."""

    def bare(item: object) -> object:
        if isinstance(item, dict):
            return {key: bare(value) for key, value in item.items() if key != "description"}
        return [bare(value) for value in item] if isinstance(item, list | tuple) else item

    schema = msgspec.json.schema(kind)
    return zlib.crc32(msgspec.json.encode(bare(schema), order="deterministic"))


LAYOUT = layout_of(State)


def freeze(robot: Robot, memory: Memory) -> bytes:
    """Encode the state of a robot and of its guard, for `thaw`."""
    return msgspec.msgpack.encode(Frozen(robot.config, memory, robot.state, LAYOUT))


class _Written(Struct):
    layout: int = 0


_frozen, _written = msgspec.msgpack.Decoder(Frozen), msgspec.msgpack.Decoder(_Written)


def thaw(data: bytes, config: Config | None = None) -> Restored:
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
        return Restored(Robot(config or frozen.config, state=frozen.state), frozen.memory)
    except (ValueError, RecursionError) as error:  # msgspec's errors are a `ValueError`
        raise _unreadable(error) from None


def _unreadable(error: Exception) -> StateError:
    return StateError(
        f"this version of acsard cannot read the recorded state of the robot: {short(error)}"
    )


def short(error: Exception) -> str:
    """Return the text of an error without control characters, cut to `MAX_ERROR_LENGTH`."""
    # The text may quote a forged file.
    return printable(str(error))[:MAX_ERROR_LENGTH]
