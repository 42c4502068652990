"""A subscription returns the samples of its key in order, and ends if none comes for a while."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from acsard.bus.subscription import MAX_QUEUED_SAMPLES, Subscription, queue_on

KEY, WILDCARD = "acsard/acsar/state", "acsard/**"


class Queue:
    """A stand-in for Zenoh's queue."""

    def __init__(self, *keys: str) -> None:
        self.held = deque(SimpleNamespace(key_expr=key, number=n) for n, key in enumerate(keys))
        self.open = True

    def try_recv(self) -> Any:
        return self.held.popleft() if self.held else None

    def wait(self, seconds: float | None) -> None:
        """Return at once, because the test sends no further sample."""

    def undeclare(self) -> None:
        self.open = False


def numbers(subscription: Subscription) -> list[int]:
    samples: Any = subscription.until_silence(0.01)
    return [sample.number for sample in samples]


def test_a_subscription_yields_the_samples_of_its_key_or_all() -> None:
    # A sample that was put on a wildcard does not count for the key.
    assert numbers(Subscription(Queue(KEY, WILDCARD, WILDCARD, KEY), KEY)) == [0, 3]
    assert numbers(Subscription(Queue(KEY, WILDCARD, KEY))) == [0, 1, 2]


def test_a_flood_on_other_keys_does_not_hold_the_caller() -> None:
    queue = Queue(*[WILDCARD] * (MAX_QUEUED_SAMPLES + 1), KEY)
    subscription = Subscription(queue, KEY)
    assert subscription.try_recv() is None
    assert len(queue.held) == 2
    assert subscription.try_recv() is not None


def test_a_subscription_is_undeclared_after_a_silence_and_when_its_reader_leaves() -> None:
    silent, left = Queue(), Queue(KEY, KEY)
    assert numbers(Subscription(silent)) == []
    reader: Any = Subscription(left).until_silence(None)
    next(reader)
    reader.close()
    assert (silent.open, left.open) == (False, False)


class Closed(Queue):
    """A queue whose session has been closed while the queue was still in use."""

    def try_recv(self) -> Any:
        if not self.held:
            raise zenoh.ZError("receiving on a closed channel")
        return super().try_recv()

    def undeclare(self) -> None:
        raise zenoh.ZError("already undeclared")


def test_a_subscription_ends_without_an_error_when_its_session_is_closed() -> None:
    assert numbers(Subscription(Closed(KEY, KEY))) == [0, 1]
    Subscription(Closed()).undeclare()


# samples that Zenoh's thread hands over


class Session:
    """A session whose subscriptions receive their samples from the test."""

    def __init__(self) -> None:
        self.handlers: list[Any] = []

    def declare_subscriber(self, key: str, handler: Any) -> Queue:
        self.handlers.append(handler)
        return Queue()


def declared() -> tuple[Any, Subscription]:
    session: Any = Session()
    queue = queue_on(session, KEY, latched=False)
    return session.handlers[0], Subscription(queue)


def sample(number: int) -> Any:
    return SimpleNamespace(key_expr=KEY, number=number)


def test_a_reader_sleeps_until_a_sample_arrives_and_ends_when_the_session_is_closed() -> None:
    handler, subscription = declared()
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
    handler, subscription = declared()
    for number in range(2):
        handler.callback(sample(number))
    asyncio.get_running_loop().call_later(0.05, handler.callback, sample(2))
    asyncio.get_running_loop().call_later(0.06, handler.drop)
    arrived = [item.number async for item in subscription.arriving()]  # type: ignore[attr-defined]
    assert arrived == [0, 1, 2]


def test_the_newest_samples_of_a_flood_are_kept() -> None:
    handler, subscription = declared()
    for number in range(MAX_QUEUED_SAMPLES + 5):
        handler.callback(sample(number))
    handler.drop()
    assert numbers(subscription) == list(range(5, MAX_QUEUED_SAMPLES + 5))
