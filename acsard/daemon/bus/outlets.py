"""Publishes the messages of each topic on every key of the topic that has a subscriber.

A topic has native keys (one for msgpack, one for JSON) and perhaps ROS keys. Each key has an
outlet, which is the publisher on that key. A message is encoded once per encoding, and only if an
outlet with that encoding is latched or has a subscriber.

The control loop only puts a message into the slot of its topic, which is a bounded queue. A thread
encodes and sends the messages. So if the bus blocks, messages are lost, but the control loop misses
no period.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import zenoh
import zenoh.ext

from acsard.bus.subscription import direct
from acsard.core.messages.encodings import Format, encode, encoding_name
from acsard.core.messages.schema import Message
from acsard.core.ros.attachments import Attachment
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.bus_thread import BusThread
from acsard.host import clock
from acsard.host.mailbox import Bell, Mailbox

PUBLISHER_OPTIONS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    # A blocked put of another thread with the same priority would delay the puts of this thread.
    "priority": zenoh.Priority.REAL_TIME,
}

SLOT_MESSAGES = 16
"""Largest number of messages in the slot of a topic, which is the queue to the sending thread. A
newer message displaces the oldest one. With odometry at 100 Hz, a slot covers 0.16 s. A busy
machine, or a client that connects, usually blocks the thread for a shorter time."""

BLOCKED_AFTER_NS = NS_PER_S // 4
"""If the sending thread has not sent all waiting messages after this time, ns, the bus counts as
blocked. Usually the thread needs 0.1 ms."""

HEARTBEAT = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
"""Heartbeat of the publishers of latched ROS topics. The settings are those of rmw_zenoh."""


class _Outlet:
    def __init__(self, publisher: Any, form: Format, gid: bytes, signed: bytes) -> None:
        self.publisher, self.form = publisher, form
        self.wanted = False
        """True if the key has a subscriber, or if the publisher is latched."""
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
    """The publishers of the daemon's session, and the thread that sends their messages."""

    def __init__(self, errors: list[BaseException]) -> None:
        """Start without publishers. `errors` gets an exception that ends the sending thread."""
        self._outlets: dict[str, list[_Outlet]] = {}
        """Maps the native key of each topic to its outlets."""
        self._listeners: list[object] = []
        """References to Zenoh's listeners. Zenoh ends a listener when nothing refers to it."""
        self._counting = Lock()
        self.wanted: frozenset[str] = frozenset()
        """The native keys of the topics that have a subscriber or a latched publisher."""
        self._slots: dict[str, Mailbox[Message]] = {}
        self._bell = Bell()
        """Signal that wakes the sending thread. All slots share one signal, because a control step
        fills several slots."""
        self._waiting = self._leaving = self._stuck = False
        self._dropped = 0
        """Number of messages that newer messages have displaced since the last call of `losses`."""
        self._began_ns: int | None = None
        """Monotonic time at which the sending thread began to send the waiting messages, ns. None
        while this thread waits for messages."""
        self._thread = BusThread("outlets", self._run, errors)

    def _count(self, outlet: _Outlet, wanted: bool) -> None:
        # Several threads of Zenoh call this method, so it takes a lock. It replaces the set
        # `wanted` as a whole, because the control loop may be reading the set.
        with self._counting:
            outlet.wanted = wanted
            self.wanted = frozenset(
                topic
                for topic, outlets in list(self._outlets.items())
                if any(sibling.wanted for sibling in outlets)
            )

    # The control loop calls the methods below. None of them waits or calls Zenoh.

    def publish(self, topic: str, message: Message) -> None:
        """Put a message into the slot of its topic. `flush` wakes the thread that sends it.

        `topic` is the native key of the topic.
        """
        if not self._slots[topic].store(message):
            self._dropped += 1
        self._waiting = True

    def flush(self) -> None:
        """Wake the thread that sends the messages."""
        if self._waiting:
            self._waiting = False
            self._bell.ring()

    @property
    def behind(self) -> bool:
        """True if messages were dropped, or if the bus may be blocked.

        The caller must then call `losses`.
        """
        return self._began_ns is not None or self._stuck or self._dropped > 0

    def losses(self, now_ns: int) -> tuple[int, bool]:
        """Return the number of dropped messages, and whether the bus has begun to block.

        Both values cover the time since the last call. The beginning of a block is therefore
        returned only once. `now_ns` is the present monotonic time, ns.
        """
        dropped, self._dropped = self._dropped, 0
        began_ns, was_stuck = self._began_ns, self._stuck
        self._stuck = began_ns is not None and now_ns - began_ns > BLOCKED_AFTER_NS
        return dropped, self._stuck and not was_stuck

    def start(self) -> None:
        """Start the thread that sends the messages. Messages may already wait in the slots."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Let the thread end after it has sent the waiting messages. Wait at most `timeout` s."""
        self._leaving = True
        self._bell.ring()
        self._thread.join(timeout)

    # The thread runs `_run` and `_send`.

    def _run(self) -> None:
        leaving = False
        while not leaving:
            self._bell.wait()
            leaving = self._leaving
            self._began_ns = clock.mono_ns()
            for topic, slot in self._slots.items():
                while slot.waiting:
                    self._send(topic, slot.waiting.popleft())
            self._began_ns = None

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
        type_name: str,
        latched: bool = False,
        gid: bytes = b"",
        signed: bytes = b"",
    ) -> None:
        """Declare one publisher of a topic.

        Args:
            session: the Zenoh session of the daemon.
            topic: native key of the topic.
            key: full key on which the publisher puts the topic's messages.
            form: encoding of the messages.
            type_name: type of the messages for Zenoh's Encoding, or "" to leave it out.
            latched: whether the publisher keeps its last sample for late subscribers.
            gid: identity of a ROS publisher, or b"" for a native publisher. Each sample of a ROS
                publisher gets an attachment in the form of rmw_zenoh.
            signed: attachment of each sample of a native publisher, or b"" for no attachment.
        """
        encoding = encoding_name(form, type_name)
        if latched:
            publisher: Any = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                encoding=encoding,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                sample_miss_detection=HEARTBEAT if gid else None,
                **PUBLISHER_OPTIONS,
            )
        else:
            publisher = session.declare_publisher(key, encoding=encoding, **PUBLISHER_OPTIONS)
        self._slots.setdefault(topic, Mailbox(SLOT_MESSAGES))
        outlet = _Outlet(publisher, form, gid, signed)
        self._outlets.setdefault(topic, []).append(outlet)
        if latched:
            # A latched publisher keeps its last sample, so each message must be encoded.
            self._count(outlet, wanted=True)
            return

        def matching(status: zenoh.MatchingStatus) -> None:
            self._count(outlet, status.matching)

        self._listeners.append(publisher.declare_matching_listener(direct(matching)))
        # The listener reports only later changes, so ask whether the key has a subscriber already.
        if publisher.matching_status.matching:
            self._count(outlet, True)
