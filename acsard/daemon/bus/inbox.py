"""Buffers the samples and queries from the bus for the next control step, and sends the replies.

Zenoh's threads fill the buffers, which are bounded. A callback only copies its input and never
calls Zenoh: even a refusal is queued for `Replies`, whose thread sends all replies, because a
client that hangs would block the control loop. A query has a number, its ticket, which a reply
names. When it is retired, Zenoh's query is dropped and the client stops waiting.
"""

from __future__ import annotations

import queue
from collections import deque
from contextlib import suppress
from functools import partial
from itertools import count

import zenoh
from msgspec.structs import replace

from acsard.core.incoming.bus_interface import NO_INPUT, BusInput, Waker
from acsard.core.incoming.commands import Arrival, Via, parts, publisher_name
from acsard.core.incoming.queries import Query, Reply, most_bytes, refused
from acsard.core.messages.keys_and_roles import (
    ANY_SERVICE,
    IMU,
    JSON_TREE,
    SPEED_LIMIT,
    STOP,
    VERBS,
    is_service,
    service_key,
    source_keys,
)
from acsard.core.messages.refusals import BUSY, BUSY_ENCODING, MAX_COMMAND_BYTES
from acsard.core.ros.names import gid
from acsard.core.ros.transports import Endpoint, Transport
from acsard.core.values import BRIDGES, NS_PER_S, Announcement
from acsard.host import clock
from acsard.host.mailbox import Mailbox
from acsard.host.threads import Worker

MAX_OPEN_QUERIES = 1024  # a further query is dropped without an answer


class Replies:
    """The queries that are not ended yet, and the thread that sends the replies to them."""

    def __init__(self, prefix: str, errors: list[BaseException]) -> None:
        # `errors` gets an exception that ends the thread.
        self._prefix, self._errors = prefix, errors
        self._queries: dict[int, tuple[zenoh.Query, str]] = {}
        self._tickets = count(1)
        # A ticket ends its query, and None the thread.
        self._queue: queue.SimpleQueue[Reply | int | None] = queue.SimpleQueue()

    def issue(self, query: zenoh.Query, key: str) -> int | None:
        """Return the ticket of a query, or None beyond `MAX_OPEN_QUERIES`.

        Replies go to the full key `key`, or if it is "", to `Reply.key` below the robot's id.
        """
        if len(self._queries) >= MAX_OPEN_QUERIES:
            return None
        ticket = next(self._tickets)
        self._queries[ticket] = (query, key)
        return ticket

    def send(self, reply: Reply) -> None:
        self._queue.put(reply)

    def retire(self, ticket: int) -> None:
        """End the query with this ticket as soon as the replies queued so far are sent."""
        self._queue.put(ticket)

    def start(self, session: zenoh.Session) -> None:
        """Start the thread that sends the replies, which may be queued already."""
        Worker("replies", partial(self._run, session), self._errors.append).start()

    def stop(self) -> None:
        """Let the thread end after the queued replies, without waiting."""
        self._queue.put(None)

    def _run(self, session: zenoh.Session) -> None:
        while (item := self._queue.get()) is not None:
            ticket = item if isinstance(item, int) else item.ticket
            entry = self._queries.get(ticket)
            if entry is None:
                continue
            query, key = entry
            try:
                if isinstance(item, int):
                    del self._queries[ticket]
                    query.drop()
                else:
                    self._reply(session, query, key, item)
            except zenoh.ZError:
                # The client has disconnected.
                pass

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


# Samples of a command key at 100 steps a second, more at a lower rate; the oldest goes. A sender at
# the limit of 1000 Hz puts 10 between two steps.
COMMAND_BUFFER = 16

MAX_DISPLACED = 16  # senders of displaced commands that `take` returns

GYRO_BUFFER = 64  # samples: 400 Hz fill it if the control loop takes none for 160 ms

# A command like the one before it waits for the next period, unless more time has passed: then the
# robot may have stopped meanwhile.
REPEAT_NS = NS_PER_S // 10

# All unconfigured sources share a buffer, so that they cannot displace a configured command.
OTHER_SOURCES = ""

ANY_CERTIFICATE = "*"  # for the name of any certificate in a command key

MAX_TOKENS = 1024  # of publishers

STOP_BUFFER = 16  # no flood of commands displaces a stop

# Size of the queues of service calls, of slow queries (`set`, ROS parameters) and of others; more
# are refused with `BUSY`. One slow query per step: the last of 256 waits 2.6 s at 100 Hz.
QUERY_QUEUE = 256

# rmw_zenoh's has 33, acsard's up to 140, and a later version's may have more. A longer one is cut
# off and names no sender.
MAX_ATTACHMENT_BYTES = 1024

STOP_SERVICE, SET = service_key("stop"), service_key("set")


class Inbox:
    """The samples and queries for one robot, buffered until the control loop calls `take`."""

    def __init__(
        self,
        prefix: str,
        replies: Replies,
        sources: tuple[str, ...],
        waker: Waker,
        rate_hz: float = 100.0,
    ) -> None:
        # `waker` wakes the control loop for a command or a stop.
        # The daemon's session stamps samples without a timestamp, so one with this id is not the
        # sender's.
        self.own_id: zenoh.TimestampId | None = None
        self._prefix, self._replies, self._sources = prefix, replies, sources
        self._arrivals: dict[str, Mailbox[Arrival]] = {
            key: Mailbox(max(COMMAND_BUFFER, round(COMMAND_BUFFER * 100.0 / rate_hz)), self._note)
            for key in (
                *source_keys(sources),
                *source_keys(sources, ANY_CERTIFICATE),
                OTHER_SOURCES,
            )
        }
        # Only these can be commands. A gyro sample does not wake the control loop: it waits for the
        # next feedback line.
        self._newest: dict[str, Arrival | None] = dict.fromkeys(self._arrivals)
        self._arrivals[IMU] = Mailbox(GYRO_BUFFER, self._note)
        self._arrivals[SPEED_LIMIT] = Mailbox(COMMAND_BUFFER, self._note)
        self._stops = Mailbox[Arrival](STOP_BUFFER, self._stopped)
        # These queues are not mailboxes. In a full mailbox, a new query would displace the oldest
        # one. Here the new query must be refused.
        self._services: deque[Query] = deque()
        self._others: deque[Query] = deque()  # native ones that are neither services nor slow
        # ROS parameters and `set`: one takes as long as all others of a step.
        self._slow: deque[Query] = deque()
        self._lost = dict.fromkeys(self._arrivals, 0)  # displaced samples that `take` has reported
        # The newest displaced command of each sender since the last `take`.
        self._displaced: dict[tuple[str, Via, str, bool], Arrival] = {}
        # The tokens of bridges by source, and the newest change of each sender since `take`.
        self._bridges: dict[str, set[str]] = {}
        self._announced: dict[tuple[str, str], Announcement] = {}
        self._lost_stops = 0  # displaced ones that `take` has reported
        self._any = False  # set after the item is in its buffer, so `take` overlooks none
        self._waker = waker

    def take(self, queries: int) -> BusInput:
        """Return the samples since the last call, stops first, and up to `queries` queries."""
        if not self._any:
            return NO_INPUT
        self._any = False
        arrivals, overrun = list[Arrival](), 0
        for key, box in self._arrivals.items():
            if not box.waiting:
                continue
            arrivals += box.take()
            if box.lost != self._lost[key]:
                overrun += box.lost - self._lost[key]
                self._lost[key] = box.lost
        displaced, self._displaced = self._displaced, {}
        announced, self._announced = self._announced, {}
        arrivals.sort(key=lambda arrival: arrival.arrived_ns)
        stops = self._stops.take()
        if self._stops.lost != self._lost_stops:
            # Others have stopped the robot, too: one stop without a name stands for them.
            self._lost_stops = self._stops.lost
            stops.append(replace(stops[-1], attachment=b"", sender=""))
        arrivals = stops + arrivals
        due_queries = _taken_of(self._services, queries) + _taken_of(self._slow, 1)
        due_queries += _taken_of(self._others, queries - len(due_queries))
        if self._services or self._slow or self._others:
            # The other queries wait for the next step.
            self._any = True
        return BusInput(
            tuple(arrivals),
            tuple(due_queries),
            overrun,
            tuple(displaced.values()),
            tuple(announced.values()),
        )

    # Zenoh's threads call the methods below.

    def on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr).removeprefix(self._prefix)
        self._arrived(sample, key, str(sample.encoding), "native")

    def on_stop(self, via: Via, sample: zenoh.Sample) -> None:
        """Queue a sample of a subscriber to stops: a stop, whatever its key expression says."""
        self._arrived(sample, STOP, "", via)

    def on_ros_sample(self, endpoint: Endpoint, sample: zenoh.Sample) -> None:
        """Queue a ROS sample like one on `endpoint.native`, with the endpoint's encoding."""
        key = str(sample.key_expr)
        native = endpoint.native if key == endpoint.key else key
        self._arrived(sample, native, endpoint.encoding, endpoint.transport)

    def on_token(self, source: str, transport: Transport, sample: zenoh.Sample) -> None:
        """Queue that the token of a ROS publisher for a source has appeared or disappeared."""
        token, present = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        sender = BRIDGES
        if transport == "rmw":
            sender = publisher_name(gid(token))
        else:
            # Several bridges are one sender, and a change of one of them is a change.
            bridges = self._bridges.setdefault(source, set())
            (bridges.add if present and len(bridges) < MAX_TOKENS else bridges.discard)(token)
            present = bool(bridges)
        # A flood may hide that a publisher is there, but never that one is gone.
        if not present or len(self._announced) < MAX_TOKENS or (source, sender) in self._announced:
            at_ns = clock.now().mono_ns
            self._announced[source, sender] = Announcement(source, sender, present, at_ns)
            self._any = True

    def _arrived(self, sample: zenoh.Sample, key: str, encoding: str, via: Via) -> None:
        arrived, boot_ns = clock.now(), clock.boot_ns()
        put = sample.kind == zenoh.SampleKind.PUT
        stamp, stamp_ns, sender, received_ns = sample.timestamp, None, "", None
        if stamp is not None:
            at_ns, session = stamp.get_time_as_ntp64().as_nanos(), stamp.get_id()
            if session == self.own_id:
                received_ns = at_ns
            else:
                stamp_ns, sender = at_ns, str(session)
        arrival = Arrival(
            key,
            put,
            _bytes(sample.payload, MAX_COMMAND_BYTES),
            encoding,
            arrived.mono_ns,
            stamp_ns,
            sender,
            via,
            _bytes(sample.attachment, MAX_ATTACHMENT_BYTES),
            received_ns,
            boot_ns,
        )
        if key == STOP and put:
            self._stops.put(arrival)
        else:
            self._put(self._buffer(key), arrival)

    def _put(self, buffer: str, arrival: Arrival) -> None:
        box = self._arrivals[buffer]
        waiting = box.waiting
        if len(waiting) == waiting.maxlen and parts(arrival.key)[1] in self._sources:
            # With several writers this may miss one of two samples that are displaced at once. The
            # deque is empty if the control loop has just taken all samples.
            with suppress(IndexError):
                self._note_displaced(waiting[0])
        box.put(arrival)
        if buffer not in self._newest:
            return
        last, self._newest[buffer] = self._newest[buffer], arrival
        if (
            last is None
            or arrival.payload != last.payload
            or arrival.key != last.key
            or arrival.arrived_ns - last.arrived_ns > REPEAT_NS
        ):
            self._waker.command()

    def _note_displaced(self, lost: Arrival) -> None:
        # Samples of one program and one key have the same of these values, except that programs
        # with a sender id need no distinction: no other program shares their identity.
        sender = lost.key, lost.via, lost.sender, bool(lost.attachment)
        if sender in self._displaced or len(self._displaced) < MAX_DISPLACED:
            self._displaced[sender] = lost

    def _buffer(self, key: str) -> str:
        if key in self._arrivals:
            return key
        any_certificate = f"{key.rpartition('/')[0]}/{ANY_CERTIFICATE}"
        return any_certificate if any_certificate in self._arrivals else OTHER_SOURCES

    def _note(self) -> None:
        self._any = True

    def _stopped(self) -> None:
        self._any = True
        self._waker.stop()

    def on_query(self, topic: str, query: zenoh.Query) -> None:
        """Queue a query on the key `topic`, without the robot's id.

        A wildcard must not call a service, and `**` matches a JSON key (`json/...`) too, whose
        other key answers. `ANY_SERVICE` also matches the services that have a key of their own.
        """
        asked = str(query.key_expr).removeprefix(self._prefix)
        if topic == ANY_SERVICE and asked not in VERBS and is_service(asked) and "*" not in asked:
            topic = asked
        if asked != topic and (is_service(topic) or topic.startswith(JSON_TREE)):
            # Returning without a ticket drops the query.
            return
        self._queried(query, topic, asked, "", "native")

    def on_ros_query(self, endpoint: Endpoint, query: zenoh.Query) -> None:
        """Queue a query on a ROS key; a wildcard must not call a service."""
        if str(query.key_expr) == endpoint.key:
            native = endpoint.native
            self._queried(query, native, native, endpoint.key, endpoint.transport)

    def _queue_of(self, topic: str, via: Via) -> deque[Query]:
        if topic == SET:
            return self._slow
        if topic in VERBS:
            return self._services
        return self._others if via == "native" else self._slow

    def _queried(self, query: zenoh.Query, topic: str, asked: str, key: str, via: Via) -> None:
        arrived = clock.now()
        if topic == STOP_SERVICE:
            # The stop itself never waits for other queries, and is never refused with `BUSY`.
            by = _bytes(query.attachment, MAX_ATTACHMENT_BYTES)
            self._stops.put(Arrival(STOP, True, b"", "", arrived.mono_ns, None, "", via, by))
        ticket = self._replies.issue(query, key)
        if ticket is None:
            return
        encoding = query.encoding
        item = Query(
            ticket,
            topic,
            asked,
            query.parameters.get("fmt", "") or "",
            _bytes(query.payload, most_bytes(topic)),
            str(encoding) if encoding else "",
            arrived.mono_ns,
            via,
            _bytes(query.attachment, MAX_ATTACHMENT_BYTES),
        )
        waiting = self._queue_of(topic, via)
        if len(waiting) >= QUERY_QUEUE:
            busy = refused(item, BUSY, arrived.wall_ns, BUSY_ENCODING)
            if busy is not None:
                self._replies.send(busy)
            self._replies.retire(ticket)
            return
        waiting.append(item)
        self._any = True


def _bytes(payload: zenoh.ZBytes | None, most: int) -> bytes:
    # `most` + 1 bytes show that the payload is too long.
    return b"" if payload is None else payload.to_bytes()[: most + 1]


def _taken_of(queries: deque[Query], most: int) -> list[Query]:
    return [queries.popleft() for _ in range(min(most, len(queries)))]
