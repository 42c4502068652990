"""Tests of blocking calls, each of which runs in a separate thread."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from acsard.host.threads import NoThreadError, Worker, future_of, in_thread

NO_ROOM = 1 << 46
"""Stack size that no machine can provide, so that a thread with it cannot start."""


def test_a_thread_that_cannot_be_started_raises_a_timeout_error() -> None:
    usual = threading.stack_size(NO_ROOM)
    try:
        with pytest.raises(TimeoutError, match="cannot start another thread"):
            asyncio.run(in_thread(lambda: 1, None))
    finally:
        threading.stack_size(usual)
    assert asyncio.run(in_thread(lambda: 1, None)) == 1


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

    go, usual = threading.Event(), threading.stack_size()
    try:
        result = asyncio.run(caller())
    finally:
        threading.stack_size(usual)
    if result is None:
        assert is_released.wait(5.0)
    else:
        # Wait until the thread of `call` has decided.
        for thread in [t for t in threading.enumerate() if t.name == "call"]:
            thread.join(5.0)
    assert released == ([7] if result is None else [])


def test_a_result_that_arrives_after_the_end_of_the_event_loop_is_released() -> None:
    go, released = threading.Event(), threading.Event()
    with pytest.raises(TimeoutError):
        asyncio.run(in_thread(go.wait, 0.01, lambda _: released.set()))
    assert not released.is_set()
    go.set()
    assert released.wait(5.0)


def test_a_result_that_its_caller_has_received_is_not_released() -> None:
    released: list[int] = []

    def call() -> int:
        return 7

    assert asyncio.run(in_thread(call, None, released.append)) == 7
    for thread in threading.enumerate():
        if thread.name == "call":
            thread.join(5.0)
    assert not released


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
    usual = threading.stack_size(NO_ROOM)
    try:
        with pytest.raises(NoThreadError, match="cannot start another thread"):
            future_of(lambda: 1, lambda: None)
    finally:
        threading.stack_size(usual)


def test_the_error_that_ends_a_worker_is_passed_on() -> None:
    def fail() -> None:
        raise ValueError("no number")

    errors: list[BaseException] = []
    worker = Worker("worker", fail, errors.append)
    worker.start()
    worker.join(5.0)
    assert [str(error) for error in errors] == ["no number"]


def test_a_worker_that_cannot_be_started_raises_an_error() -> None:
    usual = threading.stack_size(NO_ROOM)
    try:
        with pytest.raises(NoThreadError, match="cannot start another thread"):
            Worker("worker", lambda: None).start()
    finally:
        threading.stack_size(usual)
