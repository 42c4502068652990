"""Reports that a fault repeats are bounded, and each loses its turn to none."""

from __future__ import annotations

import tracemalloc

from acsard.core.throttle import Rate, Throttle
from acsard.core.values import NS_PER_S
from acsard.web.connections import Places


def test_a_throttle_permits_a_burst_and_then_its_rate_to_the_nanosecond() -> None:
    throttle, rate = Throttle(), Rate(10.0, 20.0)
    assert [throttle.take(0, rate) for _ in range(100)] == [True] * 20 + [False] * 80
    # A refused request takes nothing.
    assert [throttle.take(NS_PER_S // 10 - late, rate) for late in (1, 0)] == [False, True]
    count = sum(throttle.take(n * NS_PER_S // 1000, rate) for n in range(10_000))
    assert 98 <= count <= 99  # within ten seconds
    assert sum(throttle.take(3600 * NS_PER_S, rate) for _ in range(100)) == 20
    one, minute, minute_ns = Throttle(), Rate(1 / 60), 60 * NS_PER_S
    times = [0, 1, minute_ns - 1, minute_ns, minute_ns + 1, 3 * minute_ns, 4 * minute_ns - 1]
    taken = [one.take(at_ns, minute) for at_ns in times]
    assert taken == [True, False, False, True, False, True, False]


def test_each_name_has_a_rate_of_its_own_and_inactive_names_take_no_memory() -> None:
    throttle, rate = Throttle(), Rate(10 / 60, 10.0)
    assert [throttle.take(0, rate, "a") for _ in range(11)] == [True] * 10 + [False]
    assert throttle.take(0, rate, "b")
    assert all(throttle.take(61 * NS_PER_S, rate, "a") for _ in range(10))
    tracemalloc.start()
    try:
        for n in range(3_000):
            throttle.take(n * NS_PER_S // 10, rate, f"address {n}")
        size, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert size < 200_000  # bytes; all names together take 0.7 MB


def test_places_are_limited_per_address_and_in_total() -> None:
    places = Places(3, 2)
    assert [places.enter("a") for _ in range(3)] == [True, True, False]
    assert [places.enter("b"), places.enter("c")] == [True, False]
    places.leave("a")
    assert places.enter("c")
    assert places.taken == 3
