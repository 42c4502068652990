"""Sends replies from a thread of its own, because a stuck client would block the control loop.

This module holds the Zenoh queries that wait for their replies. Each query gets a numbered ticket
when it arrives, and replies name that ticket. Retiring the ticket drops the query, which ends the
client's wait.
"""

from __future__ import annotations

import queue
import threading
from itertools import count

import zenoh

from acsard.incoming.queries import Reply

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
