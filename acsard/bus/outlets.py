"""What goes out: each published topic on every key that somebody listens to.

A topic has one outlet in the native tree and one in each ROS tree that has it. A message is
encoded once per encoding, and not at all for a tree without listeners.

The control loop only leaves messages in slots, the newest of each topic; a thread of its own
encodes and sends them. A bus that is locked, by whomever, costs messages and never a period.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

import zenoh
import zenoh.ext

from acsard.host import clock
from acsard.messages.encodings import Format, encode
from acsard.messages.schema import Message
from acsard.ros.attachments import Attachment
from acsard.values import NS_PER_S

OPTIONS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    # One priority for all puts of the loop: another thread's blocked put on the same priority
    # would hold them up.
    "priority": zenoh.Priority.REAL_TIME,
}

HELD = 16
"""Messages of one topic that wait for the thread, the newest: odometry of 0.16 s, which is longer
than the machine or a client that joins usually holds it up."""

STUCK_NS = NS_PER_S // 4
"""A round of puts takes 0.1 ms, a few more on a busy machine; longer, and somebody holds it up."""

HEARTBEAT = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
"""As rmw_zenoh has it for what is kept for late comers."""


def direct(callback: Callable[[Any], None]) -> Any:
    """Called on the thread that received; by default each callback gets a thread of its own."""
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
        """The topics that somebody listens to."""
        self._slots: dict[str, deque[Message]] = {}
        self._bell = Lock()
        """Held while nothing waits: to release it wakes the thread, at the least cost there is."""
        self._bell.acquire()
        self._waiting = self._leaving = self._stuck = False
        self._dropped = 0
        self._began_ns: int | None = None
        """When the round under way began."""
        self._error: BaseException | None = None
        self._thread = Thread(target=self._run, name="outlets", daemon=True)

    def _count(self, outlet: _Outlet, wanted: bool) -> None:
        # By one of Zenoh's threads at a time; replaced whole, for the loop may be reading it.
        with self._counting:
            outlet.wanted = wanted
            self.wanted = frozenset(
                topic
                for topic, outlets in list(self._outlets.items())
                if any(one.wanted for one in outlets)
            )

    # the control loop's side: nothing here waits, or calls Zenoh

    def publish(self, topic: str, message: Message) -> None:
        """Leave a message for its listeners; `flush` has it sent."""
        slot = self._slots[topic]
        if len(slot) == HELD:
            self._dropped += 1
        slot.append(message)
        self._waiting = True

    def flush(self) -> None:
        """Have the thread send what was published; raises what it died of."""
        if self._error is not None:
            raise self._error
        if self._waiting:
            self._waiting = False
            self._ring()

    @property
    def behind(self) -> bool:
        """There may be something for `losses` to tell."""
        return self._began_ns is not None or self._stuck or self._dropped > 0

    def losses(self, now_ns: int) -> tuple[int, bool]:
        """Messages dropped since the last call, and whether the bus has got stuck meanwhile."""
        dropped, self._dropped = self._dropped, 0
        began_ns, was = self._began_ns, self._stuck
        self._stuck = began_ns is not None and now_ns - began_ns > STUCK_NS
        return dropped, self._stuck and not was

    # the thread's side

    def start(self) -> None:
        """Begin to send; what was published before waits until then."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Send what waits, and no more; gives up after so many s."""
        self._leaving = True
        self._ring()
        self._thread.join(timeout)

    def _ring(self) -> None:
        if self._bell.locked():  # else it has not yet begun the round it was woken for
            self._bell.release()

    def _run(self) -> None:
        try:
            leaving = False
            while not leaving:
                self._bell.acquire()
                leaving = self._leaving
                self._began_ns = clock.mono_ns()
                for topic, slot in self._slots.items():
                    while slot:
                        self._send(topic, slot.popleft())
                self._began_ns = None
        except BaseException as error:  # noqa: BLE001 - raised in the loop: a bug ends the process
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
        """Open `key` for a topic; with a `gid` its samples carry rmw_zenoh's attachment.

        Without, they carry what they are `signed` with.
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
        self._slots.setdefault(topic, deque(maxlen=HELD))
        outlet = _Outlet(publisher, form, gid, signed)
        self._outlets.setdefault(topic, []).append(outlet)
        if latched:
            self._count(outlet, wanted=True)  # it is kept for those who are still to come
            return

        def matching(status: zenoh.MatchingStatus) -> None:
            self._count(outlet, status.matching)

        self._kept.append(publisher.declare_matching_listener(direct(matching)))
        if publisher.matching_status.matching:  # else it has been told meanwhile, if it has come
            self._count(outlet, True)
