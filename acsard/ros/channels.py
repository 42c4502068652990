"""**The** table of what a file or a live viewer is given: topic, ROS type, which struct of ours.

All of it is CDR with its definition beside it (MCAP's `ros2msg`): Foxglove, Lichtblick and
PlotJuggler read any such type, and `ros2 bag play` opens no file in which one topic is anything
else. So `state`, which ROS has no message for, is of a type of ours: `ros2 bag play` leaves out
that one topic and says so, the others show it as any other. Names and types that the ROS tree has
too are those of `transports.py`.
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
"""Of messages and of their definitions, as MCAP and the live protocol call them."""

SOURCE = "<source>"


class Channel(Struct, frozen=True):
    """One topic; those of the commanders are one for each source."""

    name: str
    """Relative to the namespace; may hold `<source>`."""
    native: str
    """The key in the native tree that says the same."""
    schema_name: str
    """`pkg/msg/Name`."""
    message: type[Struct]
    """What is encoded; of `state` made by `shapes.state`."""
    qos: Qos = Qos()

    def topic(self, namespace: str, source: str = "") -> str:
        """The fully qualified name, with its leading slash."""
        return full_name(namespace, self.name.replace(SOURCE, source))

    @property
    def schema(self) -> str:
        """The text of the definition with all nested types."""
        return schema_text(self.schema_name)

    def encode(self, message: Any) -> bytes:
        """The CDR of a message, of `state` also of a `RobotState`."""
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
"""What each source asks for; the stamp is when it arrived. A log line is one event."""

BY_KEY: dict[str, Channel] = {**_published(), STATE.native: STATE}
"""What the report builds, by its key."""

CHANNELS: tuple[Channel, ...] = (*BY_KEY.values(), CMD_VEL_IN, LOG)


def said(silent: Container[str]) -> tuple[Channel, ...]:
    """The channels that a robot has something to say on; `silent` as `transports.left_out`."""
    return tuple(channel for channel in CHANNELS if channel.native not in silent)
