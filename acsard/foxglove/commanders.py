"""What a source commands, on whichever key and in whatever encoding, as an export has it; pure.

Decoded as the daemon decodes it: what it refuses is not shown, but in its counters.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from acsard.config.settings import Config, RosConfig
from acsard.drive.kinematics import Kinematics
from acsard.incoming.commands import Arrival, Receiver, Via
from acsard.messages.schema import Time, TwistStamped
from acsard.messages.topics import source_keys
from acsard.ros.shapes import asked
from acsard.ros.transports import endpoints


class Way(Struct, frozen=True):
    """A key of the bus as the daemon takes it."""

    native: str
    """The key below the robot's id that it stands for; "*" is a certificate's name."""
    encoding: str = ""
    """Of samples that name none."""
    via: Via = "native"


def ways(key_of: Callable[[str], str], ros: RosConfig, source: str) -> dict[str, Way]:
    """Each key that this source commands on: twists, wheel speeds, and those of the ROS trees.

    `key_of` makes the full key of one below the robot's id.
    """
    native = source_keys([source])
    found = {key_of(key): Way(key) for key in (*native, *source_keys([source], "*"))}
    for one in endpoints(ros, "*"):
        if one.native in native:
            found[one.key] = Way(one.native, one.encoding, one.transport)
    return found


class Reader:
    """Commands -> messages of `cmd_vel_in/<source>`, by the robot's configuration."""

    def __init__(self, config: Config) -> None:
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._frame = config.odometry.base_frame

    def read(self, arrival: Arrival, wall_ns: int) -> TwistStamped:
        """What was asked for by what arrived at `wall_ns`; raises `DecodeError`."""
        twist = self._receiver.command(arrival).twist
        return asked(twist, Time.from_ns(wall_ns), self._frame)
