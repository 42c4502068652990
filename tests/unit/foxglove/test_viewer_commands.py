"""Tests of a viewer's commands: decoding, their times, and the reasons why they do not drive."""

from __future__ import annotations

import pytest

from acsard.foxglove.viewer_commands import (
    DRIVES_NS,
    HEAP_NS,
    LONGEST_NS,
    OBJECTS_NS,
    SILENCE_NS,
    STALE_NS,
    Hand,
    Objections,
    Wish,
    encoding_of,
    wish,
)
from acsard.messages.encodings import DecodeError, encode
from acsard.messages.schema import Header, Time, TwistStamped, Vector3
from acsard.messages.schema import Twist as Message
from acsard.values import NS_PER_S, REST, Twist

AHEAD, LEFT = Twist(0.5, 0.0), Twist(0.0, 1.0)
MS = NS_PER_S // 1000


class Panel:
    """A commander with a clock and a record of the twists it sent."""

    def __init__(self) -> None:
        self.hand, self.now = Hand(), 10 * NS_PER_S
        self.gone: list[Twist] = []

    def wait(self, span_ns: int) -> None:
        """Let time pass and send everything that falls due."""
        end = self.now + span_ns
        while (due := self.hand.due_ns()) is not None and due <= end:
            self.now = max(self.now, due)
            wish = self.hand.send(self.now)
            if wish is not None:
                self.gone.append(wish.twist)
        self.now = end

    def press(self, twist: Twist, times: int = 1, every_ns: int = 100 * MS) -> None:
        for _ in range(times):
            self.hand.take(Wish(twist), self.now)
            self.wait(every_ns)


@pytest.fixture
def panel() -> Panel:
    return Panel()


def test_each_message_goes_once_behind_one_zero(panel: Panel) -> None:
    panel.press(AHEAD, times=5)
    assert panel.gone == [REST, *[AHEAD] * 5]


def test_nothing_goes_that_nobody_sends(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    before = len(panel.gone)
    panel.wait(100 * NS_PER_S)
    assert len(panel.gone) == before
    assert panel.hand.due_ns() is None


def test_a_silence_is_followed_by_a_zero_first(panel: Panel) -> None:
    panel.press(AHEAD)
    panel.wait(SILENCE_NS)
    panel.press(LEFT)
    assert panel.gone == [REST, AHEAD, REST, LEFT]


def test_a_heap_that_was_held_back_is_lived_by_nobody(panel: Panel) -> None:
    panel.press(AHEAD, times=3)
    panel.wait(2 * NS_PER_S)
    for _ in range(20):
        panel.hand.take(Wish(AHEAD), panel.now)
        panel.now += MS
    panel.wait(NS_PER_S)
    assert panel.gone == [REST, *[AHEAD] * 3, REST]
    assert panel.hand.stale == 1
    assert panel.hand.replaced == 19


def test_behind_a_heap_what_the_person_wants_now_goes(panel: Panel) -> None:
    panel.press(AHEAD, times=4, every_ns=0)
    panel.wait(100 * MS)
    panel.press(LEFT, times=2)
    assert panel.gone == [REST, LEFT, LEFT]


def test_of_those_that_wait_the_newest_goes(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.hand.take(Wish(AHEAD), panel.now)
    panel.hand.take(Wish(LEFT), panel.now)
    panel.wait(0)
    assert panel.gone == [REST, AHEAD, AHEAD, LEFT]
    assert panel.hand.replaced == 1


def test_what_waited_too_long_does_not_go(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.hand.take(Wish(AHEAD), panel.now)
    assert panel.hand.send(panel.now + STALE_NS + 1) is None
    assert panel.hand.stale == 1
    assert panel.hand.due_ns() is None


def test_who_begins_waits_for_the_heap_and_nobody_else(panel: Panel) -> None:
    panel.hand.take(Wish(AHEAD), panel.now)
    assert panel.hand.send(panel.now) == Wish(REST)
    assert panel.hand.send(panel.now + HEAP_NS - 1) is None
    assert panel.hand.send(panel.now + HEAP_NS) == Wish(AHEAD)
    panel.now += 100 * MS
    panel.hand.take(Wish(AHEAD), panel.now)
    assert panel.hand.send(panel.now) == Wish(AHEAD)


def test_who_lets_go_while_driving_leaves_one_zero(panel: Panel) -> None:
    panel.press(AHEAD, times=2)
    panel.hand.take(Wish(AHEAD), panel.now)
    assert panel.hand.end(panel.now) == Wish(REST)
    assert panel.hand.end(panel.now) is None
    assert panel.hand.due_ns() is None


def test_who_does_not_drive_leaves_nothing(panel: Panel) -> None:
    assert panel.hand.end(panel.now) is None
    panel.press(AHEAD, times=2)
    panel.press(REST)
    assert panel.hand.end(panel.now) is None
    panel.press(AHEAD, times=2)
    assert panel.hand.end(panel.now + LONGEST_NS + NS_PER_S) is None


def test_he_drives_while_he_asks_for_a_speed(panel: Panel) -> None:
    assert not panel.hand.drives(panel.now)
    panel.press(AHEAD)
    assert panel.hand.drives(panel.now)
    assert not panel.hand.drives(panel.now + DRIVES_NS)
    panel.press(REST)
    assert not panel.hand.drives(panel.now)


@pytest.mark.parametrize(("rate", "slow"), [(1.0, True), (2.0, True), (5.0, False), (20.0, False)])
def test_a_panel_that_publishes_too_seldom_is_known(panel: Panel, rate: float, slow: bool) -> None:
    panel.press(AHEAD, times=6, every_ns=int(NS_PER_S / rate))
    assert panel.hand.is_slow() is slow


def test_single_presses_are_no_slow_panel(panel: Panel) -> None:
    panel.press(AHEAD, times=6, every_ns=4 * NS_PER_S)
    assert not panel.hand.is_slow()


def test_a_stamp_goes_with_its_message_and_zeros_are_by_the_same_clock(panel: Panel) -> None:
    panel.hand.take(Wish(AHEAD, 1000), panel.now)
    assert panel.hand.send(panel.now + 3) == Wish(REST, 1003)
    panel.now += HEAP_NS
    assert panel.hand.send(panel.now) == Wish(AHEAD, 1000)
    panel.hand.take(Wish(LEFT, 1000 + 2 * HEAP_NS), panel.now)
    assert panel.hand.send(panel.now) == Wish(LEFT, 1000 + 2 * HEAP_NS)
    assert panel.hand.end(panel.now + 5) == Wish(REST, 1005 + 2 * HEAP_NS)


def test_who_stamps_no_more_has_zeros_without_a_stamp(panel: Panel) -> None:
    panel.hand.take(Wish(AHEAD, 1000), panel.now)
    panel.hand.take(Wish(AHEAD), panel.now)
    assert panel.hand.send(panel.now) == Wish(REST)


MESSAGE = Message(Vector3(x=0.3), Vector3(z=-0.2))
STAMPED = TwistStamped(Header(Time(5)), MESSAGE)


@pytest.mark.parametrize("name", ["geometry_msgs/Twist", "geometry_msgs/msg/Twist"])
@pytest.mark.parametrize("form", ["json", "cdr"])
def test_a_panel_s_twist_is_read(name: str, form: str) -> None:
    encoding = encoding_of(form, name)
    found = wish(encoding, encode(MESSAGE, "json" if form == "json" else "cdr"))
    assert found == Wish(Twist(0.3, -0.2))


@pytest.mark.parametrize("form", ["json", "cdr"])
def test_a_stamped_one_too_with_its_stamp(form: str) -> None:
    encoding = encoding_of(form, "geometry_msgs/msg/TwistStamped")
    found = wish(encoding, encode(STAMPED, "json" if form == "json" else "cdr"))
    assert found == Wish(Twist(0.3, -0.2), 5 * NS_PER_S)


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("json", "std_msgs/msg/String"),
        ("json", "Twist"),
        ("json", ""),
        ("ros1", "geometry_msgs/Twist"),
        ("", "geometry_msgs/Twist"),
    ],
)
def test_what_drives_nothing_is_told_before_it_is_sent(form: str, name: str) -> None:
    with pytest.raises(DecodeError, match="wanted"):
        encoding_of(form, name)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        b'{"linear": {"x": 1}}',
        b'{"linear": {"x": "fast"}, "angular": {}}',
        b'{"linear": {"x": NaN}, "angular": {}}',
        b'{"linear": {"x": 1}, "angular": {}, "more": 1}',
        b"\xff" * 60,
        b'{"linear": {"x": 1}, "angular": {}}' + b" " * 5000,
    ],
)
def test_what_is_no_twist_is_refused(payload: bytes) -> None:
    for encoding in (encoding_of("json", "geometry_msgs/Twist"),):
        with pytest.raises(DecodeError):
            wish(encoding, payload)


@pytest.mark.parametrize("cut", range(0, 52, 4))
def test_cdr_cut_anywhere_is_refused(cut: int) -> None:
    with pytest.raises(DecodeError):
        wish(encoding_of("cdr", "geometry_msgs/Twist"), encode(MESSAGE, "cdr")[:cut])


WHY = "stopped by request"


def test_the_first_moment_is_no_news() -> None:
    told = Objections()
    assert not told.look(WHY, 0)
    assert not told.look(WHY, OBJECTS_NS - 1)
    assert told.look(WHY, OBJECTS_NS)
    assert told.told == WHY


def test_it_is_told_once_and_taken_back_when_over() -> None:
    told = Objections()
    changes = [told.look(WHY if n < 20 else "", n * OBJECTS_NS) for n in range(30)]
    assert changes.count(True) == 2
    assert changes[1]
    assert changes[20]
    assert told.told == ""


def test_another_reason_is_told_at_once() -> None:
    told = Objections()
    told.look(WHY, 0)
    told.look(WHY, OBJECTS_NS)
    assert told.look("fault", OBJECTS_NS + 1)
    assert told.told == "fault"


def test_what_is_over_soon_is_never_told() -> None:
    told = Objections()
    assert not any(told.look(WHY if n % 2 else "", n * (OBJECTS_NS - 1)) for n in range(20))
