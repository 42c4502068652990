"""Sends the commands of several senders from one thread, so that no caller waits for the bus.

Each sender has a `Commander`, which keeps only the newest command of that sender. When a sender
leaves, the program must call `Outbox.release()`. The thread then sends a zero if the robot may
still follow the sender's last command. It does so even if the bus was blocked for a long time.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition, Thread
from typing import Never

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, Commander, Wish
from acsard.core.values import NS_PER_S
from acsard.host import clock

Put = Callable[[Wish], object]
"""Function that sends one command on the bus. It may block."""


class Outbox:
    """Sends the commands of several senders to the robot from a separate thread."""

    def __init__(self, dropped: Callable[[], object] = lambda: None) -> None:
        """Start the thread. It calls `dropped` for each command that `Commander.send` drops."""
        self._dropped = dropped
        self._senders: dict[Commander, Put] = {}
        self._zeros: list[tuple[Put, Wish]] = []
        self._news = Condition()
        self._busy = self._ended = False
        self.dead: Future[Never] = Future()
        """If an exception ends the thread, this future gets the exception, and no further command
        is sent. While the thread runs, and if `end` ends it, the future stays pending."""
        self._thread = Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def take(self, commander: Commander, put: Put, wish: Wish) -> int | None:
        """Queue the command `wish` of the sender `commander`. The thread calls `put` to send it.

        Returns the time since the sender's previous command, ns, or None (see `Commander.take`).
        """
        with self._news:
            silence = commander.take(wish, clock.steady_ns())
            self._senders[commander] = put
            self._news.notify_all()
        return silence

    def release(self, commander: Commander, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> None:
        """Remove the sender `commander`, and queue a zero if necessary.

        A zero is necessary if the robot may still follow the last command of this sender.
        `timeout_s` is the timeout of the sender's source, s.
        """
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
        """Wait until commands are due, and send them. Return False if the thread must end."""
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
