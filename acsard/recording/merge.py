"""Applies another configuration to a recorded robot, to replay a drive from its middle with it.

Three robots are compared attribute by attribute:

1. the recorded robot, in the middle of a drive;
2. a new robot with the recorded configuration;
3. a new robot with the other configuration.

If an attribute of the recorded robot still equals that of the second robot, it takes the value of
the third. If the drive has changed the attribute, it keeps its value. The classes of the robot need
no code for this.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import msgspec

from acsard.core.robot import Robot

PLAIN = (bool, int, float, str, bytes, type(None))


def adopt(robot: Robot, begun: Robot, other: Robot) -> None:
    """Apply another configuration to the recorded robot `robot`, in place.

    Args:
        robot: the recorded robot.
        begun: a new robot with the recorded configuration.
        other: a new robot with the other configuration. `robot` may share parts with it afterwards.
    """
    _Walk().into(robot, begun, other)


class _Walk:
    """Walks through the objects of the three robots together, and visits each object once."""

    def __init__(self) -> None:
        self._visited: dict[int, Any] = {}
        """Visited objects with their `id`. The reference keeps the object alive, and its `id`
        unique.
        """

    def into(self, now: Any, begun: Any, other: Any) -> None:
        """Merge each attribute of the object `now` in place."""
        if id(now) in self._visited:
            return
        self._visited[id(now)] = now
        for name in _names(other):
            new = getattr(other, name)
            # Another version recorded the robot without this attribute. Take it from a new robot.
            if not hasattr(now, name):
                setattr(now, name, new)
                continue
            recorded = getattr(now, name)
            merged = self.merged(recorded, getattr(begun, name, recorded), new)
            if merged is not recorded:
                setattr(now, name, merged)

    def merged(self, now: Any, begun: Any, other: Any) -> Any:
        """Return the merged value: `now`, perhaps with changed parts, or `other`.

        `now`, `begun` and `other` are the same attribute of the three robots.
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
    """Return the names of an object's own attributes."""
    slots = [name for kind in type(item).__mro__ for name in getattr(kind, "__slots__", ())]
    names = [*getattr(item, "__dict__", ()), *slots]
    return [name for name in names if hasattr(item, name)]
