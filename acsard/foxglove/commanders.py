"""Commands of a source, from any of its keys and in any encoding, as
`acsard recording export` writes them.

This module is pure. It decodes commands exactly as the daemon does. A command that the daemon
refuses is not shown; it appears in the daemon's counters.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from acsard.core.config.settings import Config, RosConfig
from acsard.core.incoming.commands import Arrival, Receiver, Via
from acsard.core.messages.schema import Time, TwistStamped
from acsard.core.messages.topics import source_keys
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.shapes import asked
from acsard.core.ros.transports import endpoints


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
    """Converts commands to messages of `cmd_vel_in/<source>`, by the robot's configuration."""

    def __init__(self, config: Config) -> None:
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._frame = config.odometry.base_frame

    def read(self, arrival: Arrival, wall_ns: int) -> TwistStamped:
        """Return the twist of a command that arrived at `wall_ns` (wall clock).

        Raises `DecodeError`.
        """
        twist = self._receiver.command(arrival).twist
        return asked(twist, Time.from_ns(wall_ns), self._frame)
