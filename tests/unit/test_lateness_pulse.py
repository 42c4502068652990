"""A step runs at the end of each period, and between for bytes, a command, a stop or a retry."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from threading import Thread

import pytest

from acsard.core.values import NS_PER_S, Instant
from acsard.daemon.pacing import NO_PERIOD, Pace, Period
from acsard.daemon.pulse import Pulse
from acsard.host import clock

MS = 1_000_000
PERIOD_NS = 10 * MS
LONG_NS = 3600 * NS_PER_S
"""A period that does not end during a test."""


class Steps:
    """The steps that a pulse has run, and what the next ones expect."""

    def __init__(self) -> None:
        self.pulse = Pulse()
        self.all: list[tuple[Instant, Period]] = []
        self.pace = Pace(0, 1)
        self.pace.early = False
        self.work: Callable[[], None] = lambda: None
        """Called in each step."""

    def __call__(self, now: Instant, period: Period) -> bool:
        self.all.append((now, period))
        self.work()
        return True

    def wake(self, period: Period = NO_PERIOD) -> None:
        """Run a step, at the end of a period or not."""
        self.pulse(clock.now(), period)

    @asynccontextmanager
    async def running(self, seconds: float, period_ns: int = LONG_NS) -> AsyncIterator[Pulse]:
        """Run the pulse while the body runs, and then for `seconds` s."""
        running = asyncio.create_task(self.pulse.run(period_ns, self, self.pace))
        await asyncio.sleep(0)
        yield self.pulse
        await asyncio.sleep(seconds)
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


def count_all(steps: Steps) -> None:
    """Check that each step has counted exactly the periods that ended since the step before it."""
    start_ns = steps.all[0][1].due_ns
    ended = 0
    for now, period in steps.all:
        ended += period.expired
        # Another process may run between the readings of two clocks, so one period is allowed.
        assert abs((now.mono_ns - start_ns) // PERIOD_NS + 1 - ended) <= 1


async def test_each_period_that_ends_runs_one_step() -> None:
    steps = Steps()
    steps.wake()  # a signal during the start, before the first step
    assert steps.all == []
    async with steps.running(0.2, PERIOD_NS):
        pass
    count_all(steps)
    assert sum(period.expired for _, period in steps.all) >= 19
    assert all(period.expired for _, period in steps.all)
    assert all(period.due_ns <= now.mono_ns for now, period in steps.all)


async def test_missed_periods_are_counted_once_and_never_made_up() -> None:
    steps = Steps()
    steps.work = lambda: time.sleep(0.0455) if len(steps.all) == 1 else None
    async with steps.running(0.1, PERIOD_NS):
        pass
    count_all(steps)
    _, (late, missed), *_ = steps.all
    assert missed.expired >= 4
    assert late.mono_ns - missed.due_ns >= 34 * MS
    assert all(period.expired for _, period in steps.all)


async def test_after_a_stall_an_event_counts_the_periods_and_no_further_step_runs() -> None:
    steps, loop = Steps(), asyncio.get_running_loop()

    def stall() -> None:
        if len(steps.all) == 1:
            # The loop then finds both the callback and the timer due in the same round.
            loop.call_soon(lambda: steps.pulse(clock.now()))
            time.sleep(0.0355)

    steps.work = stall
    async with steps.running(0.065, PERIOD_NS):
        pass
    count_all(steps)
    assert steps.all[1][1].expired >= 3
    assert all(period.expired for _, period in steps.all)


@pytest.mark.parametrize("early", [True, False])
async def test_a_command_runs_a_step_only_if_the_last_step_expects_one(early: bool) -> None:
    steps = Steps()
    steps.pace.early = early
    async with steps.running(0.1):
        steps.wake()
        Thread(target=steps.pulse.command).start()
    assert [period for _, period in steps.all] == [NO_PERIOD] * (1 + early)


async def test_a_command_during_a_step_that_expects_early_ones_runs_another_step() -> None:
    steps = Steps()
    steps.pace.early = True
    steps.work = lambda: steps.pulse.command() if len(steps.all) == 1 else None
    async with steps.running(0.05):
        steps.wake()
    assert len(steps.all) == 2


async def test_in_a_flood_of_stops_one_step_is_early_and_the_period_takes_the_rest() -> None:
    steps = Steps()
    async with steps.running(0.1):
        for _ in range(100):
            steps.pulse.stop()
            await asyncio.sleep(0)
        assert len(steps.all) == 1
        steps.wake(Period(1, 0))
        assert len(steps.all) == 2
        steps.pulse.stop()
        await asyncio.sleep(0.01)
        assert len(steps.all) == 3, "the next stop gets an early step again"


async def test_a_command_that_waits_is_retried_at_its_time_and_only_once() -> None:
    steps = Steps()
    async with steps.running(0.1):
        steps.pace.retry_ns = at_ns = clock.mono_ns() + 20 * MS
        steps.wake()
        steps.wake()  # the retry is not set again
        steps.pace.retry_ns = None
    assert len(steps.all) == 3
    assert steps.all[2][0].mono_ns - at_ns > -0.1 * MS


async def test_a_port_that_a_step_finds_lost_runs_no_step_within_the_step() -> None:
    steps = Steps()
    steps.work = lambda: steps.pulse(clock.now())
    async with steps.running(0.02):
        steps.wake()
    assert len(steps.all) == 1


async def test_an_exception_of_a_step_ends_the_run_and_a_later_event_runs_no_step() -> None:
    steps = Steps()

    def fail() -> None:
        raise ValueError("a bug")

    steps.work = fail
    with pytest.raises(ValueError, match="a bug"):
        await steps.pulse.run(PERIOD_NS, steps, steps.pace)
    steps.pulse.stop()
    steps.wake()
    assert len(steps.all) == 1
