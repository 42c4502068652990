"""The daemon's event loop calls readers at once, and everything else as asyncio does."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import Any

import pytest

from acsard.host.event_loop import EventLoop


@contextmanager
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe2(os.O_NONBLOCK)
    yield ends
    for end in ends:
        os.close(end)


def run(main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=EventLoop) as runner:
        runner.run(asyncio.wait_for(main, 5.0))


def reading(fd: int, then: Callable[[], object]) -> Callable[[], None]:
    def read() -> None:
        os.read(fd, 64)
        then()

    return read


def test_a_task_goes_on_when_a_reader_has_set_its_future() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        done = loop.create_future()
        loop.add_reader(fd, reading(fd, lambda: done.set_result(1)))
        os.write(other, b"x")
        assert await done == 1

    with pipe() as (fd, other):
        run(main())


def test_a_timer_that_a_reader_starts_runs_in_time() -> None:
    async def main() -> None:
        loop, began = asyncio.get_running_loop(), time.monotonic()
        done = loop.create_future()
        loop.call_later(4.0, lambda: None)
        loop.add_reader(fd, reading(fd, lambda: loop.call_later(0.02, done.set_result, 1)))
        Timer(0.02, os.write, (other, b"x")).start()
        await done
        assert 0.03 < time.monotonic() - began < 2.0

    with pipe() as (fd, other):
        run(main())


def test_timers_threads_and_tasks_run_beside_a_reader_that_is_always_ready() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        calls: list[int] = []
        loop.add_reader(fd, calls.append, 1)  # it does not read, so the descriptor stays ready
        os.write(other, b"x")
        await asyncio.sleep(0.02)
        assert await asyncio.to_thread(lambda: 7) == 7
        child = await asyncio.create_subprocess_exec("true")
        assert await child.wait() == 0
        assert len(calls) > 10

    with pipe() as (fd, other):
        run(main())


def test_a_reader_that_was_removed_is_not_called_any_more() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        calls: list[int] = []
        assert not loop.remove_reader(fd)
        loop.add_reader(fd, calls.append, 1)
        loop.add_reader(fd, reading(fd, lambda: calls.append(2)))
        os.write(other, b"x")
        await asyncio.sleep(0.02)
        assert loop.remove_reader(fd)
        os.write(other, b"x")
        await asyncio.sleep(0.02)
        assert calls == [2]

    with pipe() as (fd, other):
        run(main())


def test_an_exception_of_a_reader_ends_the_program_after_its_cleanup() -> None:
    ended: list[str] = []

    async def main() -> None:
        # It does not read, so the descriptor stays ready.
        asyncio.get_running_loop().add_reader(fd, lambda: 1 / 0)
        os.write(other, b"x")
        try:
            await asyncio.sleep(4.0)
        finally:
            await asyncio.sleep(0.02)
            ended.append("stopped")

    with (
        pipe() as (fd, other),
        pytest.raises(ZeroDivisionError),
        asyncio.Runner(loop_factory=EventLoop) as runner,
    ):
        runner.run(main())
    assert ended == ["stopped"]
