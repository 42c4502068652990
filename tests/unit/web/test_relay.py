"""Tests of the commands that a relay passes on, and of the last zero of a viewer that leaves."""

from __future__ import annotations

import pytest

from acsard.client.ride import MAX_SOURCE_TIMEOUT_S, STALE_S
from acsard.client.signing import CommandSigner
from acsard.core.messages.schema import Beat
from acsard.core.values import NS_PER_S, REST, Twist
from acsard.web.outbox import Relay, Wish

AHEAD, LEFT = Twist(0.5, 0.0), Twist(0.0, 1.0)
BEAT = Beat(7, 1000)
MS = NS_PER_S // 1000
STALE_NS = int(STALE_S * NS_PER_S)


class Panel:
    """A relay with a clock and a record of the twists it passed on."""

    def __init__(self) -> None:
        self.relay, self.now = Relay(), 10 * NS_PER_S
        self.gone: list[Twist] = []

    def wait(self, span_ns: int) -> None:
        """Send every command that waits, and let this time pass."""
        while self.relay.waits:
            wish = self.relay.send(self.now)
            if wish is not None:
                self.gone.append(wish.twist)
        self.now += span_ns

    def press(self, twist: Twist, times: int = 1, every_ns: int = 100 * MS) -> None:
        for _ in range(times):
            self.relay.take(Wish(twist), self.now)
            self.wait(every_ns)


@pytest.fixture
def panel() -> Panel:
    return Panel()


def test_each_wish_is_sent_once_and_no_command_without_a_wish(panel: Panel) -> None:
    panel.press(AHEAD, times=5)
    panel.wait(100 * NS_PER_S)
    assert panel.gone == [AHEAD] * 5
    assert panel.relay.send(panel.now) is None


def test_only_the_newest_of_several_waiting_wishes_is_sent(panel: Panel) -> None:
    panel.relay.take(Wish(AHEAD), panel.now)
    panel.relay.take(Wish(LEFT), panel.now)
    panel.wait(0)
    assert panel.gone == [LEFT]
    assert panel.relay.replaced == 1


def test_a_speed_that_waited_too_long_is_not_sent(panel: Panel) -> None:
    panel.relay.take(Wish(AHEAD), panel.now)
    assert panel.relay.send(panel.now + STALE_NS + 1) is None
    assert panel.relay.stale == 1
    assert not panel.relay.waits


def test_a_sender_that_leaves_while_driving_sends_one_zero(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.relay.take(Wish(AHEAD), panel.now)
    assert panel.relay.end(panel.now) == Wish(REST)
    assert panel.relay.end(panel.now) is None
    assert not panel.relay.waits


def test_a_sender_that_leaves_while_not_driving_sends_no_zero(panel: Panel) -> None:
    assert panel.relay.end(panel.now) is None
    panel.press(AHEAD, times=2)
    panel.press(REST)
    assert panel.relay.end(panel.now) is None
    panel.press(AHEAD, times=2)
    assert panel.relay.end(panel.now + int((MAX_SOURCE_TIMEOUT_S + 1.0) * NS_PER_S)) is None


def test_a_sender_that_leaves_after_its_timeout_stops_no_other_driver(panel: Panel) -> None:
    for late, zero in ((0.0, Wish(REST)), (0.2, Wish(REST)), (0.4, None)):
        panel.press(AHEAD, times=2)
        assert panel.relay.end(panel.now + int(late * NS_PER_S), 0.25) == zero


def test_a_sender_that_stopped_stamping_has_zeros_without_a_stamp(panel: Panel) -> None:
    panel.relay.take(Wish(AHEAD, 1000), panel.now)
    panel.relay.take(Wish(AHEAD), panel.now)
    panel.wait(0)
    assert panel.relay.end(panel.now) == Wish(REST)


def test_a_zero_is_never_too_old_to_be_sent(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.relay.take(Wish(REST), panel.now)
    assert panel.relay.send(panel.now + 100 * STALE_NS) == Wish(REST)


def test_commands_of_a_sender_with_its_own_zeros_and_stamps_are_passed_on_unchanged() -> None:
    relay = Relay()
    for n, wish in enumerate((Wish(AHEAD, 1), Wish(AHEAD, 2, BEAT), Wish(REST, 3))):
        relay.take(wish, n * NS_PER_S)
        assert relay.send(n * NS_PER_S) == wish
        assert not relay.waits


def test_the_last_zero_of_a_sender_has_a_stamp_of_its_clock_and_its_last_echo() -> None:
    relay = Relay()
    relay.take(Wish(AHEAD, 1000, BEAT), 0)
    relay.send(0)
    assert relay.end(7) == Wish(REST, 1007, BEAT)


def test_a_zero_has_a_stamp_not_older_than_the_commands_before_it() -> None:
    sender = CommandSigner("joe/aa")
    sender.sign(9, None)
    assert sender.sign(8, None).stamp == 8  # a late speed must look late
    assert sender.sign(8, None, zero=True).stamp == 9
    assert sender.sign(10, None, zero=True).stamp == 10


def test_the_commands_of_a_sender_are_numbered() -> None:
    sender = CommandSigner("joe/aa")
    signed = [sender.sign(9, BEAT) for _ in range(3)]
    assert [signature.sequence for signature in signed] == [1, 2, 3]
    assert {signature.sender for signature in signed} == {"joe/aa"}
