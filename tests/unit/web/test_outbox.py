"""The thread that sends commands drops old commands, and reports it if it fails."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event

import pytest

from acsard.client.ride import STALE_S
from acsard.core.values import NS_PER_S, REST, Twist
from acsard.host import clock
from acsard.web.outbox import Outbox, Relay, Wish
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


def suspend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an hour pass in which the monotonic clock stands still."""
    asleep_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: asleep_ns)


def test_only_the_newest_wish_is_sent_after_the_bus_was_blocked(bus: Bus) -> None:
    outbox, blocker, relay = Outbox(), Relay(), Relay()
    bus.block()
    outbox.take(blocker, bus.put, ZERO)
    assert bus.entered.wait(PATIENCE_S)
    for wish in (AHEAD, AHEAD, ZERO):
        outbox.take(relay, bus.put, wish)
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [ZERO, ZERO]
    assert relay.replaced == 2


def test_an_outdated_speed_is_dropped_but_a_zero_is_sent_at_any_age(bus: Bus) -> None:
    dropped: list[bool] = []
    outbox = Outbox(lambda: dropped.append(True))
    blocker, ahead, zero = Relay(), Relay(), Relay()
    bus.block()
    outbox.take(blocker, bus.put, ZERO)
    assert bus.entered.wait(PATIENCE_S)
    outbox.take(ahead, bus.put, AHEAD)
    outbox.take(zero, bus.put, ZERO)
    given_ns = clock.mono_ns()
    until(lambda: clock.mono_ns() - given_ns > STALE_S * NS_PER_S, PATIENCE_S, "that it is too old")
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [ZERO, ZERO]
    assert dropped == [True]


def test_a_speed_that_waited_during_a_suspend_is_dropped(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age of a command must include the suspend, in which the monotonic clock stands still."""
    dropped: list[bool] = []
    outbox, relay = Outbox(lambda: dropped.append(True)), Relay()
    with outbox._news:  # the thread cannot send the command before the suspend
        outbox.take(relay, bus.put, AHEAD)
        suspend(monkeypatch)
    outbox.flush(PATIENCE_S)
    assert bus.sent == []
    assert dropped == [True]


def test_no_zero_is_sent_for_a_drive_that_ended_before_a_suspend(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox, relay = Outbox(), Relay()
    outbox.take(relay, bus.put, AHEAD)
    outbox.flush(PATIENCE_S)
    suspend(monkeypatch)
    outbox.release(relay, 0.25)
    outbox.flush(PATIENCE_S)
    assert bus.sent == [AHEAD]


def test_the_zero_of_a_sender_that_leaves_while_the_bus_is_blocked_is_sent(bus: Bus) -> None:
    outbox, relay = Outbox(), Relay()
    bus.block()
    outbox.take(relay, bus.put, AHEAD)
    assert bus.entered.wait(PATIENCE_S)
    outbox.take(relay, bus.put, LEFT)
    outbox.release(relay)
    bus.free.set()
    outbox.flush(PATIENCE_S)
    assert bus.sent == [AHEAD, ZERO]


def test_the_death_of_the_sending_thread_is_reported() -> None:
    def deadly(wish: Wish) -> None:
        raise SystemExit

    outbox = Outbox()
    outbox.take(Relay(), deadly, AHEAD)
    assert isinstance(outbox.dead.exception(PATIENCE_S), SystemExit)
