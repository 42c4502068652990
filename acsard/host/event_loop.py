"""An asyncio event loop that calls the readers of `add_reader` without a round of its own.

A round of asyncio makes a handle for each ready descriptor and looks for timers, which takes as
long as a tenth of a control step. Here, the selector calls the readers itself. It returns to
asyncio only for something else: another descriptor, a timer, or what a reader has scheduled.
"""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable
from contextvars import Context
from functools import partial
from selectors import DefaultSelector, SelectorKey
from typing import Any, TypeVarTuple

from acsard.core.values import NS_PER_S
from acsard.host.clock import timer_ns

Ts = TypeVarTuple("Ts")


class _Selector(DefaultSelector):
    def __init__(self) -> None:
        super().__init__()
        self.scheduled = False  # asyncio has something to do
        self._readers: dict[int, Callable[[], object]] = {}
        # The descriptors of the readers, and that of this selector, which is ready if one of the
        # descriptors of asyncio is.
        self._all = select.epoll()
        self._all.register(self.fileno(), select.EPOLLIN)

    def add(self, fd: int, read: Callable[[], object]) -> None:
        if fd not in self._readers:
            self._all.register(fd, select.EPOLLIN)
        self._readers[fd] = read

    def remove(self, fd: int) -> bool:
        if self._readers.pop(fd, None) is None:
            return False
        self._all.unregister(fd)
        return True

    def select(self, timeout: float | None = None) -> list[tuple[SelectorKey, int]]:
        end_ns = None if timeout is None else timer_ns() + int(timeout * NS_PER_S)
        poll, readers = self._all.poll, self._readers
        self.scheduled = False
        while not self.scheduled and (timeout is None or timeout >= 0.0):
            ready = poll(timeout)
            for fd, _ in ready:
                read = readers.get(fd)
                if read is None:
                    self.scheduled = True
                else:
                    try:
                        read()
                    except BaseException:
                        # It would fail again, in the tasks that clean up.
                        self.remove(fd)
                        raise
            if end_ns is not None:
                timeout = (end_ns - timer_ns()) / NS_PER_S if ready else -1.0
        return super().select(0)

    def close(self) -> None:
        self._all.close()
        super().close()


class EventLoop(asyncio.SelectorEventLoop):
    """The event loop of the daemon. An exception of a reader ends it.

    A reader's descriptor is a number, and the reader must be removed before it is closed.
    """

    def __init__(self) -> None:
        self._direct = _Selector()
        super().__init__(self._direct)

    def add_reader(self, fd: Any, callback: Callable[[*Ts], Any], *args: *Ts) -> None:
        self._direct.add(fd, partial(callback, *args) if args else callback)

    def remove_reader(self, fd: Any) -> bool:
        return self._direct.remove(fd)

    def call_soon(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.Handle:
        self._direct.scheduled = True
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self,
        when: float,
        callback: Callable[[*Ts], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        self._direct.scheduled = True
        return super().call_at(when, callback, *args, context=context)
