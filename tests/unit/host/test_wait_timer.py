"""Tests of the timer that measures how long a disk operation of another thread takes."""

from __future__ import annotations

from acsard.core.values import NS_PER_S
from acsard.host.wait_timer import MAX_CALL_INTERVAL_NS, WaitTimer

PERIOD_NS = NS_PER_S // 100


def test_the_wait_grows_during_an_operation_and_is_zero_without_one() -> None:
    timer = WaitTimer()
    assert timer.wait_ns(5 * PERIOD_NS) == 0
    timer.begin()
    assert [timer.wait_ns(n * PERIOD_NS) for n in (6, 7, 8)] == [0, PERIOD_NS, 2 * PERIOD_NS]
    timer.end()
    assert [timer.wait_ns(n * PERIOD_NS) for n in (9, 10)] == [0, 0]
    assert timer.ended == 1


def test_each_operation_is_measured_from_its_own_begin() -> None:
    timer = WaitTimer()
    timer.begin()
    timer.wait_ns(0)
    timer.wait_ns(20 * PERIOD_NS)
    timer.end()
    timer.begin()
    assert [timer.wait_ns(n * PERIOD_NS) for n in (21, 22)] == [0, PERIOD_NS]
    assert timer.ended == 1


def test_a_time_in_which_the_process_was_stopped_hardly_counts() -> None:
    timer = WaitTimer()
    timer.begin()
    timer.wait_ns(0)
    assert timer.wait_ns(60 * NS_PER_S) == MAX_CALL_INTERVAL_NS
