"""Threads that hand over values, and that a hanging disk cannot stop."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import Thread

import pytest

from acsard.host.mailbox import Mailbox
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


# the items


def test_a_full_mailbox_drops_its_oldest_items_and_reports_each_to_the_writer() -> None:
    box = Mailbox[int](3)
    assert [box.put(number) for number in range(5)] == [True, True, True, False, False]
    assert (box.take(), box.lost) == ([2, 3, 4], 2)
    assert box.put(5)


# the wake-up


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
