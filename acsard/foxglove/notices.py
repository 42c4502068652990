"""Shows messages about the robot in the Foxglove viewers and at the terminal."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

from foxglove import StatusLevel
from foxglove.websocket import WebSocketServer
from msgspec import Struct

from acsard.client.commander import GRACE_S
from acsard.core.messages.schema import Time
from acsard.core.ros.shapes import LEVELS, Log
from acsard.core.values import NS_PER_S, Level
from acsard.host import clock
from acsard.host.mailbox import Mailbox
from acsard.host.rate_limits import Buckets, Rate

STATUS_LEVELS: dict[Level, StatusLevel] = {
    "info": StatusLevel.Info,
    "warning": StatusLevel.Warning,
    "error": StatusLevel.Error,
}

REPEAT_RATE = Rate(0.5)
"""Largest rate of notices with the same text: one per two seconds."""

MAX_WAITING = 100
"""Largest number of notices that wait to be sent. A newer notice displaces the oldest one."""


class Notice(Struct, frozen=True):
    """A message to the viewers.

    If `status_id` is not "", the message remains visible until a later notice has the same
    `status_id` and an empty `text`.
    """

    level: Level
    name: str
    text: str
    status_id: str = ""


class Notices:
    """The messages to the viewers. Any thread may add a message, and the main thread sends them."""

    def __init__(self, tell: Callable[[str], None], wake: Callable[[], None]) -> None:
        self._tell = tell
        self._lock = Lock()
        self._waiting = Mailbox[Notice](MAX_WAITING, wake)
        self._texts = Buckets(REPEAT_RATE)
        self._staying: dict[str, Notice] = {}

    def enqueue(self, level: Level, name: str, text: str, status_id: str = "") -> None:
        """Queue a message to all viewers. `name` is its subject on the topic `log`.

        A message with a `status_id` remains visible until `remove` is called with this id. It is
        dropped if it is visible already. A message without a `status_id` is dropped if its text is
        repeated faster than `REPEAT_RATE` permits.
        """
        now_ns = clock.mono_ns()
        with self._lock:
            new = self._texts.take(text, now_ns)
        if new or status_id:
            self._waiting.put(Notice(level, name, text, status_id))

    def remove(self, status_id: str) -> None:
        """Remove the message with the id `status_id` from the viewers."""
        self._waiting.put(Notice("info", "", "", status_id))

    def send(self, server: WebSocketServer, log: Callable[[Log], None], *, newcomers: bool) -> None:
        """Send the waiting notices to the viewers, and print them at the terminal.

        `log` publishes a message on the topic `log`. If `newcomers` is true, new viewers have come,
        so first repeat the messages that remain visible.
        """
        if newcomers:
            for notice in self._staying.values():
                server.publish_status(notice.text, STATUS_LEVELS[notice.level], notice.status_id)
        for notice in self._waiting.take():
            if not notice.text:
                if self._staying.pop(notice.status_id, None):
                    server.remove_status([notice.status_id])
                continue
            if notice.status_id:
                if self._staying.get(notice.status_id) == notice:
                    continue  # the viewers show it already
                self._staying[notice.status_id] = notice
            server.publish_status(
                notice.text, STATUS_LEVELS[notice.level], notice.status_id or None
            )
            stamp = Time.from_ns(clock.now().wall_ns)
            log(Log(stamp, LEVELS[notice.level], f"foxglove.{notice.name}", notice.text))
            self._tell(notice.text)


class Objections:
    """Decides when to report why the robot does not follow a viewer. The class is pure."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self.reported = ""
        """Reason why the robot does not follow the viewer, as it was last reported, in words. It is
        "" if no reason is reported."""

    def update(self, objection: str, now_ns: int) -> bool:
        """Update the reported reason `reported`, and return whether it has changed.

        A reason is reported if the robot has not followed the viewer for `GRACE_S`. `objection` is
        the present reason, in words, or "" if the robot follows. `now_ns` is the present monotonic
        time, ns.
        """
        if not objection:
            self._since_ns = None
            changed, self.reported = bool(self.reported), ""
            return changed
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < GRACE_S * NS_PER_S or objection == self.reported:
            return False
        self.reported = objection
        return True
