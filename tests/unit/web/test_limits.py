"""What is too much is refused, and time or a leaving makes room again."""

from __future__ import annotations

from acsard.values import NS_PER_S
from acsard.web.limits import TRIES, TRIES_OF_ONE, Bucket, Places, Tries


def test_a_bucket_lets_its_rate_through_and_some_at_once() -> None:
    bucket = Bucket(10.0, 20.0, 0)
    assert [bucket.take(0) for _ in range(21)] == [True] * 20 + [False]
    taken = sum(bucket.take(n * NS_PER_S // 1000) for n in range(10_000))
    assert 99 <= taken <= 100  # ten seconds


def test_a_bucket_holds_no_more_than_its_most_after_a_long_rest() -> None:
    bucket = Bucket(10.0, 20.0, 0)
    assert sum(bucket.take(3600 * NS_PER_S) for _ in range(100)) == 20


def test_wrong_tokens_are_enough_after_some_and_a_minute_forgets_them() -> None:
    tries = Tries()
    for _ in range(TRIES_OF_ONE):
        assert not tries.spent("a", 0)
        tries.failed("a", 0)
    assert tries.spent("a", 0)
    assert not tries.spent("b", 0)
    assert not tries.spent("a", 61 * NS_PER_S)


def test_many_addresses_together_are_held_too() -> None:
    tries = Tries()
    for n in range(TRIES):
        tries.failed(f"10.0.0.{n}", 0)
    assert tries.spent("never seen", 0)


def test_places_are_bounded_by_address_and_in_all() -> None:
    places = Places(3, 2)
    assert [places.enter("a") for _ in range(3)] == [True, True, False]
    assert [places.enter("b"), places.enter("c")] == [True, False]
    places.leave("a")
    assert places.enter("c")
    assert places.taken == 3
