"""Sends the commands of several viewers from one thread, so that no caller waits for the bus.

The ride of a viewer happens in its page or program, which has the zeros at the beginning and the
end. Each viewer has a `Relay`, which keeps only its newest command and never repeats one: the robot
stops when the person, the page or the network falls silent. When a viewer leaves, the program calls
`release()`, and the thread sends a zero if the robot may still follow, even if the bus was blocked
for long.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition
from typing import Never

from msgspec import Struct

from acsard.client.ride import MAX_SOURCE_TIMEOUT_S, STALE_S
from acsard.core.messages.schema import Beat
from acsard.core.values import NS_PER_S, REST, Ns, Twist
from acsard.host import clock
from acsard.host.threads import Worker


class Wish(Struct, frozen=True):
    """A twist that a person requests, with the time on the sender's clock, if it has one."""

    twist: Twist
    stamp_ns: Ns | None = None
    echo: Beat | None = None  # the newest beat that the person's program had received


class Relay:
    """Keeps the newest command of one sender. A zero is sent even if it is old."""

    def __init__(self) -> None:
        self.replaced = self.stale = 0  # not sent: replaced by a newer one; too old
        self._wish: Wish | None = None
        self._last = Wish(REST)  # sent or not
        self._came_ns: Ns = 0  # newest command
        self._moved_ns: Ns | None = None  # a speed was last sent; None after a zero

    def take(self, wish: Wish, now_ns: Ns) -> None:
        """Store a command, which replaces one that waits."""
        if self._wish is not None:
            self.replaced += 1
        self._wish = self._last = wish
        self._came_ns = now_ns

    @property
    def waits(self) -> bool:
        """Whether a command waits to be sent."""
        return self._wish is not None

    def send(self, now_ns: Ns) -> Wish | None:
        """Return the command to send now, or None; drop a speed that is old."""
        wish, self._wish = self._wish, None
        if wish is None:
            return None
        moves = wish.twist != REST
        if moves and now_ns - self._came_ns > STALE_S * NS_PER_S:
            self.stale += 1
            return None
        self._moved_ns = now_ns if moves else None
        return wish

    def end(self, now_ns: Ns, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> Wish | None:
        """End the drive, discard what waits, and return a zero to send, or None.

        After a zero, or the source's timeout since the last speed, another zero would only stop the
        next sender.
        """
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = None
        # The timeout begins when the last command arrives at the daemon, which may take 0.1 s.
        if moved_ns is None or now_ns - moved_ns > timeout_s * NS_PER_S + NS_PER_S // 10:
            return None
        # With a stamp from another clock, the daemon would assume that the sender's clock has
        # jumped.
        stamp_ns = self._last.stamp_ns
        if stamp_ns is not None:
            stamp_ns += now_ns - self._came_ns
        return Wish(REST, stamp_ns, self._last.echo)


Put = Callable[[Wish], object]  # sends one command, and may block


class Outbox:
    def __init__(self, dropped: Callable[[], object] = lambda: None) -> None:
        # `dropped` is called for each command that `Relay.send` drops.
        self._dropped = dropped
        self._senders: dict[Relay, Put] = {}
        self._zeros: list[tuple[Put, Wish]] = []
        self._news = Condition()
        self._busy = False
        # Gets an exception that ends the thread; otherwise pending.
        self.dead: Future[Never] = Future()
        Worker("outbox", self._run, self.dead.set_exception).start()

    def take(self, relay: Relay, put: Put, wish: Wish) -> None:
        """Queue a sender's command, which the thread sends by `put`."""
        with self._news:
            relay.take(wish, clock.steady_ns())
            self._senders[relay] = put
            self._news.notify_all()

    def release(self, relay: Relay, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> None:
        """Remove a sender, and queue a zero if the robot may still follow it."""
        with self._news:
            put = self._senders.pop(relay, None)
            zero = relay.end(clock.steady_ns(), timeout_s)
            if put is not None and zero is not None:
                self._zeros.append((put, zero))
            self._news.notify_all()

    def flush(self, seconds: float) -> None:
        """Wait until all queued commands have been sent, but at most `seconds`."""
        with self._news:
            self._news.wait_for(
                lambda: not (self._busy or self._zeros or self._waiting()), timeout=seconds
            )

    def _run(self) -> None:
        while True:
            self._round()

    def _round(self) -> None:
        with self._news:
            self._busy = False
            self._news.notify_all()
            while not ((waiting := self._waiting()) or self._zeros):
                self._news.wait()
            self._busy = True
            zeros, self._zeros = self._zeros, []
        for put, zero in zeros:
            put(zero)
        for relay, put in waiting:
            # The bus may have blocked the previous command, so read the clock again for the age.
            with self._news:
                stale = relay.stale
                wish = relay.send(clock.steady_ns())
            if wish is not None:
                put(wish)
            elif relay.stale > stale:
                self._dropped()

    def _waiting(self) -> list[tuple[Relay, Put]]:
        return [(relay, put) for relay, put in self._senders.items() if relay.waits]
