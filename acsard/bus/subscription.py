"""Subscriptions for clients. The samples of a key wait in a queue until the client takes them."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import suppress
from typing import Any

import zenoh
import zenoh.ext

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.mailbox import Mailbox

MAX_QUEUED_SAMPLES = 1000  # a newer sample displaces the oldest one


def direct(callback: Callable[[Any], None]) -> Any:
    """Return a handler that runs `callback` in Zenoh's receiving thread, not in a new thread."""
    return zenoh.handlers.Callback(callback, indirect=False)


class Arrivals(Mailbox[zenoh.Sample]):
    """The queue of a subscription. Zenoh's thread adds the samples, and a reader takes them."""

    def __init__(self) -> None:
        super().__init__(MAX_QUEUED_SAMPLES)
        self.declared: list[Any] = []  # the Zenoh subscribers that fill this queue

    def try_recv(self) -> zenoh.Sample | None:
        """Return the next sample, or None; raise `ZError` if the session has closed."""
        sample = self.pop()
        if sample is None and self.closed and not self.waiting:
            raise zenoh.ZError("the Zenoh session has been closed")
        return sample

    def undeclare(self) -> None:
        for subscriber in self.declared:
            subscriber.undeclare()


class Subscription:
    """The samples of the keys to which a client has subscribed, in the order of their arrival."""

    def __init__(self, queue: Any, key: str = "") -> None:
        # Samples that were not put on exactly `key`, as with a wildcard, are skipped.
        self._queue, self._key = queue, key

    def try_recv(self) -> zenoh.Sample | None:
        """Return the next sample, or None; raise `ZError` if the session has closed."""
        # The loop is bounded, because a flood of samples on other keys must not block the caller.
        for _ in range(MAX_QUEUED_SAMPLES):
            sample: zenoh.Sample | None = self._queue.try_recv()
            if sample is None or not self._key or has_exact_key(self._key, sample):
                return sample
        return None

    def wakes(self, wake: Callable[[], object]) -> None:
        """Let Zenoh's thread call `wake` when a sample arrives or the subscription ends."""
        self._queue.wakes(wake)

    def add(self, sample: zenoh.Sample) -> None:
        """Append a sample from the reply to a query, as if the sample had just been published."""
        self._queue.put(sample)

    def until_silence(
        self, timeout: float | None, look: Callable[[float], None] | None = None
    ) -> Iterator[zenoh.Sample]:
        """Yield samples until the session closes or none came for `timeout` s; then undeclare.

        In each second of a silence, `look` is called with its length, s.
        """
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
                left_s = None if timeout is None else timeout - quiet_s
                if left_s is not None and left_s <= 0:
                    return
                if look is not None:
                    look(quiet_s)
                    left_s = 1.0 if left_s is None else min(1.0, left_s)
                self._queue.wait(left_s)
        finally:
            self.undeclare()

    async def arriving(self) -> AsyncGenerator[zenoh.Sample, None]:
        """Yield samples until the session closes; then undeclare."""
        import asyncio  # it loads for 10 ms, and `acsard call stop` does not need it

        arrived, loop = asyncio.Event(), asyncio.get_running_loop()

        def wake() -> None:
            # The event loop may have ended.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(arrived.set)

        self._queue.wakes(wake)
        try:
            while True:
                arrived.clear()
                try:
                    sample = self.try_recv()
                except zenoh.ZError:
                    return
                if sample is None:
                    await arrived.wait()
                    continue
                yield sample
        finally:
            self.undeclare()

    def undeclare(self) -> None:
        """Undeclare the Zenoh subscribers, unless the session has closed."""
        try:
            self._queue.undeclare()
        except zenoh.ZError:
            pass  # closing the session has undeclared them


def has_exact_key(key: str, sample: zenoh.Sample) -> bool:
    """Return whether a sample was put on exactly `key`, and not on a key with a wildcard."""
    return str(sample.key_expr) == key


def encoded(sample: zenoh.Sample) -> tuple[str, bytes]:
    """Return the encoding and the payload of a sample, as `Decoder.decode` expects them."""
    return str(sample.encoding), sample.payload.to_bytes()


def queue_on(session: zenoh.Session, *keys: str, latched: bool) -> Arrivals:
    """Subscribe to full keys, and return the queue of their samples.

    With `latched`, the last sample that was published on each key comes first.
    """
    arrivals = Arrivals()
    handler = zenoh.handlers.Callback(arrivals.put, arrivals.close)
    for key in keys:
        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                session, key, handler, history=history
            )
        else:
            subscriber = session.declare_subscriber(key, handler)
        arrivals.declared.append(subscriber)
    return arrivals
