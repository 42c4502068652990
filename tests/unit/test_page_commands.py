"""The page's server sends each command of a viewer once, never an old speed, and a last zero."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event
from typing import Any, cast

import pytest

from acsard.client.ride import STALE_S
from acsard.client.signing import CommandSigner
from acsard.core.messages.schema import Beat
from acsard.core.messages.signature import unpack
from acsard.core.values import NS_PER_S, REST, Twist
from acsard.host import clock
from acsard.web.metrics import Counts
from acsard.web.outbox import Outbox, Relay, Wish
from tests.each import each

PATIENCE_S = 20.0

AHEAD, LEFT = Wish(Twist(0.5, 0.0)), Wish(Twist(0.0, 1.0))
ZERO = Wish(REST)

BEAT = Beat(7, 1000)
NOW_NS = 10 * NS_PER_S
STALE_NS = int(STALE_S * NS_PER_S)


def new_relay() -> Relay:
    return Relay("teleop", CommandSigner("joe/aa"))


@pytest.fixture
def relay() -> Relay:
    return new_relay()


# One relay.


@each(
    ("wish", "late_ns", "sent"),
    [(AHEAD, STALE_NS, AHEAD), (AHEAD, STALE_NS + 1, None), (ZERO, 100 * STALE_NS, ZERO)],
)
def test_a_speed_that_waited_too_long_is_not_sent(
    relay: Relay, wish: Wish, late_ns: int, sent: Wish | None
) -> None:
    relay.take(wish, NOW_NS)
    assert relay.send(NOW_NS + late_ns) == sent


@each(
    ("wishes", "late_s", "zero"),
    [
        ([], 0.0, None),
        ([AHEAD], 0.0, ZERO),
        ([AHEAD], 0.34, ZERO),  # the source's timeout of 0.25 s, and 0.1 s on the way
        ([AHEAD], 0.36, None),  # another sender may drive by now
        ([AHEAD, ZERO], 0.0, None),
        ([Wish(AHEAD.twist, 1000, BEAT)], 7e-9, Wish(REST, 1007, BEAT)),  # by the sender's clock
        ([Wish(AHEAD.twist, 1000), AHEAD], 0.0, ZERO),  # it stopped stamping
    ],
)
def test_a_sender_that_leaves_while_driving_sends_one_zero(
    relay: Relay, wishes: list[Wish], late_s: float, zero: Wish | None
) -> None:
    for wish in wishes:
        relay.take(wish, NOW_NS)
        relay.send(NOW_NS)
    assert relay.end(NOW_NS + round(late_s * NS_PER_S), 0.25) == zero
    assert relay.end(NOW_NS + round(late_s * NS_PER_S), 0.25) is None


def test_a_zero_has_a_stamp_not_older_than_the_commands_before_it() -> None:
    signer = CommandSigner("joe/aa")
    signer.sign(9, None)
    assert signer.sign(8, None).stamp == 8  # a late speed must look late
    assert signer.sign(8, None, zero=True).stamp == 10
    assert signer.sign(20, None, zero=True).stamp == 20


# The thread of all relays.


class Bus:
    """A bus that records commands and can be blocked, and the outbox that sends to it."""

    def __init__(self) -> None:
        self.sent, self.signed = list[Twist](), list[tuple[str, Any]]()
        self.entered, self.free = Event(), Event()
        self.free.set()
        self.counts = Counts()
        self.outbox = Outbox(lambda: cast(Any, self), self.counts)

    def put(self, twist: Any, signature: Any, source: str) -> None:
        self.entered.set()
        assert self.free.wait(PATIENCE_S)
        self.sent.append(Twist(twist.linear.x, twist.angular.z))
        self.signed.append((source, unpack(signature.pack())))

    def block(self) -> None:
        """Block the bus, and wait until the outbox is in it with a zero of another sender."""
        self.free.clear()
        self.entered.clear()
        self.outbox.take(new_relay(), ZERO)
        assert self.entered.wait(PATIENCE_S)

    def unblock(self) -> list[Twist]:
        """Return all commands that were sent, without that zero."""
        self.free.set()
        self.outbox.flush(PATIENCE_S)
        return self.sent[1:]


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.free.set()


def suspend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an hour pass in which the monotonic clock stands still."""
    asleep_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: asleep_ns)


def test_a_command_has_its_sender_s_stamp_clock_and_echo(bus: Bus, relay: Relay) -> None:
    for stamp_ns, echo in ((1000, Beat(7, 5)), (2000, None)):
        bus.outbox.take(relay, Wish(Twist(0.2, -0.5), stamp_ns, echo))
        bus.outbox.flush(PATIENCE_S)
    assert bus.sent == [Twist(0.2, -0.5)] * 2
    assert {source for source, _ in bus.signed} == {"teleop"}
    signed = [signature for _, signature in bus.signed]
    assert [(item.stamp, item.sequence) for item in signed] == [(1000, 1), (2000, 2)]
    assert [item.echo for item in signed] == [Beat(7, 5), None]  # the server adds none
    assert {item.sender for item in signed} == {"joe/aa"}
    assert bus.counts.all() == {"commands": 2}


def test_only_each_sender_s_newest_command_is_sent_after_a_blocked_bus(
    bus: Bus, relay: Relay
) -> None:
    bus.block()
    for wish in (AHEAD, AHEAD, ZERO):
        bus.outbox.take(relay, wish)
    bus.outbox.take(new_relay(), LEFT)
    assert bus.unblock() == [REST, LEFT.twist]
    assert bus.counts.all() == {"commands": 3, "commands_superseded": 2}


def test_a_speed_that_waited_during_a_suspend_is_dropped(
    bus: Bus, relay: Relay, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus.block()
    bus.outbox.take(relay, AHEAD)
    suspend(monkeypatch)
    assert bus.unblock() == []
    assert bus.counts.all()["commands_dropped"] == 1


def test_the_zero_of_a_sender_that_leaves_a_blocked_bus_is_sent(bus: Bus, relay: Relay) -> None:
    bus.free.clear()
    bus.outbox.take(relay, AHEAD)
    assert bus.entered.wait(PATIENCE_S)
    bus.outbox.take(relay, LEFT)
    bus.outbox.release(relay)
    bus.free.set()
    bus.outbox.flush(PATIENCE_S)
    assert bus.sent == [AHEAD.twist, REST]


def test_a_command_that_cannot_be_sent_is_dropped_and_the_next_is_processed() -> None:
    def broken() -> Any:
        raise OverflowError("no room in 64 bits")

    counts, relays = Counts(), [new_relay(), new_relay()]
    outbox = Outbox(broken, counts)
    for relay in (*relays, relays[0]):
        outbox.take(relay, AHEAD)
        outbox.flush(PATIENCE_S)
    assert counts.all() == {"commands_dropped": 3}
    assert not outbox.dead.done()


def test_the_death_of_the_sending_thread_is_reported() -> None:
    def deadly() -> Any:
        raise SystemExit

    outbox = Outbox(deadly, Counts())
    outbox.take(new_relay(), AHEAD)
    assert isinstance(outbox.dead.exception(PATIENCE_S), SystemExit)
