"""Buffers the samples and queries from the bus for the next control step, and sends the replies.

Zenoh's threads fill the buffers, and every buffer is bounded. A callback here only copies its input
and never calls Zenoh back, except to send a refusal through `Replies`.

The replies go from a thread of its own, because a stuck client would block the control loop. Each
query gets a numbered ticket when it arrives, and replies name that ticket. Retiring the ticket
drops the query, which ends the client's wait.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from itertools import count

import zenoh

from acsard.core.incoming.bus_interface import NOTHING, BusInput, Waker
from acsard.core.incoming.commands import MAX_COMMAND_BYTES, Arrival, Via
from acsard.core.incoming.queries import BUSY, Query, Reply, most_bytes, refused
from acsard.core.messages.topics import IMU, JSON_TREE, VERBS, full_key, service_key, source_keys
from acsard.core.ros.transports import Endpoint
from acsard.host import clock
from acsard.host.mailbox import Mailbox

TICKETS = 1024
"""Queries held at once. Further queries are dropped without an answer."""


class Replies:
    """The queries of one robot that are not finished yet."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._queries: dict[int, tuple[zenoh.Query, str]] = {}
        self._tickets = count(1)
        self._queue: queue.SimpleQueue[Reply | int | None] = queue.SimpleQueue()
        """Replies and retired tickets, in order. None ends the thread."""

    def issue(self, query: zenoh.Query, key: str) -> int | None:
        """Return a ticket for this query, or None if too many are held.

        The replies go out on `key`, or if `key` is "" on the key of each reply below the prefix.
        """
        if len(self._queries) > TICKETS:
            return None
        ticket = next(self._tickets)
        self._queries[ticket] = (query, key)
        return ticket

    def send(self, reply: Reply) -> None:
        """Queue a reply to a query."""
        self._queue.put(reply)

    def retire(self, ticket: int) -> None:
        """Queue the end of a query: it gets no more replies."""
        self._queue.put(ticket)

    def start(self, session: zenoh.Session) -> None:
        """Start sending. Replies queued earlier wait until then."""
        threading.Thread(target=self._run, args=(session,), name="replies", daemon=True).start()

    def stop(self) -> None:
        """Send the queued replies and stop."""
        self._queue.put(None)

    def _run(self, session: zenoh.Session) -> None:
        while (item := self._queue.get()) is not None:
            ticket = item if isinstance(item, int) else item.ticket
            held = self._queries.get(ticket)
            if held is None:
                continue
            query, key = held
            if isinstance(item, int):
                del self._queries[ticket]
                query.drop()
                continue
            try:
                self._reply(session, query, key, item)
            except zenoh.ZError:
                pass  # the client has disconnected

    def _reply(self, session: zenoh.Session, query: zenoh.Query, key: str, reply: Reply) -> None:
        if not reply.ok:
            query.reply_err(reply.payload, encoding=reply.encoding)
            return
        query.reply(
            key or self._prefix + reply.key,
            reply.payload,
            encoding=reply.encoding,
            attachment=reply.attachment or None,
            # A storage may reply too. The timestamp lets clients keep the newest reply.
            timestamp=session.new_timestamp(),
        )


ARRIVALS = 16
"""Newest samples buffered per key between two steps. A sender at the limit of 1000 Hz puts 10 of
them into one step at 100 Hz. The samples on keys of unlisted sources share one buffer, so a flood
there cannot push out a command on a listed key."""

SAMPLES = 64
"""Newest gyro samples buffered: a gyro at 400 Hz fills them while the loop stands still for 150
ms."""

OTHERS = ""
"""The buffer's key for samples on all unlisted keys."""

ALL = "*"
"""Placeholder for the certificate's name in a key."""

STOPS = 16
"""Stops buffered. They have a buffer of their own, so that no flood can push one out."""

QUERIES = 256
"""Queries buffered in each of three queues: services, other native queries, and the slow ones. One
slow query is answered per step, so the last of 256 waits 2.6 s. Further queries are refused with
`BUSY`."""

ATTACHMENT_BYTES = 256
"""Bytes of an attachment that are kept. An attachment of rmw_zenoh has 33, ours up to 140. A longer
one is cut, so it decodes to no sender."""

STOP, SET = service_key("stop"), service_key("set")
STOP_ALL = full_key("*", "stop")


class Inbox:
    """Samples and queries of one robot, buffered until `take`."""

    def __init__(
        self, prefix: str, replies: Replies, sources: tuple[str, ...], waker: Waker
    ) -> None:
        self.own_id: zenoh.TimestampId | None = None
        """The id with which this session stamps samples that came without a timestamp. Such a
        timestamp is not the sender's."""
        self.routers: frozenset[str] = frozenset()
        """The ids with which routers stamp samples. Such an id tells when a sample passed a router,
        but does not identify its sender."""
        self._prefix, self._replies = prefix, replies
        self._arrivals: dict[str, Mailbox[Arrival]] = {
            key: Mailbox(ARRIVALS, self._commanded)
            for key in (*source_keys(sources), *source_keys(sources, ALL), OTHERS)
        }
        # A gyro sample wakes nobody: it waits for the next feedback of the wheels.
        self._arrivals[IMU] = Mailbox(SAMPLES, self._note)
        self._stops = Mailbox[Arrival](STOPS, self._stopped)
        # Queries are no mailbox: a query that finds no room is refused, and displaces no other.
        self._services: deque[Query] = deque()
        self._questions: deque[Query] = deque()
        self._slow: deque[Query] = deque()
        """ROS parameter queries and settings. One of them takes as long as all other queries of a
        step."""
        self._overrun = 0
        self._any = False
        """Whether something has arrived. It is set after the item is queued, so that no item is
        overlooked."""
        self._waker = waker

    def take(self, queries: int) -> BusInput:
        """Return the input since the last call, stops first and the other samples by arrival time.

        It holds at most `queries` queries, and one more if all of them are services and a slow
        query waits.
        """
        if not self._any:
            return NOTHING
        self._any = False
        arrivals = [one for box in self._arrivals.values() if box.waiting for one in box.take()]
        arrivals.sort(key=lambda one: one.arrived_ns)
        arrivals = self._stops.take() + arrivals
        asked = _taken_of(self._services, queries) + _taken_of(self._slow, 1)
        asked += _taken_of(self._questions, queries - len(asked))
        if self._services or self._slow or self._questions:
            self._any = True  # the rest waits for the next step
        overrun, self._overrun = self._overrun, 0
        return BusInput(tuple(arrivals), tuple(asked), overrun)

    # Zenoh's threads call the methods below.

    def on_sample(self, sample: zenoh.Sample) -> None:
        """Queue a sample on a native key."""
        key = str(sample.key_expr)
        # A stop to all robots arrives under the key that it was sent on.
        key = "stop" if key == STOP_ALL else key.removeprefix(self._prefix)
        self._arrived(sample, key, str(sample.encoding), "native")

    def on_ros_sample(self, endpoint: Endpoint, sample: zenoh.Sample) -> None:
        """Queue a sample on a ROS key as a sample of the native key that it stands for.

        ROS keys carry no encoding, so the endpoint supplies it.
        """
        key = str(sample.key_expr)
        native = endpoint.native if key == endpoint.key else key
        self._arrived(sample, native, endpoint.encoding, endpoint.transport)

    def _arrived(self, sample: zenoh.Sample, key: str, encoding: str, via: Via) -> None:
        arrived = clock.now()
        put = sample.kind == zenoh.SampleKind.PUT
        stamp, stamp_ns, sender, received_ns = sample.timestamp, None, "", None
        if stamp is not None:
            at_ns, session = stamp.get_time_as_ntp64().as_nanos(), stamp.get_id()
            if session == self.own_id:
                received_ns = at_ns
            else:
                stamp_ns, sender = at_ns, str(session)
                if via == "native" and sender in self.routers:
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
            self._stops.put(arrival)
        else:
            line = self._line(key)
            # The count comes before the wake-up, because the reader takes both at once.
            self._overrun += not line.store(arrival)
            line.wake()

    def _line(self, key: str) -> Mailbox[Arrival]:
        """Return the buffer of a key.

        The certificates of one source share it, as they share a rate limit.
        """
        held = self._arrivals.get(key)
        if held is None:
            held = self._arrivals.get(f"{key.rpartition('/')[0]}/{ALL}", self._arrivals[OTHERS])
        return held

    def _note(self) -> None:
        self._any = True

    def _commanded(self) -> None:
        self._any = True
        self._waker.command()

    def _stopped(self) -> None:
        self._any = True
        self._waker.stop()

    def on_query(self, topic: str, query: zenoh.Query) -> None:
        """Queue a query that matched a row of the native topic table."""
        asked = str(query.key_expr).removeprefix(self._prefix)
        if asked != topic and (topic in VERBS or topic.startswith(JSON_TREE)):
            return  # dropping the query ends it; a wildcard also matches the plain key
        self._asked(query, topic, asked, "", "native")

    def on_ros_query(self, endpoint: Endpoint, query: zenoh.Query) -> None:
        """Queue a call of a ROS service."""
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
            # The stop itself never waits behind other queries and is never refused as busy.
            by = _bytes(query.attachment, ATTACHMENT_BYTES)
            self._stops.put(Arrival("stop", True, b"", "", arrived.mono_ns, None, "", via, by))
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
    """Copy a payload, cut to `most` + 1 bytes: the extra byte shows that it is too long."""
    return b"" if payload is None else payload.to_bytes()[: most + 1]


def _taken_of(queries: deque[Query], most: int) -> list[Query]:
    return [queries.popleft() for _ in range(min(most, len(queries)))]
