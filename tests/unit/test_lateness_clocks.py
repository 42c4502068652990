"""Clocks, timers and the event loop of the control loop, and real-time priority."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from acsard.core.values import NS_PER_S
from acsard.host.clock import MIN_SUSPEND_NS, SuspendDetector
from acsard.host.event_loop import EventLoop
from acsard.host.wait_timer import MAX_CALL_INTERVAL_NS, WaitTimer

WITHOUT_RAISING_LIMITS = ("setpriv", "--bounding-set", "-sys_resource") if os.geteuid() == 0 else ()
"""Words before a command, with which the command does not have CAP_SYS_RESOURCE.

Only root has this capability.
"""


def test_each_suspend_is_reported_once() -> None:
    slept = [5 * MIN_SUSPEND_NS]
    asleep = SuspendDetector(lambda: slept[0])
    assert not asleep.detect()
    for _ in range(2):
        slept[0] += MIN_SUSPEND_NS
        assert asleep.detect()
        assert not asleep.detect()


def test_a_preemption_between_the_two_clock_readings_is_not_reported_as_a_suspend() -> None:
    readings = [0, 3 * MIN_SUSPEND_NS, 0, 0]
    asleep = SuspendDetector(lambda: readings.pop(0))
    assert not asleep.detect()
    assert not asleep.detect()


PERIOD_NS = NS_PER_S // 100


def test_the_wait_grows_during_an_operation_and_is_zero_without_one() -> None:
    timer = WaitTimer()
    assert timer.wait_ns(5 * PERIOD_NS) == 0
    timer.begin()
    assert [timer.wait_ns(n * PERIOD_NS) for n in (6, 7, 8)] == [0, PERIOD_NS, 2 * PERIOD_NS]
    timer.end()
    assert [timer.wait_ns(n * PERIOD_NS) for n in (9, 10)] == [0, 0]
    assert timer.ended == 1


def test_a_time_in_which_the_process_was_stopped_hardly_counts() -> None:
    timer = WaitTimer()
    timer.begin()
    timer.wait_ns(0)
    assert timer.wait_ns(60 * NS_PER_S) == MAX_CALL_INTERVAL_NS


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
        loop.add_reader(fd, reading(fd, lambda: calls.append(3)))
        await asyncio.sleep(0.02)
        assert calls == [2, 3], "the same descriptor may have a reader again"

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


REQUEST = """\
import resource
from acsard.host import real_time

resource.setrlimit(resource.RLIMIT_RTTIME, ({hard_us}, {hard_us}))
asked = real_time.request()
print("real-time scheduling" in asked, *resource.getrlimit(resource.RLIMIT_RTTIME))
"""


@pytest.mark.parametrize(("hard_us", "low"), [(200_000, True), (700_000, False)])
def test_a_low_hard_limit_of_real_time_does_not_end_the_daemon(hard_us: int, low: bool) -> None:
    """With a `low` limit, the process stays without real-time scheduling."""
    done = subprocess.run(
        [*WITHOUT_RAISING_LIMITS, sys.executable, "-c", REQUEST.format(hard_us=hard_us)],
        capture_output=True,
        text=True,
        timeout=30.0,
        check=False,
    )
    refused, *limits = done.stdout.split()
    assert (limits, done.stderr) == ([str(hard_us)] * 2, "")
    assert refused == "True" or not low  # the other case needs a permission
