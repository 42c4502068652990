"""Reports that a fault repeats are bounded, and each loses its turn to none."""

from __future__ import annotations

import tracemalloc

from acsard.core.values import NS_PER_S
from acsard.host.rate_limits import Bucket, Buckets, Places, Rate

SLOW = Rate(10 / 60, 10.0)


def test_a_bucket_permits_an_initial_burst_and_then_its_rate() -> None:
    bucket = Bucket(Rate(10.0, 20.0))
    assert [bucket.take(0) for _ in range(21)] == [True] * 20 + [False]
    count = sum(bucket.take(n * NS_PER_S // 1000) for n in range(10_000))
    assert 99 <= count <= 100  # within ten seconds


def test_a_bucket_holds_at_most_its_burst_size_after_a_long_pause() -> None:
    bucket = Bucket(Rate(10.0, 20.0))
    assert sum(bucket.take(3600 * NS_PER_S) for _ in range(100)) == 20


def test_each_name_has_a_bucket_of_its_own() -> None:
    buckets = Buckets(SLOW)
    assert [buckets.take("a", 0) for _ in range(11)] == [True] * 10 + [False]
    assert buckets.take("b", 0)
    assert all(buckets.take("a", 61 * NS_PER_S) for _ in range(10))


def test_inactive_names_are_removed_to_bound_the_memory() -> None:
    buckets = Buckets(SLOW)
    tracemalloc.start()
    try:
        for n in range(10_000):
            buckets.take(f"address {n}", n * NS_PER_S // 10)
        size, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert size < 200_000  # bytes; all names together take 2.3 MB


def test_places_are_limited_per_address_and_in_total() -> None:
    places = Places(3, 2)
    assert [places.enter("a") for _ in range(3)] == [True, True, False]
    assert [places.enter("b"), places.enter("c")] == [True, False]
    places.leave("a")
    assert places.enter("c")
    assert places.taken == 3


def test_a_bucket_for_one_unit_sets_a_shortest_interval_to_the_nanosecond() -> None:
    bucket, minute_ns = Bucket(Rate(1 / 60)), 60 * NS_PER_S
    times = [0, 1, minute_ns - 1, minute_ns, minute_ns + 1, 3 * minute_ns, 4 * minute_ns - 1]
    assert [bucket.take(at_ns) for at_ns in times] == [True, False, False, True, False, True, False]


def test_a_refused_request_takes_nothing_from_the_bucket() -> None:
    bucket = Bucket(Rate(10.0, 2.0))
    for _ in range(100):
        bucket.take(0)
    assert bucket.take(NS_PER_S // 10)


def test_a_bucket_is_full_again_after_its_refill_time() -> None:
    bucket = Bucket(Rate(10.0, 3.0))
    assert bucket.full(0)
    for _ in range(3):
        bucket.take(0)
    assert not bucket.room(NS_PER_S // 10 - 1)
    assert bucket.room(NS_PER_S // 10)
    assert not bucket.full(3 * NS_PER_S // 10 - 1)
    assert bucket.full(3 * NS_PER_S // 10)
