"""The firmware's other pure parts, compiled for this machine: watchdog, speed, control, bridge."""

from __future__ import annotations

import ctypes
import math
import random
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

TOP = 400
"""PWM_TOP at 16 MHz and 20 kHz."""

TICKS = 2_000_000
"""Of the edge clock in a second."""

COUNTS_PER_TURN = 3200


class WatchdogC(ctypes.Structure):
    _fields_ = (("fed_ms", ctypes.c_uint32), ("fed", ctypes.c_bool))


class SpeedC(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_uint16),
        ("still", ctypes.c_bool),
        ("edge", ctypes.c_uint32),
        ("read", ctypes.c_uint32),
        ("value", ctypes.c_float),
    )


class PiC(ctypes.Structure):
    _fields_ = (("integral", ctypes.c_float),)


class BridgeC(ctypes.Structure):
    _fields_ = (
        ("duty", ctypes.c_int16),
        ("direction", ctypes.c_int8),
        ("rest", ctypes.c_uint8),
    )


@pytest.fixture(scope="session")
def logic(library: ctypes.CDLL) -> ctypes.CDLL:
    """The library with its types told."""
    u16, u32, single = ctypes.c_uint16, ctypes.c_uint32, ctypes.c_float
    told: list[tuple[str, list[Any], Any]] = [
        ("watchdog_start", [], None),
        ("watchdog_feed", [u32], None),
        ("watchdog_allows", [u32], ctypes.c_bool),
        ("speed_start", [u16, u32], None),
        ("speed_update", [u16, u32, u32], single),
        ("pi_reset", [], None),
        ("pi_step", [single, single, ctypes.c_bool], single),
        ("bridge_off", [], None),
        ("bridge_step", [ctypes.c_int16], ctypes.c_bool),
    ]
    for name, arguments, result in told:
        function = getattr(library, name)
        function.argtypes = [ctypes.c_void_p, *arguments]
        function.restype = result
    library.speed_hundredths.argtypes = [single]
    library.speed_hundredths.restype = ctypes.c_int16
    return library


# watchdog


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 400), max_size=40))
def test_the_watchdog_allows_for_300_ms_after_each_feeding_however_the_clock_wraps(
    logic: ctypes.CDLL, start: int, steps: list[int]
) -> None:
    dog = WatchdogC()
    at = ctypes.addressof(dog)
    logic.watchdog_start(at)
    now = start
    assert not logic.watchdog_allows(at, now), "boots stopped"
    for step in steps:
        logic.watchdog_feed(at, now)
        assert logic.watchdog_allows(at, now)
        for ms in range(0, step, 7):
            assert logic.watchdog_allows(at, (now + ms) % 2**32) == (ms < 300)
        now = (now + step) % 2**32
        assert logic.watchdog_allows(at, now) == (step < 300)


def test_a_tripped_watchdog_stays_so_when_the_clock_comes_round(logic: ctypes.CDLL) -> None:
    dog = WatchdogC()
    at = ctypes.addressof(dog)
    logic.watchdog_start(at)
    logic.watchdog_feed(at, 1000)
    assert not logic.watchdog_allows(at, 1300)
    assert not logic.watchdog_allows(at, 1001), "49 days later"


# speed


def readings(
    rate: float, every: float, seconds: float, start: int = 0, jitter: float = 0.0
) -> Iterator[tuple[int, int, int]]:
    """Count, time of its last edge, and time, of a wheel that turns at `rate` counts a second."""
    rng = random.Random(1)
    now, count, edge = 0.0, 0, 0.0
    while now < seconds:
        now += every * (1 + jitter * (rng.random() - 0.5))
        whole = math.floor(rate * now)
        if whole != count:
            count = whole
            edge = (whole if rate > 0 else whole + 1) / rate
        yield (
            (start + count) % 65536,
            (start + round(edge * TICKS)) % 2**32,
            (start + round(now * TICKS)) % 2**32,
        )


@pytest.mark.parametrize("start", [0, 65530, 2**32 - TICKS])
@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0, 10.0, 60.0, -0.3, -10.0, -60.0])
@pytest.mark.parametrize("every", [0.005, 0.01, 0.02])
def test_a_steady_speed_is_said_to_a_thousandth(
    logic: ctypes.CDLL, speed: float, every: float, start: int
) -> None:
    rate = speed / math.tau * COUNTS_PER_TURN
    wheel = SpeedC()
    at = ctypes.addressof(wheel)
    logic.speed_start(at, start % 65536, start)
    said = [logic.speed_update(at, *reading) for reading in readings(rate, every, 1.0, start, 0.5)]
    settled = said[len(said) // 2 :]
    assert all(one == pytest.approx(speed, rel=1e-3, abs=1e-4) for one in settled)


def test_a_wheel_that_stops_is_said_to_be_slower_and_slower_and_then_still(
    logic: ctypes.CDLL,
) -> None:
    wheel = SpeedC()
    at = ctypes.addressof(wheel)
    logic.speed_start(at, 0, 0)
    for reading in readings(500.0, 0.01, 0.5):
        logic.speed_update(at, *reading)
    count, edge, now = reading
    said = [logic.speed_update(at, count, edge, now + ms * TICKS // 1000) for ms in range(5, 200)]
    assert said == sorted(said, reverse=True)
    assert said[-1] == 0.0
    assert next(ms for ms, one in enumerate(said, 5) if one == 0.0) <= 105


def test_the_first_edges_after_a_rest_make_no_spike(logic: ctypes.CDLL) -> None:
    """The wheel starts at 1 rad/s somewhere within a window."""
    for late in range(1, 10):
        wheel = SpeedC()
        at = ctypes.addressof(wheel)
        logic.speed_start(at, 0, 0)
        for ms in range(0, 300, 10):
            logic.speed_update(at, 0, 0, ms * 2000)
        began = 290 * 2000 + late * 2000
        first = began + round(math.tau / COUNTS_PER_TURN * TICKS)
        count = max(0, 1 + math.floor((300 * 2000 - first) * COUNTS_PER_TURN / math.tau / TICKS))
        edge = round(began + count * math.tau / COUNTS_PER_TURN * TICKS)
        assert logic.speed_update(at, count, edge, 300 * 2000) <= 1.0


@given(st.floats(-1e6, 1e6))
def test_hundredths_are_rounded_and_bounded(logic: ctypes.CDLL, value: float) -> None:
    said = logic.speed_hundredths(value)
    assert abs(said) <= 9999
    assert abs(said - max(-9999.0, min(9999.0, value * 100))) <= 0.51


# control


def test_the_loop_settles_without_overshoot_and_forgets_a_jam(logic: ctypes.CDLL) -> None:
    pi = PiC()
    at = ctypes.addressof(pi)
    logic.pi_reset(at)
    speed, most = 0.0, 0.0
    for tick in range(400):
        duty = logic.pi_step(at, 20.0, speed, False)
        assert -1.0 <= duty <= 1.0
        rest = math.exp(-0.005 / 0.05)
        speed = duty * 50.0 + (speed - duty * 50.0) * rest
        most = max(most, speed)
        if tick == 199:
            assert speed == pytest.approx(20.0, rel=0.01)
    assert most < 20.0 * 1.03
    for _ in range(1000):  # jammed: as hard as it can, and no further
        duty = logic.pi_step(at, 20.0, 0.0, False)
    assert duty == 1.0
    assert pi.integral <= 1.0
    freed = [logic.pi_step(at, 20.0, 40.0, False) for _ in range(20)]
    assert freed[-1] < 0.0, "within 100 ms"


@given(st.lists(st.tuples(st.floats(-99, 99), st.floats(-99, 99), st.booleans()), max_size=50))
def test_whatever_comes_the_duty_is_a_duty(
    logic: ctypes.CDLL, steps: list[tuple[float, float, bool]]
) -> None:
    pi = PiC()
    at = ctypes.addressof(pi)
    logic.pi_reset(at)
    for target, speed, limited in steps:
        assert -1.0 <= logic.pi_step(at, target, speed, limited) <= 1.0
        assert -1.0 <= pi.integral <= 1.0


def test_at_rest_the_duty_leaks_away(logic: ctypes.CDLL) -> None:
    pi = PiC(0.8)
    at = ctypes.addressof(pi)
    duties = [logic.pi_step(at, 0.0, 0.0, False) for _ in range(100)]
    assert duties == sorted(duties, reverse=True)
    assert duties[-1] == 0.0


# bridge


@given(st.lists(st.one_of(st.integers(-TOP, TOP), st.none()), max_size=200))
def test_a_bridge_reverses_at_rest_rises_slowly_and_falls_at_once(
    logic: ctypes.CDLL, steps: list[int | None]
) -> None:
    """None = off, as by the watchdog."""
    bridge = BridgeC(0, 0, 0)
    at = ctypes.addressof(bridge)
    zero_for, driven = 99, 0
    for wanted in steps:
        before = (bridge.duty, bridge.direction)
        if wanted is None:
            logic.bridge_off(at)
            assert (bridge.duty, bridge.direction) == (0, 0)
        else:
            full = logic.bridge_step(at, wanted)
            assert full == (bridge.duty * bridge.direction == wanted), (wanted, bridge.duty)
        assert 0 <= bridge.duty <= TOP
        assert bridge.duty <= before[0] + TOP // 10
        if bridge.direction != before[1]:
            assert bridge.duty == 0
        if wanted is not None and abs(wanted) <= bridge.duty:
            assert abs(wanted) == bridge.duty
        if bridge.duty and driven and bridge.direction != driven:
            assert zero_for >= 2, "rest before the other direction"
        zero_for = zero_for + 1 if bridge.duty == 0 else 0
        driven = bridge.direction if bridge.duty else driven
