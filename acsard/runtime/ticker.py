"""The control period and its lateness. Missed periods are counted, never run in a burst."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import TracebackType

from msgspec import Struct

from acsard.runtime.timerfd import TimerFd


class Period(Struct, frozen=True):
    """`expired` periods ended since the last look (0: none), the newest due at `due_ns`."""

    expired: int
    due_ns: int


class Ticker:
    """Calls `wake` every period while entered; `take` says what the wake-up means."""

    def __init__(self, period_ns: int, wake: Callable[[], None]) -> None:
        self._period_ns = period_ns
        self._wake = wake
        self._timer = TimerFd()
        self._expired = 0
        self._due_ns = 0

    def start(self, now_ns: int) -> None:
        """Begin; the first period ends one period from now."""
        self._due_ns = now_ns
        self._timer.set(now_ns + self._period_ns, self._period_ns)
        asyncio.get_running_loop().add_reader(self._timer.fileno(), self._expire)

    def take(self) -> Period:
        """The periods that ended since the last call."""
        expired, self._expired = self._expired, 0
        self._due_ns += expired * self._period_ns
        return Period(expired, self._due_ns)

    def _expire(self) -> None:
        self._expired += self._timer.expirations()
        self._wake()

    def __enter__(self) -> Ticker:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._timer.fileno())
        self._timer.close()
