"""Counts and the MCU's clock, both modulo 65536, give angles or the reason for a refusal."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import FeedbackConfig, McuConfig
from acsard.core.link.checked_line import Reading
from acsard.core.link.encoders import Encoders, Turned, Unknown
from acsard.core.link.link_setup import LinkSetup

MS = 1_000_000
COUNTS = 3200
FASTEST = 80.0
"""Fastest wheel speed, rad/s: 40744 counts a second, half a wrap in 0.8 s."""

WRAP_MS = 32768 / (FASTEST / math.tau * COUNTS) * 1000


class Bench:
    """The readings of an MCU, and the host's time of each reading."""

    def __init__(self, counts: int = COUNTS) -> None:
        mcu = McuConfig(link_check="on", encoder_counts=counts)
        self.setup = LinkSetup.of(mcu, 100.0, FeedbackConfig(wheel_speed=FASTEST))
        self.encoders = Encoders()
        self.mcu_ms, self.at_ms = 60_000.0, 5_000.0
        self.counts = [65_000, 100, 32_768, 0]

    def read(
        self, mcu_ms: float = 10, counts: tuple[int, ...] = (), host_ms: float | None = None
    ) -> Turned | Unknown:
        """Advance both clocks and the counts by these amounts and return the result."""
        self.mcu_ms += mcu_ms
        self.at_ms += mcu_ms if host_ms is None else host_ms
        self.counts = [c + m for c, m in zip(self.counts, counts or (0,) * 4, strict=True)]
        a, b, c, d = (count % 65536 for count in self.counts)
        reading = Reading(int(self.mcu_ms) % 65536, (a, b, c, d))
        return self.encoders.turned(self.setup, reading, int(self.at_ms * MS))


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    assert bench.read() == "unknown"
    return bench


def turned(*counts: int, dt: float = 0.01) -> Turned:
    a, b, c, d = (count * (math.tau / COUNTS) for count in counts)
    return Turned((a, b, c, d), dt)


def test_the_first_reading_gives_no_movement() -> None:
    assert Bench().read() == "unknown"


def test_a_whole_turn_is_2_pi_of_the_configured_counts() -> None:
    bench = Bench()
    bench.read()
    result = bench.read(200, (COUNTS, -COUNTS, COUNTS // 2, 0))
    assert isinstance(result, Turned)
    assert result.motors == pytest.approx((math.tau, -math.tau, math.pi, 0.0))
    assert result.dt == 0.2


def test_movement_is_exact_across_a_wrap_of_counts_and_milliseconds(bench: Bench) -> None:
    for _ in range(2000):  # 20 s, in which the clock wraps once and the counts wrap eight times
        assert bench.read(10, (300, -300, 300, -300)) == turned(300, -300, 300, -300)


@given(
    steps=st.lists(
        st.tuples(st.integers(1, 400), st.floats(-1.0, 1.0), st.floats(0.0, 300.0)), max_size=40
    )
)
def test_the_returned_angles_add_up_to_all_counts(
    steps: list[tuple[int, float, float]],
) -> None:
    bench = Bench()
    bench.read()
    began, total, clock = list(bench.counts), [0.0] * 4, 0.0
    late_ms = 0.0
    for ms, share, later_ms in steps:
        moved = int(share * FASTEST / math.tau * COUNTS * ms / 1000)
        host_ms = ms + later_ms - late_ms  # each reading has a different delay
        late_ms = later_ms
        result = bench.read(ms, (moved, -moved, moved // 2, 0), max(host_ms, 0.0))
        if host_ms < 0:
            late_ms -= host_ms
        assert isinstance(result, Turned)
        total = [t + m for t, m in zip(total, result.motors, strict=True)]
        clock += result.dt
    counted = [now - then for now, then in zip(bench.counts, began, strict=True)]
    assert total == pytest.approx([c * math.tau / COUNTS for c in counted], abs=1e-6)
    assert clock == pytest.approx(sum(ms for ms, _, _ in steps) / 1000)


@pytest.mark.parametrize("host_ms", [0.0, 5.4, 10.0, 50.0, 700.0])
def test_the_time_of_the_hosts_read_does_not_change_the_movement(
    bench: Bench, host_ms: float
) -> None:
    assert bench.read(10, (50, 50, 50, 50), host_ms) == turned(50, 50, 50, 50)


def test_a_repeated_reading_is_no_movement(bench: Bench) -> None:
    bench.read(10, (50, 50, 50, 50))
    assert bench.read(0, host_ms=3.0) == turned(0, 0, 0, 0, dt=0.0)


def test_a_gap_in_which_no_count_can_have_wrapped_is_filled(bench: Bench) -> None:
    ms = int(WRAP_MS) - 4
    assert bench.read(ms, (-900, 0, 0, 900)) == turned(-900, 0, 0, 900, dt=ms / 1000)


@pytest.mark.parametrize(("mcu_ms", "host_ms"), [(810, 810), (10, 810), (810, 780), (9000, 9000)])
def test_after_a_gap_in_which_a_count_could_have_wrapped_the_movement_is_unknown(
    bench: Bench, mcu_ms: float, host_ms: float
) -> None:
    assert bench.read(mcu_ms, (1, 1, 1, 1), host_ms) == "unknown"
    assert bench.read(10, (5, 5, 5, 5)) == turned(5, 5, 5, 5)


@pytest.mark.parametrize("motor", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_a_movement_beyond_the_fastest_motor_speed_is_a_leap(
    bench: Bench, motor: int, sign: int
) -> None:
    # two ms of rounding and four counts of play
    most = int(FASTEST / math.tau * COUNTS * 0.012) + 4
    moved = [0] * 4
    moved[motor] = sign * most
    assert isinstance(bench.read(10, tuple(moved)), Turned)
    moved[motor] += 2 * sign
    assert bench.read(10, tuple(moved)) == "leap"
    assert bench.read(10, (5, 5, 5, 5)) == turned(5, 5, 5, 5)


def test_a_clock_that_went_back_is_a_restart(bench: Bench) -> None:
    bench.mcu_ms, bench.counts = 0.0, [0] * 4
    assert bench.read(3, host_ms=30.0) == "restarted"
    assert bench.read(10, (5, 5, 5, 5)) == turned(5, 5, 5, 5)


def test_an_mcu_clock_that_leaps_ahead_of_the_hosts_clock_is_a_restart(bench: Bench) -> None:
    assert bench.read(111, host_ms=10.0) == "restarted"
    assert isinstance(bench.read(109, host_ms=10.0), Turned)


def test_a_reading_read_late_does_not_make_the_next_one_a_restart(bench: Bench) -> None:
    assert bench.read(10, (50, 50, 50, 50), host_ms=300) == turned(50, 50, 50, 50)
    # the MCU made no reading while the host slept
    result = bench.read(295, (50, 50, 50, 50), host_ms=15)
    assert isinstance(result, Turned)
    bench.mcu_ms = 0.0
    assert bench.read(3, host_ms=10.0) == "restarted"


def test_a_restart_is_detected_after_minutes_without_a_reading(bench: Bench) -> None:
    assert bench.read(200_000) == "unknown"
    assert bench.read(10, (5, 5, 5, 5)) == turned(5, 5, 5, 5)
    bench.mcu_ms = 0.0
    assert bench.read(3, host_ms=10.0) == "restarted"


@pytest.mark.parametrize("drift", [0.995, 1.005])
def test_a_drifting_clock_is_not_a_restart_and_hides_no_later_restart(
    bench: Bench, drift: float
) -> None:
    for _ in range(5000):
        assert isinstance(bench.read(10, host_ms=10 * drift), Turned)
    assert bench.read(125, host_ms=10.0) == "restarted"


@given(old_ms=st.integers(0, 65535), since_ms=st.integers(0, 90), host_ms=st.integers(1, 100))
def test_a_restart_is_missed_only_if_the_mcu_clock_happens_to_match(
    old_ms: int, since_ms: int, host_ms: int
) -> None:
    encoders, setup = Encoders(), Bench().setup
    encoders.turned(setup, Reading(old_ms, (9, 9, 9, 9)), 0)
    result = encoders.turned(setup, Reading(since_ms, (0, 0, 0, 0)), host_ms * MS)
    missed = (since_ms - old_ms) % 65536 <= host_ms + 100  # it was up for a whole number of 65.5 s
    assert (result == "restarted") is not missed


def test_after_forgetting_the_next_reading_counts_as_the_first(bench: Bench) -> None:
    bench.encoders.forget()
    assert bench.read(10, (50, 50, 50, 50)) == "unknown"
    assert bench.read(10, (50, 50, 50, 50)) == turned(50, 50, 50, 50)
