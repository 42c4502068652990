"""Publishes the messages of each topic on every key of the topic that has a subscriber.

A topic has native keys (msgpack, JSON) and perhaps ROS keys, each with a publisher, its outlet. A
message is encoded once per encoding that is latched or has a subscriber. The control loop only puts
it into the topic's bounded slot, and a thread sends it: a bus that blocks costs messages, but no
control period. Beats and the messages of feedback lines are sent by the control loop itself if no
client can block the session, while no put is slow.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any

import zenoh
import zenoh.ext

from acsard.bus.subscription import direct
from acsard.core.messages.encodings import Format, encode, encoding_name
from acsard.core.messages.frames import FeedbackTopic
from acsard.core.messages.keys_and_roles import BEAT
from acsard.core.messages.schema import Beat, Message
from acsard.core.ros.attachments import Attachment
from acsard.core.values import NS_PER_S, Estimate, Ns
from acsard.host import clock
from acsard.host.mailbox import Bell, Mailbox
from acsard.host.threads import Worker

PUBLISHER_OPTIONS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    # A blocked put of another thread with the same priority would delay the puts of this thread.
    "priority": zenoh.Priority.REAL_TIME,
}

# The oldest goes. At 100 Hz a slot covers 0.16 s; a busy machine or a new client usually blocks the
# thread for less.
SLOT_MESSAGES = 16

# The bus is blocked if messages wait for this time. Usually the thread needs 0.1 ms.
BLOCKED_AFTER_NS = NS_PER_S // 4

# After a slower put, the thread sends the topic. Usually a put takes 0.05 ms, and with a subscriber
# that was stopped at most 0.09 ms, because Zenoh drops the sample.
SLOW_PUT_NS = NS_PER_S // 2000

# Messages of one step that the control loop sends itself, at most; after a stall there are more.
MAX_DIRECT = 6

# Heartbeat of latched ROS topics, as in rmw_zenoh.
HEARTBEAT = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)


_Send = Callable[[], None]


def _ignore(_delay_ns: Ns) -> None: ...


class _Outlet:
    def __init__(self, publisher: Any, form: Format, gid: bytes, signed: bytes) -> None:
        self.publisher, self.form = publisher, form
        self.wanted = False  # it has a subscriber or is latched
        self._gid, self._sequence = gid, 0
        self.put: Callable[[bytes], object] = publisher.put
        if gid:
            self.put = self._put_ros
        elif signed:
            self.put = partial(publisher.put, attachment=signed)

    def _put_ros(self, payload: bytes) -> None:
        self._sequence += 1
        attachment = Attachment(self._sequence, clock.now().wall_ns, self._gid)
        self.publisher.put(payload, attachment=attachment.pack())


class Outlets:
    """The publishers of the daemon's session, and the thread that sends their messages."""

    def __init__(self, errors: list[BaseException], *, direct: bool = False) -> None:
        # `errors` gets an exception that ends the thread. `direct`: no client can block a put.
        self._errors, self._direct = errors, direct
        self._outlets: dict[str, list[_Outlet]] = {}  # by the topic's native key
        self._listeners: list[object] = []  # Zenoh ends a listener when nothing refers to it
        self._counting = Lock()
        # Native keys with a subscriber or a latched publisher.
        self.wanted_keys: frozenset[str] = frozenset()
        self._slots: dict[str, Mailbox[_Send]] = {}
        self._sent = 0  # messages that the control loop has sent itself since the last `flush`
        self.feedback_sent: Callable[[Ns], object] = _ignore
        self._slow: set[str] = set()  # topics of the control loop whose last put was slow
        self._bell = Bell()  # one for all slots, because a step fills several
        self._waiting = self._leaving = self._stuck = False
        self._dropped = 0  # displaced since the last `losses`
        self._began_ns: Ns | None = None  # the thread began to send the waiting messages
        self._thread = Worker("outlets", self._run, errors.append)

    def _count(self, outlet: _Outlet, wanted: bool) -> None:
        # Several threads of Zenoh call this method, so it takes a lock. It replaces the set
        # `wanted_keys` as a whole, because the control loop may be reading the set.
        with self._counting:
            outlet.wanted = wanted
            self.wanted_keys = frozenset(
                topic
                for topic, outlets in list(self._outlets.items())
                if any(sibling.wanted for sibling in outlets)
            )

    # The control loop calls the methods below. None of them waits.

    def publish(self, topic: str, message: Message) -> None:
        """Put a message into the slot of its native key; `flush` wakes the thread."""
        self._store(topic, partial(self._send, topic, message))

    def publish_feedback(self, topic: FeedbackTopic, estimate: Estimate) -> None:
        """Send the message of a feedback line now if that cannot block, else like `publish`."""
        if self._may_send(topic.key):
            self._send_feedback(topic, estimate)
        else:
            self._store(topic.key, partial(self._send_feedback, topic, estimate))

    def publish_beat(self, beat: Beat) -> None:
        """Send a beat now if that cannot block, else like `publish`."""
        if self._may_send(BEAT):
            self._send_beat(beat)
        else:
            self._store(BEAT, partial(self._send_beat, beat))

    def _may_send(self, topic: str) -> bool:
        self._sent += 1
        # Look for waiting messages first: the thread sets `_began_ns` before it takes one.
        return (
            self._direct
            and self._sent <= MAX_DIRECT
            and not self._slots[topic].waiting
            and self._began_ns is None
            and self._slow.isdisjoint(self.wanted_keys)
        )

    def flush(self) -> None:
        """Wake the thread for the messages that wait, at the end of a step.

        Raises the exception that has ended a thread of the bus: it must end the daemon too.
        """
        if self._errors:
            raise self._errors[0]
        self._sent = 0
        if self._waiting:
            self._waiting = False
            self._bell.ring()

    def _store(self, topic: str, send: _Send) -> None:
        if not self._slots[topic].store(send):
            self._dropped += 1
        self._waiting = True

    def losses(self, now_ns: Ns) -> tuple[int, bool]:
        """Return the newly dropped messages, and whether the bus has begun to block."""
        dropped, self._dropped = self._dropped, 0
        began_ns, was_stuck = self._began_ns, self._stuck
        self._stuck = began_ns is not None and now_ns - began_ns > BLOCKED_AFTER_NS
        return dropped, self._stuck and not was_stuck

    def start(self) -> None:
        """Start the thread that sends the messages, which may wait already."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Let the thread end after the waiting messages; wait at most `timeout` s."""
        self._leaving = True
        self._bell.ring()
        self._thread.join(timeout)

    def _run(self) -> None:
        leaving = False
        while not leaving:
            self._bell.wait()
            leaving = self._leaving
            self._began_ns = clock.mono_ns()
            for slot in self._slots.values():
                while slot.waiting:
                    slot.waiting.popleft()()
            self._began_ns = None

    # The thread and the control loop call the methods below.

    def _send_feedback(self, topic: FeedbackTopic, estimate: Estimate) -> None:
        began_ns = clock.mono_ns()
        for outlet in self._outlets[topic.key]:
            if outlet.wanted:
                # Two outlets with one encoding are rare, and a frame is filled in 3 us.
                outlet.put(topic.encode(estimate, outlet.form))
        now_ns = clock.mono_ns()
        if self._slow or now_ns - began_ns > SLOW_PUT_NS:
            self._note_put(topic.key, now_ns - began_ns)
        self.feedback_sent(now_ns - estimate.heard_ns)

    def _send_beat(self, beat: Beat) -> None:
        began_ns = clock.mono_ns()
        self._send(BEAT, beat)
        self._note_put(BEAT, clock.mono_ns() - began_ns)

    def _note_put(self, topic: str, took_ns: Ns) -> None:
        if took_ns > SLOW_PUT_NS:
            self._slow.add(topic)
        else:
            self._slow.discard(topic)

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
        """Declare one publisher of the topic with this native key, on the full key `key`.

        `type_name` is for Zenoh's Encoding. `gid` identifies a ROS publisher, whose samples have
        rmw_zenoh's attachment; `signed` is the attachment of a native one.
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
