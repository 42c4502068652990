"""Tests of the commands that a commander sends, of their timing, and of the last zero."""

from __future__ import annotations

import pytest

from acsard.client.commander import (
    MAX_SOURCE_TIMEOUT_S,
    RELEASE_TIMEOUT_NS,
    STALE_NS,
    Commander,
    CommandSigner,
    Wish,
)
from acsard.core.messages.schema import Beat
from acsard.core.values import NS_PER_S, REST, Twist

AHEAD, LEFT = Twist(0.5, 0.0), Twist(0.0, 1.0)
BEAT = Beat(7, 1000)
MS = NS_PER_S // 1000


class Panel:
    """A commander with a clock and a record of the twists it sent."""

    def __init__(self) -> None:
        self.commander, self.now = Commander(sends_leading_zero=True), 10 * NS_PER_S
        self.gone: list[Twist] = []

    def wait(self, span_ns: int) -> None:
        """Send every command that waits, and let this time pass."""
        while self.commander.waits:
            wish = self.commander.send(self.now)
            if wish is not None:
                self.gone.append(wish.twist)
        self.now += span_ns

    def press(self, twist: Twist, times: int = 1, every_ns: int = 100 * MS) -> None:
        for _ in range(times):
            self.commander.take(Wish(twist), self.now)
            self.wait(every_ns)


@pytest.fixture
def panel() -> Panel:
    return Panel()


def test_each_wish_is_sent_once_after_one_zero(panel: Panel) -> None:
    panel.press(AHEAD, times=5)
    assert panel.gone == [REST, *[AHEAD] * 5]


def test_no_command_is_sent_without_a_new_wish(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    before = len(panel.gone)
    panel.wait(100 * NS_PER_S)
    assert len(panel.gone) == before
    assert not panel.commander.waits


def test_the_first_command_after_a_release_is_preceded_by_a_zero(panel: Panel) -> None:
    panel.press(AHEAD)
    panel.wait(RELEASE_TIMEOUT_NS)
    panel.press(LEFT)
    assert panel.gone == [REST, AHEAD, REST, LEFT]


@pytest.mark.parametrize("every_ns", [350 * MS, NS_PER_S, 1400 * MS])
def test_no_zero_is_added_to_the_commands_of_a_held_button_that_come_with_pauses(
    panel: Panel, every_ns: int
) -> None:
    panel.press(AHEAD, times=4, every_ns=every_ns)
    assert panel.gone == [REST, *[AHEAD] * 4]


def test_only_the_newest_of_several_waiting_wishes_is_sent(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.commander.take(Wish(AHEAD), panel.now)
    panel.commander.take(Wish(LEFT), panel.now)
    panel.wait(0)
    assert panel.gone == [REST, AHEAD, AHEAD, LEFT]
    assert panel.commander.replaced == 1


def test_a_speed_that_waited_too_long_is_not_sent(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.commander.take(Wish(AHEAD), panel.now)
    assert panel.commander.send(panel.now + STALE_NS + 1) is None
    assert panel.commander.stale == 1
    assert not panel.commander.waits


def test_a_sender_that_leaves_while_driving_sends_one_zero(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.commander.take(Wish(AHEAD), panel.now)
    assert panel.commander.end(panel.now) == Wish(REST)
    assert panel.commander.end(panel.now) is None
    assert not panel.commander.waits


def test_a_sender_that_leaves_while_not_driving_sends_no_zero(panel: Panel) -> None:
    assert panel.commander.end(panel.now) is None
    panel.press(AHEAD, times=2)
    panel.press(REST)
    assert panel.commander.end(panel.now) is None
    panel.press(AHEAD, times=2)
    assert panel.commander.end(panel.now + int((MAX_SOURCE_TIMEOUT_S + 1.0) * NS_PER_S)) is None


def test_a_sender_that_leaves_after_its_timeout_stops_no_other_driver(panel: Panel) -> None:
    for late, zero in ((0.0, Wish(REST)), (0.2, Wish(REST)), (0.4, None)):
        panel.press(AHEAD, times=2)
        assert panel.commander.end(panel.now + int(late * NS_PER_S), 0.25) == zero


def test_a_wish_keeps_its_stamp_and_the_zero_before_it_is_stamped_earlier() -> None:
    commander = Commander(sends_leading_zero=True)
    commander.take(Wish(AHEAD, 1000), NS_PER_S)
    assert commander.send(NS_PER_S + 3) == Wish(REST, 999)
    assert commander.send(NS_PER_S + 3) == Wish(AHEAD, 1000)
    commander.take(Wish(LEFT, 2000), NS_PER_S + 1000)
    assert commander.send(NS_PER_S + 1000) == Wish(LEFT, 2000)
    assert commander.end(NS_PER_S + 1005) == Wish(REST, 2005)


def test_a_sender_that_stopped_stamping_has_zeros_without_a_stamp(panel: Panel) -> None:
    panel.commander.take(Wish(AHEAD, 1000), panel.now)
    panel.commander.take(Wish(AHEAD), panel.now)
    assert panel.commander.send(panel.now) == Wish(REST)


def test_a_zero_is_never_too_old_to_be_sent(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.commander.take(Wish(REST), panel.now)
    assert panel.commander.send(panel.now + 100 * STALE_NS) == Wish(REST)


def test_commands_of_a_sender_with_its_own_zeros_and_stamps_are_passed_on_unchanged() -> None:
    commander = Commander()
    for n, wish in enumerate((Wish(AHEAD, 1), Wish(AHEAD, 2, BEAT), Wish(REST, 3))):
        commander.take(wish, n * NS_PER_S)
        assert commander.send(n * NS_PER_S) == wish
        assert not commander.waits


def test_the_last_zero_of_a_sender_has_a_stamp_of_its_clock_and_its_last_echo() -> None:
    commander = Commander()
    commander.take(Wish(AHEAD, 1000, BEAT), 0)
    commander.send(0)
    assert commander.end(7) == Wish(REST, 1007, BEAT)


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
