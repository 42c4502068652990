"""Sends replies from a thread of its own, since a client that is stuck would hold the loop.

What lives here: the Zenoh queries that wait for their replies. Each has a ticket, a number: it is
issued when the query comes in, replies are sent by it, and when it is retired the query is let go,
which ends the client's wait.
"""

from __future__ import annotations

import queue
import threading
from itertools import count

import zenoh

from acsard.incoming.queries import Reply

TICKETS = 1024
"""Queries whose replies are still being sent; more are let go unanswered."""


class Replies:
    """The queries of one robot that are not answered yet."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._queries: dict[int, tuple[zenoh.Query, str]] = {}
        self._tickets = count(1)
        self._queue: queue.SimpleQueue[Reply | int | None] = queue.SimpleQueue()
        """Replies and retired tickets, in order; None ends the thread."""

    def issue(self, query: zenoh.Query, key: str) -> int | None:
        """A ticket to reply to this query by, or None when too many are out.

        Replies go out on `key`, or on their own below the prefix when it is "".
        """
        if len(self._queries) > TICKETS:
            return None
        ticket = next(self._tickets)
        self._queries[ticket] = (query, key)
        return ticket

    def send(self, reply: Reply) -> None:
        """Answer a query."""
        self._queue.put(reply)

    def retire(self, ticket: int) -> None:
        """No more replies by this ticket."""
        self._queue.put(ticket)

    def start(self, session: zenoh.Session) -> None:
        """Begin to send; what was answered before waits until then."""
        threading.Thread(target=self._run, args=(session,), name="replies", daemon=True).start()

    def stop(self) -> None:
        """Send what waits, and no more."""
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
                pass  # the client has gone

    def _reply(self, session: zenoh.Session, query: zenoh.Query, key: str, reply: Reply) -> None:
        if not reply.ok:
            query.reply_err(reply.payload, encoding=reply.encoding)
            return
        query.reply(
            key or self._prefix + reply.key,
            reply.payload,
            encoding=reply.encoding,
            attachment=reply.attachment or None,
            # Where a storage answers too, clients keep the newest.
            timestamp=session.new_timestamp(),
        )
