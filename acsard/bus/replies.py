"""Sends replies from a thread of its own, since a client that is stuck would hold the loop.

What lives here: the Zenoh queries that wait for their replies, by number.
"""

from __future__ import annotations

import queue
import threading
from itertools import count

import zenoh

from acsard.incoming.queries import Reply

OPEN_QUERIES = 512
"""Queries whose replies are still being sent; more are let go unanswered."""


class Replies:
    """The open queries of one session."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self.session: zenoh.Session | None = None
        """Stamps replies: where a storage answers too, clients keep the newest."""
        self._open: dict[int, tuple[zenoh.Query, str]] = {}
        self._numbers = count(1)
        self._queue: queue.SimpleQueue[Reply | int | None] = queue.SimpleQueue()

    def open(self, query: zenoh.Query, key: str) -> int | None:
        """The number to reply to this query by, or None when too many are open already.

        Replies go out on `key`, or on their own below the prefix when it is "".
        """
        if len(self._open) > OPEN_QUERIES:
            return None
        number = next(self._numbers)
        self._open[number] = (query, key)
        return number

    def send(self, reply: Reply) -> None:
        """Answer a query."""
        self._queue.put(reply)

    def done(self, number: int) -> None:
        """No more replies to this query."""
        self._queue.put(number)

    def start(self) -> None:
        """Begin to send."""
        threading.Thread(target=self._run, name="replies", daemon=True).start()

    def stop(self) -> None:
        """Send what waits, and no more."""
        self._queue.put(None)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            number = item if isinstance(item, int) else item.number
            opened = self._open.get(number)
            if opened is None:
                continue
            if isinstance(item, int):
                # Dropping the query is what ends the client's wait.
                del self._open[number]
                opened[0].drop()
                continue
            try:
                self._reply(*opened, item)
            except zenoh.ZError:
                pass  # the client has gone

    def _reply(self, query: zenoh.Query, key: str, reply: Reply) -> None:
        if not reply.ok:
            query.reply_err(reply.payload, encoding=reply.encoding)
            return
        query.reply(
            key or self._prefix + reply.key,
            reply.payload,
            encoding=reply.encoding,
            attachment=reply.attachment or None,
            timestamp=self.session.new_timestamp() if self.session is not None else None,
        )
