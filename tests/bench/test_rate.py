"""Find the highest control rate, and print how late a period begins on a busy machine.

    pytest -s -m bench tests/bench/test_rate.py

The whole daemon runs on a simulated microcontroller in another process, with one subscriber of
odometry. Each control period has one line and one reply. Normally `control.rate` allows at most
1000 Hz, and the baud rate limits it further; `unlimited.py` describes how the test removes these
limits. The search doubles the rate until too many periods are missed, and then bisects.
"""

from __future__ import annotations

import os
import sys

import pytest

from tests.bench.rig import Rig
from tests.bench.rigs import all_cores_busy, config, rig, schedule
from tests.bench.unlimited import BAUD_RATE

pytestmark = [pytest.mark.bench, pytest.mark.timeout(300)]

SECONDS = 4.0
MISSED = 0.01
MADE_FOR = 100.0
"""Hz."""

TRIES = 3
"""One stall of the whole machine must not decide: at 100 Hz a stall of 50 ms is more than `MISSED`.
"""

PRIORITY = 50
"""SCHED_FIFO priority of the daemon, below that of the simulated wire."""


def sample_state(running: Rig) -> tuple[float, int, int]:
    """Return the time of a `state` in s, and its counts of missed periods and feedback lines."""
    state = running.state()
    counters = state.counters
    return state.stamp.to_ns() / 1e9, counters.get("missed_periods", 0), counters["lines"]


def scheduled(running: Rig, realtime: bool) -> None:
    """Give the whole daemon a real-time priority, or remove the one that it gave to its loop.

    Skips the test if this user may not do that.
    """
    policy, priority = (os.SCHED_FIFO, PRIORITY) if realtime else (os.SCHED_OTHER, 0)
    try:
        schedule(running.process.pid, policy, priority)
    except PermissionError:
        pytest.skip("real-time scheduling is not permitted here")


def missed_share(rate: float, realtime: bool) -> float:
    """Return the share of missed periods at this rate."""
    words = (sys.executable, "-m", "tests.bench.unlimited", "--rate", str(rate))
    with rig(config(), words, wire_baud_rate=BAUD_RATE) as running:
        scheduled(running, realtime)
        before = sample_state(running)
        used = running.follow(SECONDS)
        seconds, missed, lines = (b - a for a, b in zip(before, sample_state(running), strict=True))
        running.end_program()
    share = missed / max(1.0, seconds * rate)
    print(
        f"  {rate:6.0f} Hz: {100 * share:5.2f} % missed, {rate * (1 - share):.0f} steps and "
        f"{lines / SECONDS:.0f} feedback lines a second, {100 * used:.0f} % of a core"
    )
    return share


@pytest.mark.parametrize("realtime", [False, True], ids=["normal", "fifo"])
def test_the_highest_control_rate(realtime: bool) -> None:
    def holds(rate: float) -> bool:
        return any(missed_share(rate, realtime) < MISSED for _ in range(TRIES))

    how = "SCHED_FIFO" if realtime else "normal"
    print(f"\nhighest control rate with less than 1 % of the periods missed, {how} scheduling")
    good, bad = 0.0, MADE_FOR
    while bad <= 16000.0 and holds(bad):
        good, bad = bad, 2 * bad
    for _ in range(3 if good else 0):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if holds(middle) else (good, middle)
    print(f"  {good:.0f} Hz")
    # Without real-time scheduling, other processes on the machine limit how much higher it gets.
    assert good >= (5 * MADE_FOR if realtime else MADE_FOR)


@pytest.mark.parametrize("realtime", [False, True], ids=["normal", "fifo"])
def test_the_lateness_of_a_period_idle_and_busy(realtime: bool) -> None:
    for busy in (False, True):
        with rig(config()) as running, all_cores_busy(busy):
            scheduled(running, realtime)
            running.follow(10.0)
            state = running.state()
            running.end_program()
        late = state.latencies["period_lateness"].since_start
        missed = state.counters.get("missed_periods", 0)
        print(
            f"\nlateness at 100 Hz, {'all cores busy' if busy else 'idle'}, "
            f"{'SCHED_FIFO' if realtime else 'normal'} scheduling: p50 {late.p50:.0f}, "
            f"p99 {late.p99:.0f}, max {late.max:.0f} us; {missed} periods missed"
        )
        # The rate of the measurement is the requested one.
        assert late.count + missed > 900
