"""Runs work that may block in threads of its own, and passes on what ends it.

All are daemon threads, and none is of the default executor: a call that never returns, such as a
close that hangs in a driver, must not keep the process from ending.
"""

from __future__ import annotations

import _thread
import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")


class NoThreadError(TimeoutError):
    """The operating system could not start a thread, so the function was not called."""


class Worker(threading.Thread):
    """A thread that works until the process ends, or the error that ends it goes to `failed`."""

    def __init__(
        self,
        name: str,
        work: Callable[[], object],
        failed: Callable[[BaseException], object] | None = None,
    ) -> None:
        # Without `failed`, Python prints the error.
        super().__init__(name=name, daemon=True)
        self._work, self._failed = work, failed

    def start(self) -> None:
        """Start the thread. Raises `NoThreadError`."""
        try:
            super().start()
        except RuntimeError as error:
            raise _no_thread(error) from None

    def run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            if self._failed is None:
                raise
            self._failed(error)


def begin(work: Callable[[], object]) -> None:
    """Call `work` in a new thread. Raises `NoThreadError`.

    `Thread.start` would wait until the thread runs, on a busy machine for some control periods.
    """
    try:
        _thread.start_new_thread(work, ())
    except RuntimeError as error:
        raise _no_thread(error) from None


def _no_thread(error: RuntimeError) -> NoThreadError:
    return NoThreadError(f"this process cannot start another thread ({error})")


async def in_thread(
    call: Callable[[], T], timeout: float | None, late: Callable[[T], None] | None = None
) -> T:
    """Call `call` in a new thread, and return its result or raise its error.

    If the caller no longer waits, the thread passes the result to `late`, which closes for example
    a file that `call` opened. Raises `TimeoutError` after `timeout` s, and `NoThreadError`.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()
    delivered, waits_no_longer = False, threading.Event()

    def settle(result: T, error: BaseException | None) -> None:
        if future.done():
            return
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)

    def work() -> None:
        result, problem = None, None
        try:
            result = call()
        except BaseException as error:  # noqa: BLE001 - carried to the caller, whatever it is
            problem = error
        with suppress(RuntimeError):  # the caller and its event loop may have ended
            loop.call_soon_threadsafe(settle, result, problem)  # type: ignore[arg-type]
        if problem is None and late is not None:
            # Call `late` in this thread: it could block the event loop, and another thread may fail
            # to start.
            waits_no_longer.wait()
            if not delivered:
                late(result)  # type: ignore[arg-type]

    begin(work)
    try:
        # Before Python 3.12 wait_for swallows a cancellation that coincides with the result.
        async with asyncio.timeout(timeout):
            result = await future
        delivered = True
        return result
    finally:
        waits_no_longer.set()


def future_of(call: Callable[[], T], wake: Callable[[], object]) -> Future[T]:
    """Return the future of `call` in a new thread, which then calls `wake`.

    Raises `NoThreadError`.
    """
    future: Future[T] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # noqa: BLE001 - carried to the caller, whatever it is
            future.set_exception(error)
        wake()

    begin(work)
    return future
