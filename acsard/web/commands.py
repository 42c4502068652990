"""Hands commands to the bus, on a thread of its own: a bus that is locked holds up nobody else.

Of each sender only the newest waits, and not for long: a command goes out once, with the stamp of
who meant it, or it is dropped. Nothing is repeated and nothing made up here but the zero of one who
drove and has gone.
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
"""A person's: it goes before programs."""

SPACING_NS = 2_000_000
"""The daemon takes 1000 commands a second on a key: what comes on the heels of another is lost."""

LATE_NS = NS_PER_S // 4
"""A speed that waited here for so long is dropped: its timeout is over."""

SENDERS = 128
"""Who may wait at once; more than there are connections."""


class Order(Struct, frozen=True):
    """One command, as it came."""

    sender: str
    """The sender id, `NAME/SECRET`."""
    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    stamp_ns: int
    """By the sender's clock."""
    sequence: int
    given_ns: int
    """When it came here, monotonic."""
    steady: bool = False
    """Nobody adjusts the sender's clock."""

    @property
    def moves(self) -> bool:
        """It is no zero."""
        return self.linear != 0.0 or self.angular != 0.0


class Hand:
    """The newest of each sender, to the bus; `client` gives the way there, None without one."""

    def __init__(self, client: Callable[[], Client | None], counts: Counts) -> None:
        self._client, self._counts = client, counts
        self._waiting: dict[str, Order] = {}
        self._news = threading.Condition()
        self._idle = True
        self._put_ns = 0
        self.dead: Future[Never] = Future()
        """Raises what ended the thread, if ever: without it nobody drives, and no zero goes out."""
        threading.Thread(target=self._live, name="hand", daemon=True).start()

    def give(self, order: Order) -> None:
        """Hand this on, in the place of an older one of the same sender."""
        with self._news:
            if self._waiting.pop(order.sender, None) is not None:
                self._counts.add("commands_superseded")
            if len(self._waiting) >= SENDERS:
                self._counts.add("commands_dropped")
                return
            self._waiting[order.sender] = order
            self._news.notify_all()

    def flush(self, seconds: float) -> None:
        """Wait until all is handed on, for so long at most."""
        with self._news:
            self._news.wait_for(lambda: self._idle and not self._waiting, seconds)

    def _live(self) -> None:
        try:
            while True:
                self._work(self._next())
        except BaseException as error:  # noqa: BLE001 - carried to who waits for it
            self.dead.set_exception(error)

    def _work(self, order: Order) -> None:
        try:
            client = self._client()
            late = clock.mono_ns() - order.given_ns > LATE_NS
            if client is not None and not (late and order.moves):
                self._put(client, order)
                self._counts.add("commands")
                return
        except Exception:  # noqa: BLE001, S110 - of one command; the next is another's, or a zero
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
