"""Threads that hand over values, and that a hanging disk cannot stop."""

from __future__ import annotations

import _thread
import asyncio
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import Thread
from typing import Any, cast

import pytest

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.mailbox import Bell, Mailbox
from acsard.host.threads import NoThreadError, begin, future_of, in_thread

NO_ROOM = 1 << 46
"""Stack size that no machine can provide, so that a thread with it cannot start."""


@contextmanager
def no_more_threads() -> Iterator[None]:
    usual = threading.stack_size(NO_ROOM)
    try:
        yield
    finally:
        threading.stack_size(usual)


def test_a_thread_that_cannot_be_started_raises_a_timeout_error() -> None:
    with no_more_threads(), pytest.raises(TimeoutError, match="cannot start another thread"):
        asyncio.run(in_thread(lambda: 1, None))
    assert asyncio.run(in_thread(lambda: 1, None)) == 1


def test_a_call_in_a_thread_is_begun_without_waiting_for_the_thread() -> None:
    """Another thread runs only if this one waits for it, or after the switch interval."""
    ran, usual = list[int](), sys.getswitchinterval()
    sys.setswitchinterval(10.0)
    try:
        begin(partial(ran.append, 1))
        at_once = list(ran)
    finally:
        sys.setswitchinterval(usual)
    assert at_once == []
    while not ran:
        time.sleep(0.001)


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_a_result_that_arrives_while_its_caller_is_cancelled_is_released_without_a_new_thread(
    rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    released: list[int] = []
    is_released = threading.Event()

    def release(result: int) -> None:
        released.append(result)
        is_released.set()

    async def caller() -> int | None:
        loop, posted = asyncio.get_running_loop(), threading.Event()
        post = loop.call_soon_threadsafe

        def and_posted(*args: Any) -> None:
            post(*args)
            posted.set()

        monkeypatch.setattr(loop, "call_soon_threadsafe", and_posted)
        task = asyncio.ensure_future(in_thread(call, None, release))
        await asyncio.sleep(0)
        threading.stack_size(NO_ROOM)
        go.set()
        # The loop stands, so the result waits for its next round.
        assert posted.wait(5.0)
        for _ in range(rounds):
            await asyncio.sleep(0)
        task.cancel()
        try:
            return await task
        except asyncio.CancelledError:
            return None

    def call() -> int:
        go.wait()
        return 7

    go, usual, threads = threading.Event(), threading.stack_size(), _thread._count()
    try:
        result = asyncio.run(caller())
    finally:
        threading.stack_size(usual)
    if result is None:
        assert is_released.wait(5.0)
    else:
        # Wait until the thread of `call` has decided.
        while _thread._count() > threads:
            time.sleep(0.01)
    assert released == ([7] if result is None else [])


def test_a_result_that_arrives_after_the_end_of_the_event_loop_is_released() -> None:
    go, released = threading.Event(), threading.Event()
    with pytest.raises(TimeoutError):
        asyncio.run(in_thread(go.wait, 0.01, lambda _: released.set()))
    assert not released.is_set()
    go.set()
    assert released.wait(5.0)


def test_a_future_has_the_result_or_the_error_of_its_call_when_it_wakes_the_caller() -> None:
    def fail() -> int:
        raise ValueError("no number")

    for call, outcome in ((lambda: 7, "7"), (fail, "no number")):
        woken = threading.Event()
        future = future_of(call, woken.set)
        assert woken.wait(5.0)
        assert future.done()
        assert str(future.exception() or future.result()) == outcome


def test_a_future_whose_thread_cannot_be_started_raises_an_error() -> None:
    with no_more_threads(), pytest.raises(NoThreadError, match="cannot start another thread"):
        future_of(lambda: 1, lambda: None)


WAIT_S = 10.0


def filled(most: int, items: int) -> Mailbox[int]:
    box = Mailbox[int](most)
    for number in range(items):
        box.put(number)
    return box


def took_s(begin_ns: int) -> float:
    return (clock.mono_ns() - begin_ns) / NS_PER_S


# the items


def test_a_full_mailbox_drops_its_oldest_items_and_reports_each_to_the_writer() -> None:
    box = Mailbox[int](3)
    assert [box.put(number) for number in range(5)] == [True, True, True, False, False]
    assert box.take() == [2, 3, 4]
    assert box.put(5)


# the wake-up


def test_a_wait_without_items_ends_after_its_timeout() -> None:
    begin_ns = clock.mono_ns()
    assert not Mailbox[int](4).wait(0.05)
    assert 0.05 <= took_s(begin_ns) < WAIT_S


def test_no_wake_up_is_lost_between_concurrent_writers_and_the_reader() -> None:
    # The reader waits without a limit, so a lost wake-up leaves it waiting for ever.
    writers, each = 4, 2000
    box, count, done = Mailbox[int](writers * each), [0], threading.Event()

    def read() -> None:
        while count[0] < writers * each:
            box.wait()
            count[0] += len(box.take())
        done.set()

    def write() -> None:
        for number in range(each):
            box.put(number)

    threads = [Thread(target=read, daemon=True)] + [Thread(target=write) for _ in range(writers)]
    for thread in threads:
        thread.start()
    assert done.wait(WAIT_S), count


@pytest.mark.parametrize(("items", "closes", "woken"), [(0, False, 0), (2, False, 1), (0, True, 1)])
def test_a_callback_that_is_set_late_is_called_for_the_items_before_it(
    items: int, closes: bool, woken: int
) -> None:
    box, calls = filled(4, items), []
    if closes:
        box.close()
    box.wakes(lambda: calls.append(1))
    assert len(calls) == woken


def test_an_error_of_the_callback_reaches_the_writer_and_the_item_is_stored() -> None:
    def fail() -> None:
        raise ValueError("a bug")

    box = Mailbox[int](4, fail)
    with pytest.raises(ValueError, match="a bug"):
        box.put(1)
    assert box.take() == [1]


# the end


def test_a_closed_mailbox_still_returns_its_items_and_never_blocks_its_reader() -> None:
    box = filled(4, 2)
    assert not box.closed
    box.close()
    assert (box.closed, box.wait(), box.take(), box.wait(), box.take()) == (
        True,
        True,
        [0, 1],
        True,
        [],
    )


# the bell


def test_two_threads_may_ring_at_the_same_moment() -> None:
    bell = Bell()
    lock = bell._lock

    class Between:
        """The lock of the bell.

        Another thread rings after the check of the bell and before the ring.
        """

        def locked(self) -> bool:
            lock.release()
            return True

        def release(self) -> None:
            lock.release()

    bell._lock = cast(threading.Lock, Between())
    bell.ring()
    bell._lock = lock
    assert bell.wait(0.0)
    assert not bell.wait(0.0)
