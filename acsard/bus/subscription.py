"""What comes on one key, held until it is taken: for those who follow a robot from outside."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import suppress
from typing import Any

import zenoh
import zenoh.ext

from acsard.host import clock
from acsard.values import NS_PER_S

QUEUED = 1000
"""Samples held for a slow reader; the oldest are dropped beyond that."""


class Arrivals:
    """What Zenoh's thread hands over, until it is taken: a callback and an event."""

    def __init__(self) -> None:
        self.declared: list[Any] = []
        """What Zenoh gave for it."""
        self._held: deque[zenoh.Sample] = deque(maxlen=QUEUED)
        self._event = threading.Event()
        self._wake: Callable[[], object] = self._event.set
        self._closed = False

    def take(self, sample: zenoh.Sample) -> None:
        """One has come."""
        self._held.append(sample)
        self._wake()

    def close(self) -> None:
        """No more will come."""
        self._closed = True
        self._wake()

    def wakes(self, wake: Callable[[], object]) -> None:
        """Have this called, on a thread of Zenoh's, when something has come or all has ended."""
        self._wake = wake

    def try_recv(self) -> zenoh.Sample | None:
        """The next, or None when there is none now; raises `ZError` when none will be."""
        try:
            return self._held.popleft()
        except IndexError:
            if self._closed:
                raise zenoh.ZError("the session has been closed") from None
            return None

    def wait(self, seconds: float | None) -> None:
        """Until something has come, all has ended, or so long."""
        if not self._held and not self._closed:
            self._event.wait(seconds)
        self._event.clear()

    def undeclare(self) -> None:
        """No more of them."""
        for one in self.declared:
            one.undeclare()


class Subscription:
    """The samples of a key in their order."""

    def __init__(self, queue: Any, key: str = "") -> None:
        """With `key` only those on exactly it, not what a stranger put on a wildcard."""
        self._queue, self._key = queue, key

    def try_recv(self) -> zenoh.Sample | None:
        """The next sample, or None when there is none now."""
        for _ in range(QUEUED):  # no flood holds the caller
            sample: zenoh.Sample | None = self._queue.try_recv()
            if sample is None or not self._key or on(self._key, sample):
                return sample
        return None

    def add(self, sample: zenoh.Sample) -> None:
        """Take one that was asked for as if it had come by itself."""
        self._queue.take(sample)

    def until_silence(self, timeout: float | None) -> Iterator[zenoh.Sample]:
        """What comes, until nothing has for `timeout` s or the session is closed."""
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
        """What comes, until the session is closed."""
        come, loop = asyncio.Event(), asyncio.get_running_loop()

        def wake() -> None:
            with suppress(RuntimeError):  # the loop has ended
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
        """No more of them."""
        try:
            self._queue.undeclare()
        except zenoh.ZError:
            pass  # with its session closed it is no more already


def on(key: str, sample: zenoh.Sample) -> bool:
    """It came on exactly this key: what a stranger put on a wildcard did not."""
    return str(sample.key_expr) == key


def encoded(sample: zenoh.Sample) -> tuple[str, bytes]:
    """Encoding and payload of a sample or answer, as a `Decoder` takes them."""
    return str(sample.encoding), sample.payload.to_bytes()


def queue_on(session: zenoh.Session, *keys: str, latched: bool) -> Arrivals:
    """Subscribe; a latched key begins with what is kept of it."""
    arrivals = Arrivals()
    handler = zenoh.handlers.Callback(arrivals.take, arrivals.close)
    for key in keys:
        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            one: Any = zenoh.ext.declare_advanced_subscriber(session, key, handler, history=history)
        else:
            one = session.declare_subscriber(key, handler)
        arrivals.declared.append(one)
    return arrivals
