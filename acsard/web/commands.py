"""Puts velocity commands on the bus from a thread of its own, so a blocked bus blocks nothing else.

Only the newest command of each sender waits, and only for a short time. A command is sent once,
with the stamp of its sender, or it is dropped. The server repeats nothing and makes up nothing,
except one zero command for a sender that was driving and disconnected.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Never

from msgspec import Struct

from acsard.client import Client
from acsard.host import clock
from acsard.messages.encodings import encode, encoding_name
from acsard.messages.schema import Twist, Vector3
from acsard.messages.signature import Signature
from acsard.values import NS_PER_S
from acsard.web.counts import Counts

SOURCE = "teleop"
"""The command source for a person; the arbiter prefers it to programs."""

SPACING_NS = 2_000_000
"""Minimum spacing of two commands: the daemon accepts 1000 commands a second on one key and drops
the rest."""

LATE_NS = NS_PER_S // 4
"""Maximum age of a command with a speed. An older one is dropped, because its timeout has
passed."""

SENDERS = 128
"""Maximum number of senders with a waiting command; this is more than there can be connections."""


class Order(Struct, frozen=True):
    """One command as the client sent it."""

    sender: str
    """Sender id in the form `NAME/SECRET`."""
    linear: float
    """Forward speed, m/s."""
    angular: float
    """Turn rate, rad/s, positive to the left."""
    stamp_ns: int
    """Time of the command by the sender's clock."""
    sequence: int
    given_ns: int
    """Arrival time at this server, monotonic clock."""
    steady: bool = False
    """True if the sender's clock is never adjusted."""

    @property
    def moves(self) -> bool:
        """Whether the command sets a speed other than zero."""
        return self.linear != 0.0 or self.angular != 0.0


class Hand:
    """The newest command of each sender, and the thread that publishes them.

    `client` returns the connection to the bus, or None if there is none.
    """

    def __init__(self, client: Callable[[], Client | None], counts: Counts) -> None:
        self._client, self._counts = client, counts
        self._waiting: dict[str, Order] = {}
        self._news = threading.Condition()
        self._idle = True
        self._put_ns = 0
        self.dead: Future[Never] = Future()
        """Holds the exception that ended the thread. The server must exit then: without the thread
        no viewer can drive and no zero command is sent."""
        threading.Thread(target=self._live, name="hand", daemon=True).start()

    def give(self, order: Order) -> None:
        """Queue a command in place of an older one of the same sender."""
        with self._news:
            if self._waiting.pop(order.sender, None) is not None:
                self._counts.add("commands_superseded")
            if len(self._waiting) >= SENDERS:
                self._counts.add("commands_dropped")
                return
            self._waiting[order.sender] = order
            self._news.notify_all()

    def flush(self, seconds: float) -> None:
        """Wait until the queue is empty, at most `seconds`."""
        with self._news:
            self._news.wait_for(lambda: self._idle and not self._waiting, seconds)

    def _live(self) -> None:
        try:
            while True:
                self._work(self._next())
        except BaseException as error:  # noqa: BLE001 - passed on to the waiting server
            self.dead.set_exception(error)

    def _work(self, order: Order) -> None:
        try:
            client = self._client()
            late = clock.mono_ns() - order.given_ns > LATE_NS
            if client is not None and not (late and order.moves):
                self._put(client, order)
                self._counts.add("commands")
                return
        except Exception:  # noqa: BLE001, S110 - only this one command is lost
            pass
        self._counts.add("commands_dropped")

    def _next(self) -> Order:
        with self._news:
            self._idle = True
            self._news.notify_all()
            while not self._waiting:
                self._news.wait()
            self._idle = False
            return self._waiting.pop(next(iter(self._waiting)))

    def _put(self, client: Client, order: Order) -> None:
        time.sleep(max(0, self._put_ns + SPACING_NS - clock.mono_ns()) / NS_PER_S)
        twist = Twist(Vector3(x=order.linear), Vector3(z=order.angular))
        client.session.put(
            client.key(client.command_key(SOURCE)),
            encode(twist, "msgpack"),
            encoding=encoding_name("msgpack", "Twist"),
            express=True,
            attachment=Signature(order.sender, order.stamp_ns, order.sequence, order.steady).pack(),
            timestamp=client.session.new_timestamp(),
        )
        self._put_ns = clock.mono_ns()
