"""Subscriptions for clients: the samples of a key, queued until the client takes them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import suppress
from typing import Any

import zenoh
import zenoh.ext

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.mailbox import Mailbox

QUEUED = 1000
"""Samples queued for a slow reader. Beyond that the oldest are dropped."""


class Arrivals(Mailbox[zenoh.Sample]):
    """The samples that Zenoh's thread hands to the reader of a subscription."""

    def __init__(self) -> None:
        super().__init__(QUEUED)
        self.declared: list[Any] = []
        """The Zenoh subscribers that fill it."""

    def try_recv(self) -> zenoh.Sample | None:
        """Return the next sample, or None if none has arrived; raise `ZError` after the end."""
        sample = self.pop()
        if sample is None and self.closed and not self.waiting:
            raise zenoh.ZError("the session has been closed")
        return sample

    def undeclare(self) -> None:
        """Undeclare the subscribers."""
        for one in self.declared:
            one.undeclare()


class Subscription:
    """The samples of a key in the order of their arrival."""

    def __init__(self, queue: Any, key: str = "") -> None:
        """Read from a queue.

        With `key`, skip samples that were put on another key or a wildcard.
        """
        self._queue, self._key = queue, key

    def try_recv(self) -> zenoh.Sample | None:
        """Return the next sample, or None if none has arrived."""
        for _ in range(QUEUED):  # bounded, so that a flood of other samples cannot hold the caller
            sample: zenoh.Sample | None = self._queue.try_recv()
            if sample is None or not self._key or on(self._key, sample):
                return sample
        return None

    def wakes(self, wake: Callable[[], object]) -> None:
        """Call `wake` on Zenoh's thread whenever a sample arrives or the subscription ends."""
        self._queue.wakes(wake)

    def add(self, sample: zenoh.Sample) -> None:
        """Append a sample that a query fetched, as if it had been published."""
        self._queue.put(sample)

    def until_silence(self, timeout: float | None) -> Iterator[zenoh.Sample]:
        """Yield samples until none arrives for `timeout` s or the session closes."""
        quiet_since_ns = clock.mono_ns()
        try:
            while True:
                try:
                    sample = self.try_recv()
                except zenoh.ZError:
                    return
                if sample is not None:
                    yield sample
                    quiet_since_ns = clock.mono_ns()
                    continue
                quiet_s = (clock.mono_ns() - quiet_since_ns) / NS_PER_S
                left = None if timeout is None else timeout - quiet_s
                if left is not None and left <= 0:
                    return
                self._queue.wait(left)
        finally:
            self.undeclare()

    async def arriving(self) -> AsyncGenerator[zenoh.Sample, None]:
        """Yield samples until the session closes."""
        come, loop = asyncio.Event(), asyncio.get_running_loop()

        def wake() -> None:
            with suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(come.set)

        self._queue.wakes(wake)
        try:
            while True:
                come.clear()
                try:
                    sample = self.try_recv()
                except zenoh.ZError:
                    return
                if sample is None:
                    await come.wait()
                    continue
                yield sample
        finally:
            self.undeclare()

    def undeclare(self) -> None:
        """Undeclare the subscribers."""
        try:
            self._queue.undeclare()
        except zenoh.ZError:
            pass  # the session is closed, which undeclared them


def on(key: str, sample: zenoh.Sample) -> bool:
    """Return whether the sample was put on exactly this key, not on a wildcard that includes it."""
    return str(sample.key_expr) == key


def encoded(sample: zenoh.Sample) -> tuple[str, bytes]:
    """Return the encoding and the payload of a sample or reply, as a `Decoder` takes them."""
    return str(sample.encoding), sample.payload.to_bytes()


def queue_on(session: zenoh.Session, *keys: str, latched: bool) -> Arrivals:
    """Subscribe to the keys. With `latched` the kept sample of each key comes first."""
    arrivals = Arrivals()
    handler = zenoh.handlers.Callback(arrivals.put, arrivals.close)
    for key in keys:
        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            one: Any = zenoh.ext.declare_advanced_subscriber(session, key, handler, history=history)
        else:
            one = session.declare_subscriber(key, handler)
        arrivals.declared.append(one)
    return arrivals
