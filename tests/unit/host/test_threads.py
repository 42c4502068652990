"""Tests of blocking calls that run in threads of their own."""

from __future__ import annotations

import asyncio
import threading

import pytest

from acsard.host.threads import in_thread

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
def test_a_result_that_arrives_while_its_caller_is_cancelled_is_released(rounds: int) -> None:
    released: list[int] = []
    is_released = threading.Event()

    def release(result: int) -> None:
        released.append(result)
        is_released.set()

    async def caller() -> int | None:
        task = asyncio.ensure_future(in_thread(call, None, release))
        await asyncio.sleep(0)
        go.set()
        # The loop stands, so the result waits for its next round.
        while any(thread.name == "call" for thread in threading.enumerate()):
            is_released.wait(0.001)
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

    go = threading.Event()
    result = asyncio.run(caller())
    if result is None:
        assert is_released.wait(5.0)
    assert released == ([7] if result is None else [])
