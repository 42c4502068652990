"""What the viewers are told in words: their status messages, the topic `log`, and the terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Lock

from foxglove import StatusLevel
from foxglove.websocket import WebSocketServer
from msgspec import Struct

from acsard.host import clock
from acsard.messages.schema import Time
from acsard.ros.shapes import LEVELS, Log
from acsard.values import NS_PER_S, Level

STATUS: dict[Level, StatusLevel] = {
    "info": StatusLevel.Info,
    "warning": StatusLevel.Warning,
    "error": StatusLevel.Error,
}

AGAIN_NS = 2 * NS_PER_S
"""The same words at most so often."""

WAITING = 100
"""Notices that wait to be sent; the oldest are dropped beyond that."""


class Notice(Struct, frozen=True):
    """`stays` is its name while it holds, "" for what is said once; without `text` it is over."""

    level: Level
    name: str
    text: str
    stays: str = ""


class Notices:
    """Said by any thread, sent by one."""

    def __init__(self, tell: Callable[[str], None], wake: Callable[[], None]) -> None:
        self._tell, self._wake = tell, wake
        self._lock = Lock()
        self._waiting: deque[Notice] = deque(maxlen=WAITING)
        self._said: dict[str, int] = {}
        """When the words of each name were last said."""
        self._staying: dict[str, Notice] = {}

    def say(self, level: Level, name: str, text: str, stays: str = "") -> None:
        """Tell everybody who looks; the same again only if it is to stay."""
        now_ns = clock.mono_ns()
        with self._lock:
            recent = {t: ns for t, ns in self._said.items() if now_ns - ns < AGAIN_NS}
            if text in recent and not stays:
                return
            self._said = recent | {text: now_ns}
            self._waiting.append(Notice(level, name, text, stays))
        self._wake()

    def over(self, stays: str) -> None:
        """What was said under this name holds no more."""
        with self._lock:
            self._waiting.append(Notice("info", "", "", stays))
        self._wake()

    def send(self, server: WebSocketServer, log: Callable[[Log], None], *, newcomers: bool) -> None:
        """Send what waits; `newcomers` have not seen what still holds."""
        if newcomers:
            for one in self._staying.values():
                server.publish_status(one.text, STATUS[one.level], one.stays)
        while True:
            with self._lock:
                if not self._waiting:
                    return
                one = self._waiting.popleft()
            if not one.text:
                if self._staying.pop(one.stays, None):
                    server.remove_status([one.stays])
                continue
            if one.stays:
                self._staying[one.stays] = one
            server.publish_status(one.text, STATUS[one.level], one.stays or None)
            stamp = Time.from_ns(clock.now().wall_ns)
            log(Log(stamp, LEVELS[one.level], f"foxglove.{one.name}", one.text))
            self._tell(one.text)
