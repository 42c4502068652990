"""Drives the robot from the panels of Foxglove viewers. To the daemon, each viewer is one sender.

A panel repeats its command while a button is held, and sends nothing after the button is released.
But the daemon lets a sender drive only after a zero command. So this module sends a zero command
before the first command after each silence of more than 1.5 s. A shorter silence may be a pause of
the network while the button is held. A viewer may also have connected again while the button was
held. So the silence before a viewer's first command is measured from the moment at which the
viewer announced its channel.

If a burst of commands follows a silence, the network has delayed these commands, so this module
drops them. The daemon could detect the delay only from stamps, which few panels send.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import zenoh

from acsard.client import Client
from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, Commander, Wish
from acsard.client.outbox import Outbox
from acsard.core.config.settings import DriveConfig, JointsConfig
from acsard.core.incoming.commands import STAMPED_TWISTS, TWISTS, Arrival, Receiver
from acsard.core.messages.encodings import DecodeError, encoding_name
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S
from acsard.foxglove.notices import Notices
from acsard.host import clock

SLOW_NS, SLOW_TIMES = 5 * NS_PER_S // 2, 3
"""A panel publishes too rarely if each of `SLOW_TIMES` consecutive messages follows a pause between
0.3 s (`commander.BRAKING_AFTER_NS`) and `SLOW_NS`."""

MAX_CHANNELS = 64
"""Largest number of channels of one viewer that are registered at the same time."""

TOO_MANY_CHANNELS = (
    f"a viewer may publish on {MAX_CHANNELS} topics at most, so the messages of this panel are "
    "lost: remove panels that publish, then close the viewer and open it again"
)
"""Notice about a message on a channel that was not registered."""

_receiver = Receiver(JointsConfig(), Kinematics(DriveConfig()))
"""Decoder of velocity commands (twists). It has the default joints and wheels, because a twist does
not depend on them."""


def encoding_of(encoding: str, schema_name: str) -> str:
    """Return the Zenoh encoding of the messages on a viewer's channel.

    Raises `DecodeError` if such messages cannot drive the robot.

    Args:
        encoding: Foxglove's name of the encoding. Any encoding except "json" and "cdr" is refused.
        schema_name: ROS type of the messages, such as "geometry_msgs/Twist".
    """
    package, _, name = schema_name.partition("/")
    full = f"{package}/msg/{name.removeprefix('msg/')}"
    if full not in (TWISTS[0], STAMPED_TWISTS[0]):
        text = (
            f"a channel of the type {schema_name or '(none)'} cannot drive the robot: use "
            f"{TWISTS[0]}"
        )
        raise DecodeError("wrong_shape", text)
    if encoding == "cdr":
        return f"{encoding_name('cdr')};{full}"
    if encoding == "json":
        return encoding_name("json")
    raise DecodeError(
        "unknown_encoding", f"the channel's encoding is {encoding or '(none)'}: use json or cdr"
    )


def wish(encoding: str, payload: bytes) -> Wish:
    """Return the velocity command in `payload`. Raises `DecodeError` if it is not valid.

    `encoding` is Zenoh's name of the encoding.
    """
    command = _receiver.command(Arrival("cmd/app", True, payload, encoding, 0, None, ""))
    return Wish(command.twist, command.stamp_ns)


class Viewer:
    """A viewer that publishes commands, with its bus client, its `Commander` and its channels."""

    def __init__(self, robot: Client) -> None:
        self.robot = robot
        self.commander = Commander(
            sends_leading_zero=True, detects_bursts=True, connected_ns=clock.steady_ns()
        )
        self.channels: dict[int, tuple[str, str]] = {}
        """Maps a channel's id to (Zenoh encoding, ""). If messages on the channel cannot drive the
        robot, the value is ("", reason)."""
        self._slow = 0

    def is_slow(self, silence_ns: int | None) -> bool:
        """Return whether the panel publishes so rarely that the robot stops between the messages.

        Call this method once for each message. `silence_ns` is the time since the previous message,
        ns. It is None for the first message, and if that time is at most
        `commander.BRAKING_AFTER_NS`.
        """
        slow = silence_ns is not None and silence_ns <= SLOW_NS
        self._slow = self._slow + 1 if slow else 0
        return self._slow >= SLOW_TIMES


class DrivingViewers:
    """The viewers that publish commands, and the thread that sends the commands to the robot."""

    def __init__(
        self, robot_of: Callable[[int], Client], topic: str, notices: Notices, forbidden: str
    ) -> None:
        self.topic, self.forbidden = topic, forbidden
        self._robot_of, self._notices = robot_of, notices
        self._viewers: dict[int, Viewer] = {}
        self._lock = Lock()
        self.outbox = Outbox()
        self.timeout_s = MAX_SOURCE_TIMEOUT_S
        """Timeout of the command source that the viewers use, s."""

    # The server's threads call the methods below. `client` is the id of a viewer, and `channel` is
    # the id of one of its channels.

    def advertised(
        self, client: int, channel: int, topic: str, encoding: str, schema_name: str
    ) -> None:
        """Register a channel on which a viewer publishes.

        If messages on the channel cannot drive the robot, `received` reports the reason when a
        message arrives. A channel beyond `MAX_CHANNELS` is not registered, and `received` reports
        that. The forms of `encoding` and `schema_name` are those of `encoding_of`.
        """
        zenoh_encoding, problem = "", ""
        if topic != self.topic:
            problem = f"no program listens on {topic}: send commands to {self.topic} instead"
        else:
            try:
                zenoh_encoding = encoding_of(encoding, schema_name)
            except DecodeError as error:
                problem = f"{topic}: {error}"
        with self._lock:
            viewer = self._viewers.get(client)
            if viewer is None:
                viewer = self._viewers[client] = Viewer(self._robot_of(client))
            if len(viewer.channels) < MAX_CHANNELS:
                viewer.channels[channel] = zenoh_encoding, problem

    def received(self, client: int, channel: int, data: bytes) -> None:
        """Queue the command in a viewer's message. If it is refused, tell the viewers why."""
        viewer = self._viewers.get(client)
        if viewer is None:
            return
        encoding, problem = viewer.channels.get(channel, ("", TOO_MANY_CHANNELS))
        if not encoding:
            self._notices.enqueue("warning", "drive", problem)
            return
        if self.forbidden:
            self._notices.enqueue("error", "drive", self.forbidden)
            return
        try:
            wished = wish(encoding, data)
        except DecodeError as error:
            self._notices.enqueue("warning", "drive", f"{self.topic}: refused: {error}")
            return
        robot = viewer.robot
        with self._lock:
            if self._viewers.get(client) is not viewer:
                return  # the viewer has left, and its final zero command is queued
            silence_ns = self.outbox.take(
                viewer.commander, lambda due: self._send(robot, due), wished
            )
        if viewer.is_slow(silence_ns):
            self._notices.enqueue(
                "warning",
                "drive",
                "the panel publishes so rarely that the robot stops between its messages: set the "
                "panel's publish rate to 10 Hz or more",
            )

    def withdrawn(self, client: int, channel: int) -> None:
        """Remove a channel of a viewer. If the viewer may be driving the robot, send a zero."""
        with self._lock:
            viewer = self._viewers.get(client)
            if viewer is None:
                return
            encoding, _ = viewer.channels.pop(channel, ("", ""))
            if encoding:
                self.outbox.release(viewer.commander, self.timeout_s)
            if not viewer.channels:
                del self._viewers[client]

    # The main thread calls the methods below.

    def driving(self) -> dict[int, Client]:
        """Return the viewers that request a speed now, as a dict from viewer id to bus client."""
        now_ns = clock.steady_ns()
        with self._lock:
            viewers = self._viewers.items()
            return {client: it.robot for client, it in viewers if it.commander.is_driving(now_ns)}

    def end(self) -> None:
        """Send a zero command for each viewer that may be driving, then stop the sending thread."""
        with self._lock:
            for viewer in self._viewers.values():
                self.outbox.release(viewer.commander, self.timeout_s)
            self._viewers.clear()
        self.outbox.end(0.5)  # sending the final zeros normally takes a few ms

    # The sending thread runs the method below.

    def _send(self, robot: Client, wished: Wish) -> None:
        twist = wished.twist
        try:
            robot.forward(twist.linear, twist.angular, stamp_ns=wished.stamp_ns)
        except zenoh.ZError as error:
            words = "the bus accepts no commands, so the commands of all panels are lost"
            mend = "run `acsard doctor` on the robot"
            self._notices.enqueue("error", "drive", f"{words} ({error}): {mend}")
