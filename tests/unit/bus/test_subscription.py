"""A subscription gives what came on its key, in order, and is done after a silence."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import zenoh

from acsard.bus.subscription import QUEUED, Subscription

KEY, WILDCARD = "acsard/acsar/state", "acsard/**"


class Queue:
    """Zenoh's, without Zenoh."""

    def __init__(self, *keys: str) -> None:
        self.held = deque(SimpleNamespace(key_expr=key, number=n) for n, key in enumerate(keys))
        self.open = True

    def try_recv(self) -> Any:
        return self.held.popleft() if self.held else None

    def undeclare(self) -> None:
        self.open = False


def numbers(subscription: Subscription) -> list[int]:
    found: Any = subscription.until_silence(0.01)
    return [sample.number for sample in found]


def test_what_a_stranger_put_on_a_wildcard_is_not_of_the_key() -> None:
    assert numbers(Subscription(Queue(KEY, WILDCARD, WILDCARD, KEY), KEY)) == [0, 3]


def test_without_a_key_it_is_all_there_is() -> None:
    assert numbers(Subscription(Queue(KEY, WILDCARD, KEY))) == [0, 1, 2]


def test_a_flood_of_strangers_does_not_hold_the_caller() -> None:
    queue = Queue(*[WILDCARD] * (QUEUED + 1), KEY)
    subscription = Subscription(queue, KEY)
    assert subscription.try_recv() is None
    assert len(queue.held) == 2
    assert subscription.try_recv() is not None


def test_it_is_undeclared_after_a_silence_and_when_its_reader_leaves() -> None:
    silent, left = Queue(), Queue(KEY, KEY)
    assert numbers(Subscription(silent)) == []
    reader: Any = Subscription(left).until_silence(None)
    next(reader)
    reader.close()
    assert (silent.open, left.open) == (False, False)


class Closed(Queue):
    """Of a session that has been closed behind it."""

    def try_recv(self) -> Any:
        if not self.held:
            raise zenoh.ZError("receiving on a closed channel")
        return super().try_recv()

    def undeclare(self) -> None:
        raise zenoh.ZError("already undeclared")


def test_it_ends_when_its_session_is_closed() -> None:
    assert numbers(Subscription(Closed(KEY, KEY))) == [0, 1]


def test_a_closed_one_is_undeclared_without_a_word() -> None:
    Subscription(Closed()).undeclare()
