"""Reports that a fault repeats are bounded, and each loses its turn to none."""

from __future__ import annotations

import tracemalloc

from acsard.core.values import NS_PER_S
from acsard.host.rate_limits import Bucket, Buckets, Places, Rate


def test_a_bucket_permits_a_burst_and_then_its_rate_to_the_nanosecond() -> None:
    bucket = Bucket(Rate(10.0, 20.0))
    assert bucket.full(0)
    assert [bucket.take(0) for _ in range(100)] == [True] * 20 + [False] * 80
    # A refused request takes nothing.
    assert [bucket.room(NS_PER_S // 10 - late) for late in (1, 0)] == [False, True]
    count = sum(bucket.take(n * NS_PER_S // 1000) for n in range(10_000))
    assert 99 <= count <= 100  # within ten seconds
    assert sum(bucket.take(3600 * NS_PER_S) for _ in range(100)) == 20
    assert [bucket.full(3602 * NS_PER_S - early) for early in (1, 0)] == [False, True]
    one, minute_ns = Bucket(Rate(1 / 60)), 60 * NS_PER_S
    times = [0, 1, minute_ns - 1, minute_ns, minute_ns + 1, 3 * minute_ns, 4 * minute_ns - 1]
    assert [one.take(at_ns) for at_ns in times] == [True, False, False, True, False, True, False]


def test_each_name_has_a_bucket_of_its_own_and_inactive_names_take_no_memory() -> None:
    buckets = Buckets(Rate(10 / 60, 10.0))
    assert [buckets.take("a", 0) for _ in range(11)] == [True] * 10 + [False]
    assert buckets.take("b", 0)
    assert all(buckets.take("a", 61 * NS_PER_S) for _ in range(10))
    tracemalloc.start()
    try:
        for n in range(3_000):
            buckets.take(f"address {n}", n * NS_PER_S // 10)
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
