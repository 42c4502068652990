"""Publishes each topic on every key that has a listener.

A topic has one outlet in the native tree and one in each ROS tree that has the topic. A message is
encoded once per encoding, and not at all for a tree without listeners.

The control loop only leaves messages in slots, which keep the newest of each topic. A thread of its
own encodes and sends them, so a bus that blocks costs messages and never a control period.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

import zenoh
import zenoh.ext

from acsard.core.messages.encodings import Format, encode
from acsard.core.messages.schema import Message
from acsard.core.ros.attachments import Attachment
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.mailbox import Bell, Mailbox

OPTIONS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    # All puts of the loop share one priority: a blocked put of another thread on the same priority
    # would delay them.
    "priority": zenoh.Priority.REAL_TIME,
}

HELD = 16
"""Newest messages of one topic that wait for the thread. This is odometry of 0.16 s, longer than
the machine or a joining client usually blocks the thread."""

STUCK_NS = NS_PER_S // 4
"""A round of puts takes 0.1 ms, a little longer on a busy machine. If it takes longer than this,
the bus is blocked."""

HEARTBEAT = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
"""Heartbeat of latched ROS topics, as rmw_zenoh sets it for samples kept for late subscribers."""


def direct(callback: Callable[[Any], None]) -> Any:
    """Wrap a callback to run on Zenoh's receiving thread instead of a thread of its own."""
    return zenoh.handlers.Callback(callback, indirect=False)


class _Outlet:
    def __init__(self, publisher: Any, form: Format, gid: bytes, signed: bytes) -> None:
        self.publisher, self.form = publisher, form
        self.wanted = False
        self._gid, self._sequence = gid, 0
        self._signed = {"attachment": signed} if signed else {}

    def put(self, payload: bytes) -> None:
        if not self._gid:
            self.publisher.put(payload, **self._signed)
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
        """The topics that have a listener."""
        self._slots: dict[str, Mailbox[Message]] = {}
        self._bell = Bell()
        """Wakes the thread. One bell serves all slots, because a step fills several of them."""
        self._waiting = self._leaving = self._stuck = False
        self._dropped = 0
        self._began_ns: int | None = None
        """Monotonic time at which the present round began, None between rounds."""
        self._error: BaseException | None = None
        self._thread = Thread(target=self._run, name="outlets", daemon=True)

    def _count(self, outlet: _Outlet, wanted: bool) -> None:
        # Zenoh's threads call this one at a time, under the lock. The set is replaced as a whole,
        # because the control loop may be reading it.
        with self._counting:
            outlet.wanted = wanted
            self.wanted = frozenset(
                topic
                for topic, outlets in list(self._outlets.items())
                if any(one.wanted for one in outlets)
            )

    # The control loop calls the methods below. None of them waits or calls Zenoh.

    def publish(self, topic: str, message: Message) -> None:
        """Queue a message for its listeners. `flush` sends it."""
        if not self._slots[topic].store(message):
            self._dropped += 1
        self._waiting = True

    def flush(self) -> None:
        """Wake the thread to send the queued messages.

        Raise the error that ended the thread, if any.
        """
        if self._error is not None:
            raise self._error
        if self._waiting:
            self._waiting = False
            self._bell.ring()

    @property
    def behind(self) -> bool:
        """Whether `losses` may have something to report."""
        return self._began_ns is not None or self._stuck or self._dropped > 0

    def losses(self, now_ns: int) -> tuple[int, bool]:
        """Return the number of messages dropped since the last call, and if the bus blocked."""
        dropped, self._dropped = self._dropped, 0
        began_ns, was = self._began_ns, self._stuck
        self._stuck = began_ns is not None and now_ns - began_ns > STUCK_NS
        return dropped, self._stuck and not was

    # The thread runs the code below.

    def start(self) -> None:
        """Start sending. Messages published earlier wait until then."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Send the queued messages and stop. Give up after `timeout` s."""
        self._leaving = True
        self._bell.ring()
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            leaving = False
            while not leaving:
                self._bell.wait()
                leaving = self._leaving
                self._began_ns = clock.mono_ns()
                for topic, slot in self._slots.items():
                    while slot.waiting:
                        self._send(topic, slot.waiting.popleft())
                self._began_ns = None
        except BaseException as error:  # noqa: BLE001 - raised again by flush(), so it ends the process
            self._error = error

    def _send(self, topic: str, message: Message) -> None:
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
        signed: bytes = b"",
    ) -> None:
        """Open `key` for a topic.

        With a `gid` the samples carry an attachment of rmw_zenoh, else the attachment `signed`, if
        any.
        """
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
        self._slots.setdefault(topic, Mailbox(HELD))
        outlet = _Outlet(publisher, form, gid, signed)
        self._outlets.setdefault(topic, []).append(outlet)
        if latched:
            # Its samples are kept for late subscribers, so they are always encoded.
            self._count(outlet, wanted=True)
            return

        def matching(status: zenoh.MatchingStatus) -> None:
            self._count(outlet, status.matching)

        self._kept.append(publisher.declare_matching_listener(direct(matching)))
        # Otherwise the listener above reports the next subscriber.
        if publisher.matching_status.matching:
            self._count(outlet, True)
