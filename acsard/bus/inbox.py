"""What came in over the bus and waits for the next step: bounded, filled by Zenoh's threads.

A callback here only copies what it is given and never calls Zenoh back; the control loop takes
from it when it steps.
"""

from __future__ import annotations

from collections import deque
from typing import TypeVar

import zenoh

from acsard.bus.replies import Replies
from acsard.host import clock
from acsard.incoming.bus import NOTHING, BusInput, Waker
from acsard.incoming.commands import MAX_COMMAND_BYTES, Arrival, Via
from acsard.incoming.queries import BUSY, Query, most_bytes, refused
from acsard.messages.topics import IMU, JSON_TREE, VERBS, full_key, service_key, source_keys
from acsard.ros.transports import Endpoint

ARRIVALS = 16
"""Samples held of one key between two steps, the newest; at 1000 Hz and 100 steps a second 10 come
in from one who sends all he may. What comes in on other keys than those of listed sources is held
together: no flood pushes out a command on another key."""

SAMPLES = 64
"""Samples of a gyro held: what one of 400 Hz says while the loop stands still for 150 ms."""

OTHERS = ""
"""Where samples on all other keys go."""

ALL = "*"
"""In the place of a certificate's name."""

STOPS = 16
"""Stops held, apart from all else: no flood of anything can push one out."""

QUERIES = 256
"""Queries held, as many service calls, and as many of ROS for parameters, of which one is answered
in a step: the last of so many 2.6 s late. The next one is told to ask again."""

ATTACHMENT_BYTES = 256
"""An rmw_zenoh attachment has 33, ours up to 140; a longer one is cut, and nobody's."""

STOP, SET = service_key("stop"), service_key("set")
STOP_ALL = full_key("*", "stop")

T = TypeVar("T")


class Inbox:
    """Samples and queries of one robot, until they are taken."""

    def __init__(
        self, prefix: str, replies: Replies, sources: tuple[str, ...], waker: Waker
    ) -> None:
        self.own_id: zenoh.TimestampId | None = None
        """The id this session stamps unstamped samples with: no stamp of theirs."""
        self.routers: frozenset[str] = frozenset()
        """The ids that routers stamp them with: when they came by there, and nobody's name."""
        self._prefix, self._replies = prefix, replies
        self._arrivals: dict[str, deque[Arrival]] = {
            key: deque(maxlen=ARRIVALS)
            for key in (*source_keys(sources), *source_keys(sources, ALL), OTHERS)
        }
        self._arrivals[IMU] = deque(maxlen=SAMPLES)
        self._stops: deque[Arrival] = deque(maxlen=STOPS)
        self._services: deque[Query] = deque()
        self._questions: deque[Query] = deque()
        self._slow: deque[Query] = deque()
        """Those of ROS for parameters, and settings: one takes as long as all others of a step."""
        self._overrun = 0
        self._any = False
        """Something has come in; set behind it, so that none is overlooked."""
        self._waker = waker

    def take(self, queries: int) -> BusInput:
        """What came in since the last call, at most so many queries."""
        if not self._any:
            return NOTHING
        self._any = False
        arrivals = [
            one for held in self._arrivals.values() for one in taken_of(held, most_of(held))
        ]
        arrivals.sort(key=lambda one: one.arrived_ns)
        arrivals = taken_of(self._stops, STOPS) + arrivals
        asked = taken_of(self._services, queries) + taken_of(self._slow, 1)
        asked += taken_of(self._questions, queries - len(asked))
        if self._services or self._slow or self._questions:
            self._any = True  # those wait for the next step
        overrun, self._overrun = self._overrun, 0
        return BusInput(tuple(arrivals), tuple(asked), overrun)

    # Zenoh's threads

    def on_sample(self, sample: zenoh.Sample) -> None:
        """A sample on a native key."""
        key = str(sample.key_expr)
        # A stop to all robots comes by the key it was sent on.
        key = "stop" if key == STOP_ALL else key.removeprefix(self._prefix)
        self._arrived(sample, key, str(sample.encoding), "native")

    def on_ros_sample(self, endpoint: Endpoint, sample: zenoh.Sample) -> None:
        """A sample on a ROS key, which names its encoding nowhere: it stands for a native one."""
        key = str(sample.key_expr)
        native = endpoint.native if key == endpoint.key else key
        self._arrived(sample, native, endpoint.encoding, endpoint.transport)

    def _arrived(self, sample: zenoh.Sample, key: str, encoding: str, via: Via) -> None:
        arrived = clock.now()
        put = sample.kind == zenoh.SampleKind.PUT
        stamp, stamp_ns, sender, received_ns = sample.timestamp, None, "", None
        if stamp is not None:
            stamp_ns, sender = stamp.get_time_as_ntp64().as_nanos(), str(stamp.get_id())
            if stamp.get_id() == self.own_id:
                stamp_ns, sender, received_ns = None, "", stamp_ns
            elif via == "native" and sender in self.routers:
                sender = ""
        arrival = Arrival(
            key,
            put,
            _bytes(sample.payload, MAX_COMMAND_BYTES),
            encoding,
            arrived.mono_ns,
            stamp_ns,
            sender,
            via,
            _bytes(sample.attachment, ATTACHMENT_BYTES),
            received_ns,
        )
        if key == "stop" and put:
            self._stop(arrival)
            return
        held = self._line(key)
        if len(held) == held.maxlen:
            self._overrun += 1
        held.append(arrival)
        self._any = True
        if key != IMU:  # which is for the next line that the wheels send
            self._waker.command()

    def _line(self, key: str) -> deque[Arrival]:
        """The queue of a key. The certificates of one source share one, as they share a limit."""
        held = self._arrivals.get(key)
        if held is None:
            held = self._arrivals.get(f"{key.rpartition('/')[0]}/{ALL}", self._arrivals[OTHERS])
        return held

    def _stop(self, arrival: Arrival) -> None:
        self._stops.append(arrival)
        self._any = True
        self._waker.stop()

    def on_query(self, topic: str, query: zenoh.Query) -> None:
        """A query that reached a row of the native table."""
        asked = str(query.key_expr).removeprefix(self._prefix)
        if asked != topic and (topic in VERBS or topic.startswith(JSON_TREE)):
            return  # letting go of it ends it; a wildcard reaches the plain key as well
        self._asked(query, topic, asked, "", "native")

    def on_ros_query(self, endpoint: Endpoint, query: zenoh.Query) -> None:
        """A call of a ROS service."""
        if str(query.key_expr) == endpoint.key:
            native = endpoint.native
            self._asked(query, native, native, endpoint.key, endpoint.transport)

    def _line_for(self, topic: str, via: Via) -> deque[Query]:
        if topic == SET:
            return self._slow
        if topic in VERBS:
            return self._services
        return self._questions if via == "native" else self._slow

    def _asked(self, query: zenoh.Query, topic: str, asked: str, key: str, via: Via) -> None:
        arrived = clock.now()
        if topic == STOP:
            # The stop itself never waits in a line with other questions, nor is it turned away.
            by = _bytes(query.attachment, ATTACHMENT_BYTES)
            self._stop(Arrival("stop", True, b"", "", arrived.mono_ns, None, "", via, by))
        ticket = self._replies.issue(query, key)
        if ticket is None:
            return
        encoding = query.encoding
        held = Query(
            ticket,
            topic,
            asked,
            query.parameters.get("fmt", "") or "",
            _bytes(query.payload, most_bytes(topic)),
            str(encoding) if encoding else "",
            arrived.mono_ns,
            via,
            _bytes(query.attachment, ATTACHMENT_BYTES),
        )
        waiting = self._line_for(topic, via)
        if len(waiting) >= QUERIES:
            busy = refused(held, BUSY, arrived.wall_ns)
            if busy is not None:
                self._replies.send(busy)
            self._replies.retire(ticket)
            return
        waiting.append(held)
        self._any = True


def _bytes(payload: zenoh.ZBytes | None, most: int) -> bytes:
    """A copy, cut where it is too long: one byte too many is enough to refuse it by."""
    return b"" if payload is None else payload.to_bytes()[: most + 1]


def most_of(held: deque[T]) -> int:
    """No flood that goes on while they are taken out makes them more than it may hold."""
    return held.maxlen or len(held)


def taken_of(held: deque[T], most: int) -> list[T]:
    """Take up to `most` out; another thread may be putting in."""
    taken: list[T] = []
    while held and len(taken) < most:
        taken.append(held.popleft())
    return taken
