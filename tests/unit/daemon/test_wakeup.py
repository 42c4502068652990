"""The daemon's own clock determines the periods, even if the kernel's timers are inaccurate."""

from __future__ import annotations

import asyncio

import pytest

from acsard.daemon import wakeup
from acsard.daemon.pacing import Period
from acsard.daemon.wakeup import Alarm, Next, Ticker, Wakeup

PERIOD_NS = 10_000_000


class Kernel:
    """A kernel timer whose clock is slewed by NTP: it waits `rate` times as long as requested."""

    def __init__(self) -> None:
        self.now_ns, self.rate, self.at_ns = 5_000_000_000, 1.0, 0
        self.count = 1

    def set(self, at_ns: int) -> None:
        self.at_ns = self.now_ns + round((at_ns - self.now_ns) * self.rate)

    def expirations(self) -> int:
        return self.count


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    kernel = Kernel()
    monkeypatch.setattr(wakeup, "TimerFd", lambda: kernel)
    return kernel


def goes_off(kernel: Kernel, ticker: Ticker, late_ns: int = 0) -> Period:
    kernel.now_ns = kernel.at_ns + late_ns
    ticker._expire()
    return ticker.take(kernel.now_ns)


@pytest.mark.parametrize("rate", [0.92, 1.0, 1.08])
def test_a_slewed_timer_neither_loses_a_period_nor_drifts(kernel: Kernel, rate: float) -> None:
    ticker = Ticker(PERIOD_NS, lambda: None)
    kernel.rate = rate
    start_ns = kernel.now_ns
    ticker.start(start_ns)
    for number in range(1, 1001):
        assert goes_off(kernel, ticker) == Period(1, start_ns + number * PERIOD_NS)
        assert abs(kernel.now_ns - start_ns - number * PERIOD_NS) < PERIOD_NS / 10


def test_periods_that_were_missed_are_counted_from_the_first(kernel: Kernel) -> None:
    ticker = Ticker(PERIOD_NS, lambda: None)
    start_ns = kernel.now_ns
    ticker.start(start_ns)
    assert goes_off(kernel, ticker, late_ns=3 * PERIOD_NS) == Period(4, start_ns + PERIOD_NS)
    assert goes_off(kernel, ticker) == Period(1, start_ns + 5 * PERIOD_NS)


def test_a_late_step_does_not_count_the_period_that_ends_after_it(kernel: Kernel) -> None:
    ticker = Ticker(PERIOD_NS, lambda: None)
    start_ns = kernel.now_ns
    ticker.start(start_ns)
    late_ns = PERIOD_NS - PERIOD_NS // 20
    assert goes_off(kernel, ticker, late_ns) == Period(1, start_ns + PERIOD_NS)
    assert goes_off(kernel, ticker) == Period(1, start_ns + 2 * PERIOD_NS)


def test_a_timer_that_expires_again_before_it_is_read_ends_no_period_twice(
    kernel: Kernel,
) -> None:
    woken: list[int] = []
    ticker = Ticker(PERIOD_NS, lambda: woken.append(1))
    start_ns = kernel.now_ns
    ticker.start(start_ns)
    kernel.now_ns = kernel.at_ns
    for _ in range(3):
        ticker._expire()
    assert len(woken) == 3
    assert ticker.take(kernel.now_ns) == Period(1, start_ns + PERIOD_NS)
    assert ticker.take(kernel.now_ns).expired == 0


def test_expired_periods_are_counted_also_if_a_command_wakes_the_loop_first(kernel: Kernel) -> None:
    """After a stall, the loop may get a waiting command before it gets the timer."""
    ticker = Ticker(PERIOD_NS, lambda: None)
    start_ns = kernel.now_ns
    ticker.start(start_ns)
    kernel.now_ns += 39 * PERIOD_NS + PERIOD_NS // 2
    assert ticker.take(kernel.now_ns) == Period(39, start_ns + PERIOD_NS)
    assert kernel.at_ns == start_ns + 40 * PERIOD_NS
    kernel.now_ns = kernel.at_ns - PERIOD_NS // 20
    assert ticker.take(kernel.now_ns).expired == 0, "only a timer goes off early"
    assert goes_off(kernel, ticker) == Period(1, start_ns + 40 * PERIOD_NS)


def test_a_timer_that_goes_off_much_too_early_is_set_again(kernel: Kernel) -> None:
    ticker = Ticker(PERIOD_NS, lambda: None)
    start_ns = kernel.now_ns
    kernel.rate = 0.5
    ticker.start(start_ns)
    kernel.rate = 1.0
    assert goes_off(kernel, ticker).expired == 0
    assert kernel.at_ns == start_ns + PERIOD_NS


def test_an_alarm_that_went_off_too_early_may_be_set_for_the_same_time_again(
    kernel: Kernel,
) -> None:
    woken: list[int] = []
    alarm = Alarm(lambda: woken.append(1))
    at_ns = kernel.now_ns + PERIOD_NS
    alarm.set(at_ns)
    kernel.at_ns = 0
    alarm.set(at_ns)
    assert kernel.at_ns == 0, "it is set for that already"
    alarm._expire()
    alarm.set(at_ns)
    assert kernel.at_ns == at_ns
    assert woken == [1]


def test_an_expiry_from_before_the_timer_was_set_again_wakes_nothing(kernel: Kernel) -> None:
    woken: list[int] = []
    ticker = Ticker(PERIOD_NS, lambda: woken.append(1))
    ticker.start(kernel.now_ns)
    kernel.count = 0
    ticker._expire()
    assert not woken
    assert ticker.take(kernel.now_ns).expired == 0


async def test_in_a_flood_of_stops_one_step_is_early_and_the_period_takes_the_rest() -> None:
    wakeup, waiting, steps = Wakeup(), 0, list[int]()
    ends = False

    def step() -> Next | None:
        """Process the waiting stops. `Next` says whether the period has ended."""
        nonlocal waiting
        steps.append(waiting)
        waiting = 0
        return None if len(steps) > 3 else Next(False, None, ends)

    running = asyncio.create_task(wakeup.run(step))
    await asyncio.sleep(0)
    for _ in range(100):
        waiting += 1
        wakeup.stop()
        await asyncio.sleep(0)
    assert (len(steps), sum(steps) + waiting) == (1, 100)
    ends = True
    wakeup()  # the period
    assert (len(steps), sum(steps)) == (2, 100)
    waiting += 1
    wakeup.stop()
    await asyncio.sleep(0.01)
    assert steps[2:] == [1], "the next stop gets an early step again"
    wakeup()
    await running
