"""The thread that sends commands drops old commands, and reports it if it fails."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event

import pytest

from acsard.client.commander import STALE_NS, Commander, Wish
from acsard.client.outbox import Outbox
from acsard.core.values import NS_PER_S, REST, Twist
from acsard.host import clock
from tests.system.harness import until

PATIENCE_S = 20.0

AHEAD, LEFT = Wish(Twist(0.5, 0.0)), Wish(Twist(0.0, 1.0))
ZERO = Wish(REST)


class Bus:
    """A bus that records commands and can be blocked."""

    def __init__(self) -> None:
        self.sent: list[Wish] = []
        self.entered, self.free = Event(), Event()
        self.free.set()

    def put(self, wish: Wish) -> None:
        self.entered.set()
        assert self.free.wait(PATIENCE_S)
        self.sent.append(wish)

    def block(self) -> None:
        self.free.clear()
        self.entered.clear()


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.free.set()


def test_only_the_newest_wish_is_sent_after_the_bus_was_blocked(bus: Bus) -> None:
    outbox, blocker, commander = Outbox(), Commander(), Commander()
    bus.block()
    outbox.take(blocker, bus.put, ZERO)
    assert bus.entered.wait(PATIENCE_S)
    for wish in (AHEAD, AHEAD, ZERO):
        outbox.take(commander, bus.put, wish)
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [ZERO, ZERO]
    assert commander.replaced == 2


def test_an_outdated_speed_is_dropped_but_a_zero_is_sent_at_any_age(bus: Bus) -> None:
    dropped: list[bool] = []
    outbox = Outbox(lambda: dropped.append(True))
    blocker, ahead, zero = Commander(), Commander(), Commander()
    bus.block()
    outbox.take(blocker, bus.put, ZERO)
    assert bus.entered.wait(PATIENCE_S)
    outbox.take(ahead, bus.put, AHEAD)
    outbox.take(zero, bus.put, ZERO)
    given_ns = clock.mono_ns()
    until(lambda: clock.mono_ns() - given_ns > STALE_NS, PATIENCE_S, "that it is too old")
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [ZERO, ZERO]
    assert dropped == [True]


def test_a_speed_that_waited_during_a_suspend_is_dropped(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age of a command must include the suspend, in which the monotonic clock stands still."""
    asleep_ns = 0
    monkeypatch.setattr(clock, "asleep_ns", lambda: asleep_ns)
    dropped: list[bool] = []
    outbox, commander = Outbox(lambda: dropped.append(True)), Commander()
    with outbox._news:  # the thread cannot send the command before the suspend
        outbox.take(commander, bus.put, AHEAD)
        asleep_ns = 3600 * NS_PER_S
    outbox.flush(PATIENCE_S)
    assert bus.sent == []
    assert dropped == [True]


def test_no_zero_is_sent_for_a_drive_that_ended_before_a_suspend(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    asleep_ns = 0
    monkeypatch.setattr(clock, "asleep_ns", lambda: asleep_ns)
    outbox, commander = Outbox(), Commander()
    outbox.take(commander, bus.put, AHEAD)
    outbox.flush(PATIENCE_S)
    asleep_ns = 3600 * NS_PER_S
    outbox.release(commander, 0.25)
    outbox.flush(PATIENCE_S)
    assert bus.sent == [AHEAD]


def test_the_zero_of_a_sender_that_leaves_while_the_bus_is_blocked_is_sent(bus: Bus) -> None:
    outbox, commander = Outbox(), Commander()
    bus.block()
    outbox.take(commander, bus.put, AHEAD)
    assert bus.entered.wait(PATIENCE_S)
    outbox.take(commander, bus.put, LEFT)
    outbox.release(commander)
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [AHEAD, ZERO]


def test_the_death_of_the_sending_thread_is_reported() -> None:
    def deadly(wish: Wish) -> None:
        raise SystemExit

    outbox = Outbox()
    outbox.take(Commander(), deadly, AHEAD)
    assert isinstance(outbox.dead.exception(PATIENCE_S), SystemExit)
