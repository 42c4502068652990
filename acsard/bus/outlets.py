"""What goes out: each published topic on every key that somebody listens to.

A topic has one outlet in the native tree and one in each ROS tree that has it. A message is
encoded once per encoding, and not at all for a tree without listeners.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import zenoh
import zenoh.ext

from acsard.host import clock
from acsard.messages.encodings import Format, encode
from acsard.messages.schema import Message
from acsard.ros.attachments import Attachment

OPTIONS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    # One priority for all puts of the loop: another thread's blocked put on the same priority
    # would hold them up.
    "priority": zenoh.Priority.REAL_TIME,
}

HEARTBEAT = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
"""As rmw_zenoh has it for what is kept for late comers."""


def direct(callback: Callable[[Any], None]) -> Any:
    """Called on the thread that received; by default each callback gets a thread of its own."""
    return zenoh.handlers.Callback(callback, indirect=False)


class _Outlet:
    def __init__(self, publisher: Any, form: Format, gid: bytes) -> None:
        self.publisher, self.form = publisher, form
        self.wanted = False
        self._gid, self._sequence = gid, 0

    def put(self, payload: bytes) -> None:
        if not self._gid:
            self.publisher.put(payload)
            return
        self._sequence += 1
        attachment = Attachment(self._sequence, clock.now().wall_ns, self._gid)
        self.publisher.put(payload, attachment=attachment.pack())


class Outlets:
    """The publishers of one session, by the native key of their topic."""

    def __init__(self) -> None:
        self._outlets: dict[str, list[_Outlet]] = {}
        self._kept: list[object] = []
        self._counting = Lock()
        self.wanted: frozenset[str] = frozenset()
        """The topics that somebody listens to."""

    def _count(self, outlet: _Outlet, wanted: bool) -> None:
        # By one of Zenoh's threads at a time; replaced whole, for the loop may be reading it.
        with self._counting:
            outlet.wanted = wanted
            self.wanted = frozenset(
                topic
                for topic, outlets in list(self._outlets.items())
                if any(one.wanted for one in outlets)
            )

    def publish(self, topic: str, message: Message) -> None:
        """Send a message to its listeners."""
        payloads: dict[Format, bytes] = {}
        for outlet in self._outlets[topic]:
            if outlet.wanted:
                form = outlet.form
                if form not in payloads:
                    payloads[form] = encode(message, form)
                outlet.put(payloads[form])

    def declare(
        self,
        session: zenoh.Session,
        topic: str,
        key: str,
        form: Format,
        encoding: str,
        latched: bool = False,
        gid: bytes = b"",
    ) -> None:
        """Open `key` for a topic; with a `gid` its samples carry rmw_zenoh's attachment."""
        if latched:
            publisher: Any = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                encoding=encoding,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                sample_miss_detection=HEARTBEAT if gid else None,
                **OPTIONS,
            )
        else:
            publisher = session.declare_publisher(key, encoding=encoding, **OPTIONS)
        outlet = _Outlet(publisher, form, gid)
        self._outlets.setdefault(topic, []).append(outlet)
        if latched:
            self._count(outlet, wanted=True)  # it is kept for those who are still to come
            return

        def matching(status: zenoh.MatchingStatus) -> None:
            self._count(outlet, status.matching)

        self._kept.append(publisher.declare_matching_listener(direct(matching)))
        self._count(outlet, outlet.wanted or publisher.matching_status.matching)
