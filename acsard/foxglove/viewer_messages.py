"""The form in which a viewer receives the sources' commands, the daemon's events and its settings.

This module is pure.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from msgspec import Struct

from acsard.config.live import flat, live
from acsard.config.settings import Config, RosConfig
from acsard.drive.kinematics import Kinematics
from acsard.incoming.commands import Arrival, Receiver, Via
from acsard.messages.schema import Events, Happening, Time, TwistStamped
from acsard.messages.topics import source_keys
from acsard.ros.shapes import Log, asked, log
from acsard.ros.transports import endpoints


class Way(Struct, frozen=True):
    """How the daemon interprets samples on one key of the bus."""

    native: str
    """The native key below the robot's id that the key stands for; "*" is the name of a
    certificate."""
    encoding: str = ""
    """Encoding of samples that do not name one."""
    via: Via = "native"


def ways(key_of: Callable[[str], str], ros: RosConfig, source: str) -> dict[str, Way]:
    """Return each key on which this source accepts commands: twists, wheel speeds and the ROS keys.

    `key_of` returns the full key for a key below the robot's id.
    """
    native = source_keys([source])
    found = {key_of(key): Way(key) for key in (*native, *source_keys([source], "*"))}
    for one in endpoints(ros, "*"):
        if one.native in native:
            found[one.key] = Way(one.native, one.encoding, one.transport)
    return found


class Reader:
    """Converts commands to messages of `cmd_vel_in/<source>`, by the robot's configuration.

    Commands come from any key of a source and in any encoding, and are decoded exactly as the
    daemon decodes them. A command that the daemon refuses is not shown; it appears in the daemon's
    counters. `acsard log export` writes the same messages.
    """

    def __init__(self, config: Config) -> None:
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._frame = config.odometry.base_frame

    def read(self, arrival: Arrival, wall_ns: int) -> TwistStamped:
        """Return the twist of a command that arrived at `wall_ns` (wall clock).

        Raises `DecodeError`.
        """
        twist = self._receiver.command(arrival).twist
        return asked(twist, Time.from_ns(wall_ns), self._frame)


class News:
    """Remembers the total count, the stamp and the content of the last event list."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._told: list[Happening] = []

    def of(self, events: Events) -> list[Log]:
        """Return the new events as log lines.

        After a restart of the daemon, return all events that it still knows.
        """
        known, told, stamp_ns = self._total, self._told, events.stamp.to_ns()
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # an older answer that arrived after a published list
            known, told = 0, []  # the daemon was restarted
        self._total, self._stamp_ns, self._told = events.total, stamp_ns, events.events
        new = min(events.total - known, len(events.events))
        last = events.events[len(events.events) - new :]
        # An event that lasts counts several times in the total but appears once in the list.
        return [log(one, one.stamp) for one in last if one not in told]


def parameter_values(config: object) -> dict[str, Any]:
    """Return the settings that can be changed at run time, by key, tuples as lists."""
    found = ((key, value) for key, value in flat(config) if live(key))
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found}


def selected(known: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the settings with these names, or all of them if `names` is empty."""
    return {key: value for key, value in known.items() if key in names or not names}


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings whose value has changed."""
    return {key: value for key, value in now.items() if before.get(key) != value}
