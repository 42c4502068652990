"""Tests of keyboard driving: a key press drives for a while, then zeros follow, then silence."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.cli import drive
from acsard.cli.drive import ASK_S, HOLD_S, NO_END, ZEROS, News, Page, Ride, Teleop, split
from acsard.client.driving import Answers
from acsard.messages.encodings import encode
from acsard.messages.schema import RobotState, Time
from acsard.top.teleop import HELP
from acsard.values import REST, Twist
from tests.unit.top.screens import STATE
from tests.unit.top.test_teleop import SEEN

UP, DOWN, RIGHT, LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"

MOVES = [
    ("i", 1, 0), ("o", 1, -1), ("u", 1, 1), ("j", 0, 1), ("l", 0, -1),
    (",", -1, 0), (".", -1, 1), ("m", -1, -1),
    (UP, 1, 0), (DOWN, -1, 0), (LEFT, 0, 1), (RIGHT, 0, -1),
]  # fmt: skip
"""Key bindings of teleop_twist_keyboard (moveBindings: x and th), and of the arrow keys."""

SPEEDS = [
    ("q", 1.1, 1.1), ("z", 0.9, 0.9), ("w", 1.1, 1.0), ("x", 0.9, 1.0), ("e", 1.0, 1.1),
    ("c", 1.0, 0.9),
]  # fmt: skip


def silent() -> Teleop:
    """Return a teleop at 0.5 m/s and 2 rad/s that has sent its initial zeros."""
    teleop = Teleop(0.5, 2.0)
    while teleop.send(0.0) is not None:
        pass
    return teleop


def pressed(key: str, now: float) -> Teleop:
    """Return a teleop after a silence, this key, and the zero that precedes every drive."""
    teleop = silent()
    teleop.press(key, now)
    assert teleop.send(now) == REST
    return teleop


def test_it_opens_with_three_zeros_and_falls_silent() -> None:
    teleop = Teleop(0.5, 2.0)
    assert [teleop.send(n / 20) for n in range(6)] == [REST] * 3 + [None] * 3
    assert ZEROS == 3


@pytest.mark.parametrize(("key", "linear", "angular"), MOVES)
def test_each_key_drives_its_way(key: str, linear: int, angular: int) -> None:
    teleop = pressed(key, 10.0)
    assert teleop.send(10.0) == Twist(0.5 * linear, 2.0 * angular)


def test_only_a_drive_after_a_silence_is_led_by_a_zero() -> None:
    teleop = pressed("i", 10.0)
    teleop.press("j", 10.0 + HOLD_S)
    assert teleop.send(10.0 + HOLD_S) == Twist(0.0, 2.0)


def test_a_press_drives_for_its_hold_then_come_three_zeros_then_silence() -> None:
    teleop = pressed("i", 10.0)
    assert teleop.send(10.0 + HOLD_S - 0.001) == Twist(0.5, 0.0)
    assert [teleop.send(10.0 + HOLD_S) for _ in range(5)] == [REST] * 3 + [None] * 2


def test_the_hold_is_longer_than_the_delay_of_a_keyboard_and_no_longer_than_a_second() -> None:
    assert 0.5 < HOLD_S <= 1.0


def test_a_repeated_press_extends_the_hold() -> None:
    teleop = pressed("i", 10.0)
    for n in range(20):
        teleop.press("i", 10.0 + n * 0.5)
        assert teleop.send(10.0 + n * 0.5 + 0.499) == Twist(0.5, 0.0)
    assert teleop.send(19.5 + HOLD_S) == REST


def test_another_key_changes_the_way_at_once() -> None:
    teleop = pressed("i", 10.0)
    teleop.press("j", 10.1)
    assert teleop.send(10.1) == Twist(0.0, 2.0)
    assert teleop.send(10.0 + HOLD_S) == Twist(0.0, 2.0)


@pytest.mark.parametrize("key", [" ", "k", "p", "\x1b", "\x1b[H", "I", "\n", "�", ""])
def test_any_other_key_stops_at_once(key: str) -> None:
    teleop = pressed("i", 10.0)
    teleop.press(key, 10.1)
    assert [teleop.send(10.1) for _ in range(4)] == [REST] * 3 + [None]


def test_a_stop_at_rest_sends_its_zeros_too() -> None:
    teleop = silent()
    teleop.press(" ", 10.0)
    assert [teleop.send(10.0) for _ in range(4)] == [REST] * 3 + [None]


@pytest.mark.parametrize(("key", "linear", "angular"), SPEEDS)
def test_speed_keys_change_ten_percent_and_do_not_move(
    key: str, linear: float, angular: float
) -> None:
    teleop = silent()
    teleop.press(key, 10.0)
    assert (teleop.linear, teleop.angular) == pytest.approx((0.5 * linear, 2.0 * angular))
    assert teleop.send(10.0) is None


def test_a_speed_key_while_driving_counts_at_once_and_does_not_hold_longer() -> None:
    teleop = pressed("u", 10.0)
    teleop.press("w", 10.5)
    assert teleop.send(10.5) == Twist(0.5 * 1.1, 2.0)
    assert teleop.send(10.0 + HOLD_S) == REST


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("", []),
        ("i", ["i"]),
        ("iii", ["i", "i", "i"]),
        (UP, [UP]),
        (UP + UP, [UP, UP]),
        ("i" + LEFT + "k", ["i", LEFT, "k"]),
        ("\x1b", ["\x1b"]),
        ("\x1bi", ["\x1b", "i"]),
        ("\x1b[", ["\x1b["]),
        ("\x1b" + RIGHT, ["\x1b", RIGHT]),
        ("�,", ["�", ","]),
    ],
)
def test_what_a_terminal_gives_is_cut_into_keys(text: str, keys: list[str]) -> None:
    assert split(text) == keys


@given(st.text(alphabet="i,k\x1b[ABé", max_size=40))
def test_cutting_loses_nothing(text: str) -> None:
    keys = split(text)
    assert "".join(keys) == text
    assert all(len(key) == 1 or key.startswith("\x1b[") for key in keys)


@given(st.lists(st.sampled_from([*"io,k ", UP, DOWN, LEFT, RIGHT])))
def test_whole_keys_come_back_as_they_were(keys: list[str]) -> None:
    assert split("".join(keys)) == keys


# the robot's published state


class Robot:
    """A client whose robot has published these states.

    A storage in the router keeps the last one.
    """

    source, sender = "teleop", "joe/1/aa"

    def __init__(self, *said: RobotState) -> None:
        self.said = deque(map(sample_of, said))
        self.stored: RobotState | None = None

    def subscribe(self, name: str) -> Any:
        return SimpleNamespace(try_recv=lambda: self.said.popleft() if self.said else None)

    def ask(self, name: str, take: Any) -> None:
        if self.stored is not None:
            take(sample_of(self.stored))

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Do nothing, because this robot no longer receives."""


def sample_of(state: RobotState) -> Any:
    payload = SimpleNamespace(to_bytes=lambda: encode(state, "json"))
    return SimpleNamespace(encoding="application/json", payload=payload)


def heard_after(robot: Any, seconds: float, monkeypatch: pytest.MonkeyPatch) -> float:
    """Return the age of the state that is displayed after this many seconds, s."""
    now = [100.0]
    monkeypatch.setattr(drive, "time", SimpleNamespace(monotonic=lambda: now[0]))
    ride = Ride(robot, Teleop(0.5, 2.0), "acsar", "tcp/127.0.0.1:7448")
    while now[0] < 100.0 + seconds:
        ride.take()
        now[0] += 0.05
    return ride.seen().age


@pytest.mark.parametrize("said", [(STATE,), ()], ids=["it died on the way", "it is long dead"])
def test_what_a_storage_still_has_of_a_dead_robot_is_no_news(
    said: tuple[RobotState, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot(*said)
    robot.stored = STATE
    assert heard_after(robot, 10 * ASK_S, monkeypatch) == pytest.approx(10 * ASK_S, abs=0.11)


def test_a_storage_that_has_what_was_heard_last_says_no_news() -> None:
    older, last = replace(STATE, stamp=Time(9)), replace(STATE, stamp=Time(10))
    answers = Answers()
    assert answers.news(older, replace(STATE, stamp=Time(8)))
    assert not answers.news(last, last)


def test_the_answers_of_a_robot_that_publishes_seldom_are_news(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Alive(Robot):
        def ask(self, name: str, take: Any) -> None:
            before = self.stored or STATE
            self.stored = replace(before, stamp=Time(before.stamp.sec + 1))
            super().ask(name, take)

    assert heard_after(Alive(), 10 * ASK_S, monkeypatch) < 2 * ASK_S


def test_so_are_they_when_its_clock_was_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    class SetBack(Robot):
        def ask(self, name: str, take: Any) -> None:
            before = self.stored or replace(STATE, stamp=Time(1))
            self.stored = replace(before, stamp=Time(before.stamp.sec + 1))
            super().ask(name, take)

    said = replace(STATE, stamp=Time(10**6))
    assert heard_after(SetBack(said), 10 * ASK_S, monkeypatch) < 2 * ASK_S


# without a screen


def told(states: list[tuple[float, RobotState]]) -> list[RobotState]:
    """Return the states that are printed when these states arrive at these times, s."""
    news = News()
    return [state for now, state in states if news.tell(replace(SEEN, state=state), now)]


def test_a_robot_that_moves_is_a_line_a_second_and_one_at_rest_one_in_ten() -> None:
    moving = [(n / 20, replace(STATE, x=n / 40, linear=0.5)) for n in range(200)]
    assert len(told(moving)) == 10
    resting = [(n / 20, replace(STATE, linear=0.0, angular=0.0)) for n in range(200)]
    assert len(told(resting)) == 1


def test_another_reason_is_told_at_once_but_never_more_than_two_lines_a_second() -> None:
    stopped = replace(STATE, mode="stopped", reason="stopped by request")
    found = told([(0.0, STATE), (0.5, stopped), (0.6, STATE), (1.0, STATE)])
    assert [state.mode for state in found] == ["driving", "stopped", "driving"]
    flickering = [(n / 20, replace(STATE, reason=f"because {n}")) for n in range(200)]
    assert len(told(flickering)) <= 20


def test_the_help_comes_again_before_news_shoves_it_off_the_terminal() -> None:
    page, shown = Page(), list[str]()
    for number in range(100):
        shown += page.with_help([f"news {number}", *["more of it"] * (number % 4)], 24)
        # The last line of a terminal stays empty, because the cursor is there.
        assert list(HELP) == [line for line in shown[-23:] if line in HELP]
    assert shown.count(HELP[0]) < 30
    assert shown[-4:-3] == ["news 99"]


def test_a_file_has_the_help_once() -> None:
    page = Page()
    assert page.with_help(["news"], NO_END) == [*HELP, "news"]
    assert page.with_help(["news"] * 1000, NO_END) == ["news"] * 1000
