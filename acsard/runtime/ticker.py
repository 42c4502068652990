"""The control period and its lateness. Missed periods are counted and never run in a burst."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Self

from acsard.host.timerfd import TimerFd
from acsard.runtime.period import Period


class _Timer:
    """A kernel timer that the event loop waits on while the context is entered."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._timer = TimerFd()

    def __enter__(self) -> Self:
        asyncio.get_running_loop().add_reader(self._timer.fileno(), self._expire)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._timer.fileno())
        self._timer.close()

    def _expire(self) -> None:
        # Without an expiration the timer was set again after it went off.
        if self._timer.expirations():
            self._ring()

    def _ring(self) -> None:
        self._wake()


class Alarm(_Timer):
    """A timer that calls `wake` once, at a time that may be set again and again."""

    def __init__(self, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._at_ns: int | None = None

    def set(self, at_ns: int | None) -> None:
        """Wake at monotonic `at_ns`.

        With None nothing is set, but an earlier setting still goes off.
        """
        if at_ns is not None and at_ns != self._at_ns:
            self._timer.set(at_ns)
        self._at_ns = at_ns

    def _ring(self) -> None:
        self._at_ns = None  # it may have gone off early and be set again for the same time
        super()._ring()


class Ticker(_Timer):
    """A timer that calls `wake` every period while entered.

    `take` tells which periods have ended.
    """

    def __init__(self, period_ns: int, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._period_ns = period_ns
        self._rang = False
        self._due_ns = 0

    def start(self, now_ns: int) -> None:
        """Start; the first period ends one period from now."""
        self._due_ns = now_ns + self._period_ns
        self._timer.set(self._due_ns)

    def take(self, now_ns: int) -> Period:
        """Return the periods that have ended by `now_ns` since the last call."""
        # This uses the daemon's clock. While NTP slews the timer's clock, the timer goes off up to
        # a tenth of a period early.
        early_ns = self._period_ns // 10 if self._rang else 0
        expired = max(0, (now_ns - self._due_ns + early_ns) // self._period_ns + 1)
        due_ns = self._due_ns
        self._due_ns += expired * self._period_ns
        if expired or self._rang:
            self._timer.set(self._due_ns)
        self._rang = False
        return Period(expired, due_ns)

    def _ring(self) -> None:
        self._rang = True
        super()._ring()
