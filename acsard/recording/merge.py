"""Applies another configuration to a recorded robot state, to replay the drive with it.

Three robots take part: the recorded one in the middle of a drive, a new one with the recording's
configuration, and a new one with the other configuration. A part of the recorded robot that still
equals the second takes its value from the third. A part that has changed since keeps its value. No
part of a robot needs code for this.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec

from acsard.core.robot import Robot

PLAIN = (bool, int, float, str, bytes, type(None))


def adopt(robot: Robot, begun: Robot, other: Robot) -> None:
    """Change `robot` in place.

    `begun` is a new robot of the recording's configuration, and `other` one of the other
    configuration.
    """
    _Walk().into(robot, begun, other)


class _Walk:
    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}
        """Visited objects by `id`. The reference keeps each alive, so its `id` stays unique."""

    def into(self, now: Any, begun: Any, other: Any) -> None:
        """Merge each attribute of an object."""
        if id(now) in self._seen:
            return
        self._seen[id(now)] = now
        for name in _names(other):
            theirs = getattr(other, name)
            # The recording is of another version. Start with the value of a new robot.
            if not hasattr(now, name):
                setattr(now, name, theirs)
                continue
            mine = getattr(now, name)
            merged = self.merged(mine, getattr(begun, name, mine), theirs)
            if merged is not mine:
                setattr(now, name, merged)

    def merged(self, now: Any, begun: Any, other: Any) -> Any:
        """Return the merged value: `now`, perhaps with changed parts, or `other`."""
        if type(now) is not type(other):
            return other if _same(now, begun) else now
        match now:
            case dict():
                for key, theirs in other.items():
                    mine = now.get(key, theirs)
                    now[key] = self.merged(mine, begun.get(key, mine), theirs)
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


def _names(thing: object) -> list[str]:
    """Return the names of an object's own attributes."""
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    named = [*getattr(thing, "__dict__", ()), *slots]
    return [name for name in named if hasattr(thing, name)]
