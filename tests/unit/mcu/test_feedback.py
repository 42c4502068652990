"""Good lines in a row: their time by the wire, and the wheels' way by the counts."""

from __future__ import annotations

import math

import pytest

from acsard.config.settings import McuConfig, WheelMap
from acsard.mcu.check import Reading
from acsard.mcu.feedback import Feedback, Timeline
from acsard.mcu.frames import Codec
from acsard.values import Instant, WheelSpeeds

MS = 1_000_000
SPEEDS = WheelSpeeds(1.0, 2.0, 3.0, 4.0)
LENGTH = 36
WIRE_NS = 3_125_000
COUNTS = 3600
DEGREE = math.tau / 360
"""Ten counts."""


class Bench:
    """A timeline and the host's and the MCU's clocks."""

    def __init__(self, wheels: WheelMap | None = None, counts: int = COUNTS) -> None:
        wheels = wheels or WheelMap()
        mcu = McuConfig(wheels=wheels, encoder_counts=counts, link_check="auto")
        self.timeline = Timeline(mcu, Codec(wheels), 80.0, 100 * MS, 100.0)
        self.now_ns, self.mcu_ms = 9000 * MS, 500

    def line(
        self,
        *counts: int,
        ms: float = 10,
        mcu_ms: int | None = None,
        following: int = 0,
        gap: bool = False,
    ) -> Feedback:
        """A line `ms` later on both clocks; with counts, or without any."""
        self.now_ns += int(ms * MS)
        self.mcu_ms += int(ms) if mcu_ms is None else mcu_ms
        reading = None
        if counts:
            a, b, c, d = (count % 65536 for count in counts)
            reading = Reading(self.mcu_ms % 65536, (a, b, c, d))
        at = Instant(self.now_ns, self.now_ns + 7)
        self.timeline.read(at, LENGTH, 1, following)
        return self.timeline.place(SPEEDS, reading, following, LENGTH, gap)


def test_the_first_line_has_a_time_and_nothing_before_it() -> None:
    bench = Bench()
    found = bench.line()
    made_ns = bench.now_ns - WIRE_NS
    assert found.at == Instant(made_ns, made_ns + 7)
    assert (found.speeds, found.dt, found.gap, found.heard_ns) == (SPEEDS, 0.0, 0.0, bench.now_ns)


def test_bytes_behind_a_line_make_it_older() -> None:
    bench = Bench()
    assert bench.line(following=12).at.mono_ns == bench.now_ns - 1_041_666 - WIRE_NS


def test_without_counts_dt_is_the_hosts() -> None:
    bench = Bench()
    bench.line()
    found = bench.line(ms=12)
    assert (found.dt, found.turned) == (0.012, None)


def test_with_counts_dt_is_the_mcus_and_the_wheels_turned_as_counted() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    found = bench.line(10, -20, 30, 0, ms=17, mcu_ms=10)
    assert found.dt == 0.01
    assert found.turned == pytest.approx((DEGREE, -2 * DEGREE, 3 * DEGREE, 0.0))


def test_the_wiring_says_whose_counts_they_are_and_which_way() -> None:
    bench = Bench(WheelMap("-d", "+c", "-b", "+a"))
    bench.line(0, 0, 0, 0)
    found = bench.line(10, 20, 30, 40)
    assert found.turned == pytest.approx((-4 * DEGREE, 3 * DEGREE, -2 * DEGREE, DEGREE))


def test_the_first_counts_fall_back_to_speed_times_time() -> None:
    bench = Bench()
    bench.line()
    found = bench.line(5, 5, 5, 5)
    assert (found.dt, found.turned) == (0.01, None)


def test_lines_without_counts_end_what_was_compared() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    bench.line()
    assert bench.line(10, 10, 10, 10).turned is None
    assert bench.line(20, 20, 20, 20).turned == pytest.approx((DEGREE,) * 4)


def test_counts_bridge_a_gap_that_is_short_enough() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    found = bench.line(100, 100, 100, 100, ms=300, gap=True)
    assert (found.dt, found.gap) == (0.0, 0.3)
    assert found.turned == pytest.approx((10 * DEGREE,) * 4)


def test_counts_bridge_no_gap_in_which_they_could_have_wrapped() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    found = bench.line(100, 100, 100, 100, ms=3000, gap=True)
    assert (found.dt, found.gap, found.turned) == (0.0, 3.0, None)
    assert not bench.timeline.restarted


def test_a_restarted_clock_is_told_and_is_a_gap() -> None:
    bench = Bench()
    bench.line(900, 0, 0, 0)
    found = bench.line(0, 0, 0, 0, ms=10, mcu_ms=-500)
    assert bench.timeline.restarted
    assert (found.dt, found.gap, found.turned) == (0.0, 0.01, None)
    bench.line(0, 0, 0, 0)
    assert not bench.timeline.restarted


def test_a_leap_is_counted_and_the_speeds_stand_in() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    found = bench.line(9000, 0, 0, 0)
    assert (found.dt, found.turned) == (0.01, None)
    assert (bench.timeline.leaps, bench.timeline.restarted) == (1, False)


def test_after_forgetting_the_counts_begin_anew() -> None:
    bench = Bench()
    bench.line(0, 0, 0, 0)
    bench.timeline.forget()
    assert bench.line(10, 10, 10, 10).turned is None


def test_counts_nobody_configured_are_left_alone() -> None:
    bench = Bench(counts=0)
    bench.line(0, 0, 0, 0)
    assert bench.line(10, 10, 10, 10).turned is None
