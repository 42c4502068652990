"""The table of topics for a file or a live viewer: name, ROS type, and the struct that is encoded.

Every topic is CDR with its message definition (MCAP's `ros2msg`). Foxglove, Lichtblick and
PlotJuggler read any such type. `ros2 bag play` refuses a file in which any topic has another
encoding. ROS has no message for `state`, so it has a type of its own package. `ros2 bag play`
reports that it leaves out this topic, and the other programs show it. Names and types that exist in
the ROS tree come from `transports.py`.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any

from msgspec import Struct

from acsard.messages.encodings import encode
from acsard.messages.schema import MESSAGES, RobotState, TwistStamped
from acsard.messages.topics import by_key
from acsard.ros.definitions import OURS, schema_text
from acsard.ros.names import full_name
from acsard.ros.shapes import Log, State, state
from acsard.ros.tokens import Qos
from acsard.ros.transports import PUBLISHED

ENCODING, SCHEMA_ENCODING = "cdr", "ros2msg"
"""Names of the message encoding and the schema encoding in MCAP and in Foxglove's live protocol."""

SOURCE = "<source>"


class Channel(Struct, frozen=True):
    """A topic, or one topic for each source of commands."""

    name: str
    """Topic name relative to the namespace; it may contain `<source>`."""
    native: str
    """Key in the native tree with the same content."""
    schema_name: str
    """ROS type as `pkg/msg/Name`."""
    message: type[Struct]
    """Struct that is encoded; for `state`, the result of `shapes.state`."""
    qos: Qos = Qos()

    def topic(self, namespace: str, source: str = "") -> str:
        """Return the fully qualified name, with its leading slash."""
        return full_name(namespace, self.name.replace(SOURCE, source))

    @property
    def schema(self) -> str:
        """The text of the message definition with all nested types."""
        return schema_text(self.schema_name)

    def encode(self, message: Any) -> bytes:
        """Encode a message as CDR. A `RobotState` is first converted to the shape of `state`."""
        return encode(state(message) if isinstance(message, RobotState) else message, "cdr")


def _published() -> dict[str, Channel]:
    found = {}
    for row in PUBLISHED:
        topic = by_key(row.native)
        assert topic is not None, row.native
        found[row.native] = Channel(row.name, row.native, row.type, MESSAGES[topic.type], row.qos)
    return found


TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"

STATE = Channel("state", "state", OURS + "RobotState", State)
LOG = Channel("log", "events", "rcl_interfaces/msg/Log", Log, Qos(1000))
CMD_VEL_IN = Channel(f"cmd_vel_in/{SOURCE}", f"cmd/{SOURCE}", TWIST_STAMPED, TwistStamped)
"""The command of each source, stamped with its arrival. `LOG` has one log line for each event."""

BY_KEY: dict[str, Channel] = {**_published(), STATE.native: STATE}
"""The channels of the messages that `Report` builds, by native key."""

CHANNELS: tuple[Channel, ...] = (*BY_KEY.values(), CMD_VEL_IN, LOG)


def said(silent: Container[str]) -> tuple[Channel, ...]:
    """Return the channels on which a robot publishes; `silent` is the result of
    `transports.left_out`.
    """
    return tuple(channel for channel in CHANNELS if channel.native not in silent)
