"""Sends the commands of several senders from one thread, so that no caller waits for the bus.

Each has a `Commander`, which keeps only its newest command. When it leaves, the program calls
`release()`, and the thread sends a zero if the robot may still follow, even if the bus was blocked
for long.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition, Thread
from typing import Never

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, Commander, Wish
from acsard.core.values import NS_PER_S
from acsard.host import clock

Put = Callable[[Wish], object]  # sends one command, and may block


class Outbox:
    def __init__(self, dropped: Callable[[], object] = lambda: None) -> None:
        # `dropped` is called for each command that `Commander.send` drops.
        self._dropped = dropped
        self._senders: dict[Commander, Put] = {}
        self._zeros: list[tuple[Put, Wish]] = []
        self._news = Condition()
        self._busy = self._ended = False
        # Gets an exception that ends the thread; otherwise pending.
        self.dead: Future[Never] = Future()
        self._thread = Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def take(self, commander: Commander, put: Put, wish: Wish) -> int | None:
        """Queue a sender's command, which the thread sends by `put`; see `Commander.take`."""
        with self._news:
            silence = commander.take(wish, clock.steady_ns())
            self._senders[commander] = put
            self._news.notify_all()
        return silence

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
                lambda: not (self._busy or self._zeros or self._times()), timeout=seconds
            )

    def end(self, seconds: float) -> None:
        """End the thread after it has sent the commands that are due. Wait at most `seconds`."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        self._thread.join(seconds)

    def _run(self) -> None:
        try:
            while self._round():
                pass
        except BaseException as error:  # noqa: BLE001 - passed on to the program
            self.dead.set_exception(error)

    def _round(self) -> bool:
        with self._news:
            self._busy = False
            self._news.notify_all()
            while not ((due := self._due()) or self._zeros or self._ended):
                times = self._times()
                left_ns = min(times) - clock.steady_ns() if times else None
                self._news.wait(None if left_ns is None else max(0, left_ns) / NS_PER_S)
            self._busy = True
            zeros, self._zeros = self._zeros, []
        for put, zero in zeros:
            put(zero)
        for commander, put in due:
            # The bus may have blocked the previous command, so read the clock again for the age.
            with self._news:
                stale = commander.stale
                wish = commander.send(clock.steady_ns())
            if wish is not None:
                put(wish)
            elif commander.stale > stale:
                self._dropped()
        return bool(zeros or due)

    def _times(self) -> list[int]:
        times = (commander.due_ns() for commander in self._senders)
        return [due_ns for due_ns in times if due_ns is not None]

    def _due(self) -> list[tuple[Commander, Put]]:
        now_ns = clock.steady_ns()
        return [
            (commander, put)
            for commander, put in self._senders.items()
            if (due_ns := commander.due_ns()) is not None and due_ns <= now_ns
        ]
