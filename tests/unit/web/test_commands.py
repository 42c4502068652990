"""The thread that sends commands drops those it cannot send, and never dies unnoticed."""

from __future__ import annotations

from acsard.client import Client
from acsard.host import clock
from acsard.web.commands import Hand, Order
from acsard.web.counts import Counts

PATIENCE_S = 20.0


def order(sender: str) -> Order:
    return Order(sender, 0.2, 0.0, 1, 1, clock.mono_ns())


def test_what_cannot_be_sent_is_dropped_and_the_next_one_is_looked_at() -> None:
    def broken() -> Client | None:
        raise OverflowError("no room in 64 bits")

    counts = Counts()
    hand = Hand(broken, counts)
    for sender in ("a", "b", "a"):
        hand.give(order(sender))
        hand.flush(PATIENCE_S)
    assert counts.all() == {"commands_dropped": 3}
    assert not hand.dead.done()


def test_a_hand_that_dies_says_so() -> None:
    def deadly() -> Client | None:
        raise SystemExit

    hand = Hand(deadly, Counts())
    hand.give(order("a"))
    assert isinstance(hand.dead.exception(PATIENCE_S), SystemExit)
