"""Sends the commands of several senders from one thread, so that no caller waits for the bus.

Each has a `Commander`, which keeps only its newest command. When it leaves, the program calls
`release()`, and the thread sends a zero if the robot may still follow, even if the bus was blocked
for long.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition
from typing import Never

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, Commander, Wish
from acsard.host import clock
from acsard.host.threads import Worker

Put = Callable[[Wish], object]  # sends one command, and may block


class Outbox:
    def __init__(self, dropped: Callable[[], object] = lambda: None) -> None:
        # `dropped` is called for each command that `Commander.send` drops.
        self._dropped = dropped
        self._senders: dict[Commander, Put] = {}
        self._zeros: list[tuple[Put, Wish]] = []
        self._news = Condition()
        self._busy = False
        # Gets an exception that ends the thread; otherwise pending.
        self.dead: Future[Never] = Future()
        Worker("outbox", self._run, self.dead.set_exception).start()

    def take(self, commander: Commander, put: Put, wish: Wish) -> None:
        """Queue a sender's command, which the thread sends by `put`."""
        with self._news:
            commander.take(wish, clock.steady_ns())
            self._senders[commander] = put
            self._news.notify_all()

    def release(self, commander: Commander, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> None:
        """Remove a sender, and queue a zero if the robot may still follow it."""
        with self._news:
            put = self._senders.pop(commander, None)
            zero = commander.end(clock.steady_ns(), timeout_s)
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
        for commander, put in waiting:
            # The bus may have blocked the previous command, so read the clock again for the age.
            with self._news:
                stale = commander.stale
                wish = commander.send(clock.steady_ns())
            if wish is not None:
                put(wish)
            elif commander.stale > stale:
                self._dropped()

    def _waiting(self) -> list[tuple[Commander, Put]]:
        return [(commander, put) for commander, put in self._senders.items() if commander.waits]
