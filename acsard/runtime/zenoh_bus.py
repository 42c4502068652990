"""Owns the Zenoh session: declares from the topic table, receives, publishes what is wanted.

Zenoh calls back on threads of its own. A callback here only copies the sample into a bounded
queue and never calls Zenoh; the control loop takes from the queue when it steps. Whatever may
block (open, declare, reply, close) runs in a thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from functools import partial
from itertools import count
from types import TracebackType
from typing import Any, TypeVar

import zenoh
import zenoh.ext

from acsard.messages.encodings import encode, encoding_name
from acsard.messages.incoming import MAX_COMMAND_BYTES, Arrival
from acsard.messages.queries import Query, Reply
from acsard.messages.schema import Message
from acsard.messages.topics import PUBLISHED, ROOT, TOPICS, Topic, full_key
from acsard.runtime import clock
from acsard.runtime.control_loop import BusInput
from acsard.runtime.exits import Exit, ExitError
from acsard.runtime.threads import in_thread
from acsard.runtime.zenoh_session import daemon_session
from acsard.settings import BusConfig

ARRIVALS = 256
"""Samples held between two steps; at 1000 Hz a key and 100 steps a second, 10 is usual."""

STOPS = 16
"""Stops held, apart from all else: no flood of anything can push one out."""

QUERIES = 64
"""Queries held, and as many service calls; the next one is turned away with an error."""

OPEN_QUERIES = 512
"""Queries whose replies are still being sent; more are let go unanswered."""

T = TypeVar("T")

OPEN_TIMEOUT_S = 10.0
CLOSE_TIMEOUT_S = 0.3

TWIN_PATIENCE_S = 0.5
"""How long to listen for another daemon with our id before claiming it."""


class ZenohBus:
    """The robot's keys on the bus, while entered."""

    def __init__(self, bus: BusConfig, robot_id: str, sources: tuple[str, ...]) -> None:
        self.wanted: set[str] = set()
        self._settings, self._id, self._sources = bus, robot_id, sources
        self._prefix = f"{ROOT}/{robot_id}/"
        self._arrivals: deque[Arrival] = deque(maxlen=ARRIVALS)
        self._stops: deque[Arrival] = deque(maxlen=STOPS)
        self._services: deque[Query] = deque()
        self._questions: deque[Query] = deque()
        self._overrun = 0
        self._session: zenoh.Session | None = None
        self._own_id: zenoh.TimestampId | None = None
        self._publishers: dict[str, Any] = {}
        self._kept: list[object] = []
        """Declared entities: Zenoh undeclares what is no longer referred to."""
        self._open_queries: dict[int, zenoh.Query] = {}
        self._query_numbers = count(1)
        self._replies: queue.SimpleQueue[Reply | int | None] = queue.SimpleQueue()

    # the control loop's view

    def take(self, queries: int) -> BusInput:
        """What came in since the last call, at most so many queries."""
        arrivals = _drained(self._stops, STOPS) + _drained(self._arrivals, ARRIVALS)
        asked = _drained(self._services, queries)
        asked += _drained(self._questions, queries - len(asked))
        overrun, self._overrun = self._overrun, 0
        return BusInput(tuple(arrivals), tuple(asked), overrun)

    def publish(self, key: str, message: Message) -> None:
        """Send a message to its listeners."""
        self._publishers[key].put(encode(message, "msgpack"))

    def reply(self, reply: Reply) -> None:
        """Answer a query; a thread sends it, since a stuck client would hold us."""
        self._replies.put(reply)

    def done(self, number: int) -> None:
        """No more replies to this query."""
        self._replies.put(number)

    # opening

    async def __aenter__(self) -> ZenohBus:
        await in_thread(self._open, OPEN_TIMEOUT_S)
        threading.Thread(target=self._send_replies, name="replies", daemon=True).start()
        return self

    def _open(self) -> None:
        session = daemon_session(self._settings, self._id, self._sources)
        self._session = session
        self._own_id = session.new_timestamp().get_id()
        if self._settings.connect and self._twin(session):
            session.close()
            raise ExitError(
                Exit.IN_USE,
                f"another daemon on this bus already is {self._id}; "
                "give this robot its own robot.id",
            )
        for topic in TOPICS:
            if topic.direction == "in":
                key = full_key(self._id, topic.pattern)
                self._kept.append(session.declare_subscriber(key, self._on_sample))
            elif topic.key != "alive":
                key = full_key(self._id, topic.pattern)
                on_query = partial(self._on_query, topic.key)
                self._kept.append(session.declare_queryable(key, on_query))
        for topic in PUBLISHED:
            self._declare_publisher(session, topic)
        self._kept.append(session.liveliness().declare_token(full_key(self._id, "alive")))

    def _twin(self, session: zenoh.Session) -> bool:
        token = full_key(self._id, "alive")
        others = session.liveliness().declare_subscriber(token, history=True)
        deadline_ns = clock.now().mono_ns + int(TWIN_PATIENCE_S * 1e9)
        found = None
        while found is None and clock.now().mono_ns < deadline_ns:
            time.sleep(0.01)
            found = others.try_recv()
        others.undeclare()
        return found is not None

    def _declare_publisher(self, session: zenoh.Session, topic: Topic) -> None:
        key = full_key(self._id, topic.key)
        # One priority for all puts of the loop: another thread's blocked put on the same
        # priority would hold them up.
        options: dict[str, Any] = {
            "encoding": encoding_name("msgpack", topic.type),
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.REAL_TIME,
        }
        if topic.latched:
            self._publishers[topic.key] = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                **options,
            )
            return
        publisher = session.declare_publisher(key, **options)

        def matching(status: zenoh.MatchingStatus) -> None:
            (self.wanted.add if status.matching else self.wanted.discard)(topic.key)

        self._publishers[topic.key] = publisher
        self._kept.append(publisher.declare_matching_listener(matching))
        if publisher.matching_status:
            self.wanted.add(topic.key)

    # Zenoh's threads

    def _on_sample(self, sample: zenoh.Sample) -> None:
        arrived = clock.now()
        key = str(sample.key_expr).removeprefix(self._prefix)
        payload = sample.payload
        # An oversized payload is cut: one byte too many is enough to refuse it by.
        data = payload.to_bytes()[: MAX_COMMAND_BYTES + 1]
        put = sample.kind == zenoh.SampleKind.PUT
        stamp, stamp_ns, sender = sample.timestamp, None, ""
        if stamp is not None and stamp.get_id() != self._own_id:
            stamp_ns, sender = stamp.get_time_as_ntp64().as_nanos(), str(stamp.get_id())
        arrival = Arrival(key, put, data, str(sample.encoding), arrived.mono_ns, stamp_ns, sender)
        if key == "stop" and put:
            self._stops.append(arrival)
            return
        if len(self._arrivals) == ARRIVALS:
            self._overrun += 1
        self._arrivals.append(arrival)

    def _on_query(self, topic: str, query: zenoh.Query) -> None:
        arrived_ns = clock.now().mono_ns
        asked = str(query.key_expr).removeprefix(self._prefix)
        service = topic.startswith("srv/")
        if service and asked != topic:
            return  # letting go of it ends it
        if topic == "srv/stop":
            # The stop itself never waits in a line with other questions, nor is it turned away.
            self._stops.append(Arrival("stop", True, b"", "", arrived_ns, None, ""))
        if len(self._open_queries) > OPEN_QUERIES:
            return
        number = next(self._query_numbers)
        self._open_queries[number] = query
        waiting = self._services if service else self._questions
        if len(waiting) >= QUERIES:
            busy = b"busy: too many queries at once; ask again"
            self._replies.put(Reply(number, topic, busy, "text/plain", ok=False))
            self._replies.put(number)
            return
        payload, encoding = query.payload, query.encoding
        waiting.append(
            Query(
                number,
                topic,
                asked,
                query.parameters.get("fmt", "") or "",
                payload.to_bytes()[: MAX_COMMAND_BYTES + 1] if payload else b"",
                str(encoding) if encoding else "",
                arrived_ns,
            )
        )

    def _send_replies(self) -> None:
        while (item := self._replies.get()) is not None:
            number = item if isinstance(item, int) else item.number
            query = self._open_queries.get(number)
            if query is None:
                continue
            if isinstance(item, int):
                # Dropping the query is what ends the client's wait.
                del self._open_queries[number]
                query.drop()
                continue
            try:
                if item.ok:
                    query.reply(self._prefix + item.key, item.payload, encoding=item.encoding)
                else:
                    query.reply_err(item.payload, encoding=item.encoding)
            except zenoh.ZError:
                pass  # the client has gone

    # the way down

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._replies.put(None)
        session, self._session = self._session, None
        if session is not None:
            try:
                await in_thread(session.close, CLOSE_TIMEOUT_S)
            except TimeoutError:
                pass  # a stuck remote; the process ends without its good-bye


def _drained(held: deque[T], most: int) -> list[T]:
    """Take up to `most` out; another thread may be putting in."""
    taken: list[T] = []
    while held and len(taken) < most:
        taken.append(held.popleft())
    return taken
