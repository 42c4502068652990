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


class Subscription(Mailbox[zenoh.Sample]):
    """The samples of keys, in the order of their arrival. Zenoh's thread adds them."""

    def __init__(
        self, session: zenoh.Session, *keys: str, latched: bool = False, exact: bool = True
    ) -> None:
        # With `latched`, the last sample that was published on each key comes first. If `exact`,
        # samples that were not put on exactly one of the keys, as with a wildcard, are skipped.
        super().__init__(MAX_QUEUED_SAMPLES)
        self._exact_keys, self._declared = keys if exact else (), list[Any]()
        handler = zenoh.handlers.Callback(self.put, self.close)
        for key in keys:
            if latched:
                history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
                subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                    session, key, handler, history=history
                )
            else:
                subscriber = session.declare_subscriber(key, handler)
            self._declared.append(subscriber)

    def put(self, item: zenoh.Sample) -> bool:
        if self._exact_keys and str(item.key_expr) not in self._exact_keys:
            return False
        return super().put(item)

    def try_recv(self) -> zenoh.Sample | None:
        """Return the next sample, or None; raise `ZError` if the session has closed."""
        sample = self.pop()
        if sample is None and self.closed and not self.waiting:
            raise zenoh.ZError("the Zenoh session has been closed")
        return sample

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
                self.wait(left_s)
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

        self.wakes(wake)
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
        for subscriber in self._declared:
            with suppress(zenoh.ZError):  # closing the session has undeclared them
                subscriber.undeclare()


def has_exact_key(key: str, sample: zenoh.Sample) -> bool:
    """Return whether a sample was put on exactly `key`, and not on a key with a wildcard."""
    return str(sample.key_expr) == key


def encoded(sample: zenoh.Sample) -> tuple[str, bytes]:
    """Return the encoding and the payload of a sample, as `Decoder.decode` expects them."""
    return str(sample.encoding), sample.payload.to_bytes()
