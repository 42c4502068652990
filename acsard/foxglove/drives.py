"""Drives the robot from a viewer's panel. Each viewer is a sender of its own, under the daemon's
rules.

The server's threads pass each message to the viewer's `Hand`, which keeps the newest. A separate
thread sends it, so that no thread of the server waits for the bus.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Thread

import zenoh

from acsard.client import Client
from acsard.foxglove.notices import Notices
from acsard.foxglove.viewer_commands import Hand, Wish, encoding_of, wish
from acsard.host import clock
from acsard.messages.encodings import DecodeError
from acsard.values import NS_PER_S

CHANNELS = 64
"""Maximum number of channels on which one viewer may publish."""

END_S = 0.5
"""Time limit for sending the final zeros, which normally takes a few ms."""

TOO_SLOW = (
    "the panel publishes so seldom that the robot stops in between: set its publish rate to 10 Hz "
    "or more"
)


LOST = "the bus takes no commands: what a panel publishes is lost until it does"


class _Viewer:
    """One viewer with its sender name."""

    def __init__(self, robot: Client) -> None:
        self.robot, self.hand = robot, Hand()
        self.channels: dict[int, tuple[str, str]] = {}
        """Encoding and problem of each channel. If the problem is not empty, the channel cannot
        drive."""


class Drives:
    """All viewers that publish."""

    def __init__(
        self, robot_of: Callable[[int], Client], topic: str, notices: Notices, forbidden: str
    ) -> None:
        self.topic, self.forbidden = topic, forbidden
        self._robot_of, self._notices = robot_of, notices
        self._viewers: dict[int, _Viewer] = {}
        self._parting: list[tuple[Client, Wish]] = []
        self._news = Condition()
        self._ended = False
        self._thread = Thread(target=self._run, name="drives", daemon=True)
        self._thread.start()

    # Called by the server's threads.

    def advertised(
        self, client: int, channel: int, topic: str, encoding: str, schema_name: str
    ) -> None:
        """Register a channel. If it cannot drive, the viewer learns why when it publishes."""
        found, problem = "", ""
        if topic != self.topic:
            problem = f"nothing listens on {topic}: drive on {self.topic}"
        else:
            try:
                found = encoding_of(encoding, schema_name)
            except DecodeError as error:
                problem = f"{topic}: {error}"
        with self._news:
            viewer = self._viewers.get(client)
            if viewer is None:
                viewer = self._viewers[client] = _Viewer(self._robot_of(client))
            if len(viewer.channels) < CHANNELS:
                viewer.channels[channel] = found, problem

    def came(self, client: int, channel: int, data: bytes) -> None:
        """Take a message that a viewer published."""
        now_ns = clock.mono_ns()
        viewer = self._viewers.get(client)
        encoding, problem = viewer.channels.get(channel, ("", "")) if viewer else ("", "")
        if viewer is None or not encoding:
            if problem:
                self._notices.say("warning", "drive", problem)
            return
        if self.forbidden:
            self._notices.say("error", "drive", self.forbidden)
            return
        try:
            wished = wish(encoding, data)
        except DecodeError as error:
            self._notices.say("warning", "drive", f"{self.topic}: refused: {error}")
            return
        with self._news:
            viewer.hand.take(wished, now_ns)
            self._news.notify()
        if viewer.hand.is_slow():
            self._notices.say("warning", "drive", TOO_SLOW)

    def withdrawn(self, client: int, channel: int) -> None:
        """Release the robot, because the viewer closed this channel or disconnected."""
        with self._news:
            viewer = self._viewers.get(client)
            if viewer is None:
                return
            encoding, _ = viewer.channels.pop(channel, ("", ""))
            if encoding:
                self._part(viewer)
            if not viewer.channels:
                del self._viewers[client]
            self._news.notify()

    # Called by the main thread.

    def driving(self) -> dict[int, Client]:
        """Return the viewers that currently ask for a speed, with their clients."""
        now_ns = clock.mono_ns()
        with self._news:
            viewers = self._viewers.items()
            return {one: viewer.robot for one, viewer in viewers if viewer.hand.drives(now_ns)}

    def end(self) -> None:
        """Send one zero for each viewer that drives, then stop the sending thread."""
        with self._news:
            for viewer in self._viewers.values():
                self._part(viewer)
            self._viewers.clear()
            self._ended = True
            self._news.notify()
        self._thread.join(END_S)

    # Run by the sending thread, or with the lock held.

    def _part(self, viewer: _Viewer) -> None:
        """Queue a final zero for this viewer; the caller holds the lock."""
        zero = viewer.hand.end(clock.mono_ns())
        if zero is not None:
            self._parting.append((viewer.robot, zero))

    def _run(self) -> None:
        while True:
            with self._news:
                while not ((due := self._due()) or self._parting or self._ended):
                    self._news.wait(self._left())
                parting, self._parting = self._parting, []
                if not (parting or due):
                    return
            for robot, zero in parting:
                self._send(robot, zero)
            for viewer in due:
                # The bus may have blocked the previous send, so judge the age by the present time.
                with self._news:
                    wished = viewer.hand.send(clock.mono_ns())
                if wished is not None:
                    self._send(viewer.robot, wished)

    def _send(self, robot: Client, wished: Wish) -> None:
        twist = wished.twist
        try:
            robot.send(twist.linear, twist.angular, stamp_ns=wished.stamp_ns)
        except zenoh.ZError as error:
            self._notices.say("error", "drive", f"{LOST} ({error})")

    def _due(self) -> list[_Viewer]:
        """Return the viewers with a message that is due."""
        now_ns = clock.mono_ns()
        times = [(viewer, viewer.hand.due_ns()) for viewer in self._viewers.values()]
        return [viewer for viewer, due_ns in times if due_ns is not None and due_ns <= now_ns]

    def _left(self) -> float | None:
        """Return the seconds until the next message is due, or None if none is waiting."""
        times = [viewer.hand.due_ns() for viewer in self._viewers.values()]
        known = [one for one in times if one is not None]
        return max(0.0, (min(known) - clock.mono_ns()) / NS_PER_S) if known else None
