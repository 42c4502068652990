"""Tests of the clock, and of the report of each suspend."""

from __future__ import annotations

import time

import pytest

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.clock import MIN_SUSPEND_NS, SuspendDetector, asleep_ns

WALL_NS = 1_800_000_000_000_000_000


class Machine:
    """A machine that suspends this process for 0.2 s, for the first `takes` times.

    It does so right before each reading of the wall clock.
    """

    def __init__(self, takes: int) -> None:
        self.takes, self.ns = takes, 5_000_000_000

    def mono_ns(self) -> int:
        self.ns += 1500
        return self.ns

    def wall_ns(self) -> int:
        if self.takes:
            self.takes -= 1
            self.ns += 200_000_000
        return WALL_NS + self.ns


@pytest.mark.parametrize("takes", [0, 1, 3])
def test_both_clocks_are_read_at_the_same_moment(
    monkeypatch: pytest.MonkeyPatch, takes: int
) -> None:
    machine = Machine(takes)
    monkeypatch.setattr(clock, "mono_ns", machine.mono_ns)
    monkeypatch.setattr(time, "time_ns", machine.wall_ns)
    at = clock.now()
    assert at.wall_ns - at.mono_ns == WALL_NS


def test_reading_both_clocks_stops_retrying_on_a_slow_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = Machine(1000)
    monkeypatch.setattr(clock, "mono_ns", machine.mono_ns)
    monkeypatch.setattr(time, "time_ns", machine.wall_ns)
    assert clock.now().wall_ns - WALL_NS == (machine.ns - 1500) // 1000 * 1000


def test_an_instant_is_in_whole_microseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "mono_ns", Machine(0).mono_ns)
    monkeypatch.setattr(time, "time_ns", lambda: WALL_NS + 1_999)
    at = clock.now()
    assert (at.mono_ns % 1000, at.wall_ns) == (0, WALL_NS + 1_000)


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


def test_no_suspend_is_reported_while_the_machine_is_awake() -> None:
    asleep = SuspendDetector(asleep_ns)
    assert not any(asleep.detect() for _ in range(1000))


def test_the_steady_clock_advances_during_a_suspend(monkeypatch: pytest.MonkeyPatch) -> None:
    asleep_ns = clock.asleep_ns()
    before_s = clock.steady_s()
    monkeypatch.setattr(clock, "asleep_ns", lambda: asleep_ns + 60 * NS_PER_S)
    assert 60.0 <= clock.steady_s() - before_s < 70.0
