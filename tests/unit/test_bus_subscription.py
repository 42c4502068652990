"""A subscription returns the samples of its key in order, and ends if none comes for a while."""

from __future__ import annotations

import asyncio
import threading
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from acsard.bus.subscription import MAX_QUEUED_SAMPLES, Subscription

KEY, WILDCARD = "acsard/acsar/state", "acsard/**"


class Session:
    """A session whose subscriptions receive their samples from the test."""

    def __init__(self, *, closed: bool = False) -> None:
        self.handlers, self.undeclared, self._closed = list[Any](), 0, closed

    def declare_subscriber(self, key: str, handler: Any) -> Any:
        self.handlers.append(handler)
        return SimpleNamespace(undeclare=self._undeclare)

    def _undeclare(self) -> None:
        if self._closed:
            raise zenoh.ZError("already undeclared")
        self.undeclared += 1


def sample(number: int, key: str = KEY) -> Any:
    return SimpleNamespace(key_expr=key, number=number)


def declared(*keys: str, exact: bool = True, closed: bool = False) -> tuple[Any, Subscription, Any]:
    """Return the handler of a subscription to `KEY`, which has samples of these keys."""
    session: Any = Session(closed=closed)
    subscription = Subscription(session, KEY, exact=exact)
    (handler,) = session.handlers
    for number, key in enumerate(keys):
        handler.callback(sample(number, key))
    if closed:
        handler.drop()
    return handler, subscription, session


def numbers(subscription: Subscription) -> list[int]:
    samples: Any = subscription.until_silence(0.01)
    return [sample.number for sample in samples]


def test_a_subscription_yields_the_samples_of_its_key_or_all() -> None:
    # A sample that was put on a wildcard does not count for the key.
    keys = (KEY, WILDCARD, WILDCARD, KEY)
    assert numbers(declared(*keys)[1]) == [0, 3]
    assert numbers(declared(*keys, exact=False)[1]) == [0, 1, 2, 3]


def test_a_subscription_is_undeclared_after_a_silence_and_when_its_reader_leaves() -> None:
    _, silent, session = declared()
    assert numbers(silent) == []
    assert session.undeclared == 1
    _, left, session = declared(KEY, KEY)
    reader: Any = left.until_silence(None)
    next(reader)
    reader.close()
    assert session.undeclared == 1


def test_a_subscription_ends_without_an_error_when_its_session_is_closed() -> None:
    assert numbers(declared(KEY, KEY, closed=True)[1]) == [0, 1]


# samples that Zenoh's thread hands over


def test_a_reader_sleeps_until_a_sample_arrives_and_ends_when_the_session_is_closed() -> None:
    handler, subscription, _ = declared()
    asleep: Any = subscription.until_silence(None)

    def other() -> None:
        for number in range(3):
            handler.callback(sample(number))
        handler.drop()

    looks = 0
    look = subscription.try_recv

    def counted() -> Any:
        nonlocal looks
        looks += 1
        if looks == 1:
            # The first look finds the queue empty. The waiter looks again only when a sample
            # arrives.
            threading.Timer(0.2, other).start()
        return look()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subscription, "try_recv", counted)
        assert [item.number for item in asleep] == [0, 1, 2]
    assert looks <= 1 + 2 * 4  # a poll every millisecond would look 200 times


async def test_a_sample_or_the_end_wakes_an_asyncio_reader() -> None:
    handler, subscription, _ = declared()
    for number in range(2):
        handler.callback(sample(number))
    asyncio.get_running_loop().call_later(0.05, handler.callback, sample(2))
    asyncio.get_running_loop().call_later(0.06, handler.drop)
    arrived = [item.number async for item in subscription.arriving()]  # type: ignore[attr-defined]
    assert arrived == [0, 1, 2]


def test_the_newest_samples_of_a_flood_are_kept() -> None:
    handler, subscription, _ = declared()
    for number in range(MAX_QUEUED_SAMPLES + 5):
        handler.callback(sample(number))
    handler.drop()
    assert numbers(subscription) == list(range(5, MAX_QUEUED_SAMPLES + 5))
