"""What comes on one key, held until it is taken: for those who follow a robot from outside."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import zenoh
import zenoh.ext

from acsard.host import clock
from acsard.values import NS_PER_S

QUEUED = 1000
"""Samples held for a slow reader; the oldest are dropped beyond that."""


class Subscription:
    """The samples of a key in their order."""

    def __init__(self, queue: Any, key: str = "") -> None:
        """With `key` only those on exactly it, not what a stranger put on a wildcard."""
        self._queue, self._key = queue, key

    def try_recv(self) -> zenoh.Sample | None:
        """The next sample, or None when there is none now."""
        for _ in range(QUEUED):  # no flood holds the caller
            sample: zenoh.Sample | None = self._queue.try_recv()
            if sample is None or self._key in ("", str(sample.key_expr)):
                return sample
        return None

    def until_silence(self, timeout: float | None) -> Iterator[zenoh.Sample]:
        """What comes, until nothing has for `timeout` s; then it is undeclared."""
        quiet_since_ns = clock.mono_ns()
        try:
            while timeout is None or clock.mono_ns() - quiet_since_ns < timeout * NS_PER_S:
                sample = self.try_recv()
                if sample is None:
                    time.sleep(0.001)
                    continue
                quiet_since_ns = clock.mono_ns()
                yield sample
        finally:
            self.undeclare()

    def undeclare(self) -> None:
        """No more of them."""
        self._queue.undeclare()


def encoded(sample: zenoh.Sample) -> tuple[str, bytes]:
    """Encoding and payload of a sample or answer, as a `Decoder` takes them."""
    return str(sample.encoding), sample.payload.to_bytes()


def queue_on(session: zenoh.Session, key: str, latched: bool) -> Any:
    """Subscribe: `try_recv` and `undeclare`; a latched key begins with what is kept of it."""
    # A ring: a full FIFO would hold up everything else this session receives.
    queue: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(QUEUED)
    if not latched:
        return session.declare_subscriber(key, queue)
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    return zenoh.ext.declare_advanced_subscriber(session, key, queue, history=history)
