"""Each key drives in its direction for a while, as in teleop_twist_keyboard."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.values import REST, Twist
from acsard.top.keyboard import (
    KEY_HOLD_S,
    REPEAT_S,
    Keyboard,
    split,
)
from tests.each import each

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


def pressed(key: str, now: float) -> Keyboard:
    """Return a keyboard at 0.5 m/s and 2 rad/s after this key."""
    keys = Keyboard(0.5, 2.0)
    keys.press(key, now)
    return keys


@each(("key", "linear", "angular"), MOVES)
def test_each_key_drives_in_its_direction_for_its_hold(key: str, linear: int, angular: int) -> None:
    assert Keyboard(0.5, 2.0).wish(10.0) is None
    # Longer than the delay of a keyboard before the first repeat.
    assert 0.5 < KEY_HOLD_S <= 1.0
    keys, twist = pressed(key, 10.0), Twist(0.5 * linear, 2.0 * angular)
    for at in (10.0, 10.0 + KEY_HOLD_S - 0.001):
        assert keys.wish(at) == twist
    assert keys.wish(10.0 + KEY_HOLD_S) is None


@each(("delay", "hz"), [(0.25, 30.0), (0.5, 30.0), (0.5, 10.9), (0.25, 5.0)])
def test_a_held_key_drives_on_and_stops_soon_after_its_release(delay: float, hz: float) -> None:
    keys, last = pressed("i", 10.0), 10.0
    for at in [10.0 + delay + n / hz for n in range(30)]:
        assert keys.wish(at - 0.001) == Twist(0.5, 0.0)
        keys.press("i", at)
        last = at
    assert keys.wish(last + REPEAT_S - 0.001) == Twist(0.5, 0.0)
    assert keys.wish(last + REPEAT_S) is None


@each("key", [" ", "k", "p", "\x1b", "\x1b[H", "I", "\n", "�", ""])
def test_any_other_key_stops_immediately(key: str) -> None:
    for keys in (pressed("i", 10.0), Keyboard(0.5, 2.0)):  # at rest, too
        keys.press(key, 10.1)
        assert [keys.wish(10.1) for _ in range(3)] == [REST, None, None]


@each(("key", "linear", "angular"), SPEEDS)
def test_speed_keys_change_a_tenth_and_do_not_move(key: str, linear: float, angular: float) -> None:
    keys = pressed(key, 10.0)
    assert (keys.linear, keys.angular) == pytest.approx((0.5 * linear, 2.0 * angular))
    assert keys.wish(10.0) is None


@each(
    ("text", "keys"),
    [
        ("", []),
        ("iii", ["i", "i", "i"]),
        (UP + UP, [UP, UP]),
        ("i" + LEFT + "k", ["i", LEFT, "k"]),
        ("\x1bi", ["\x1b", "i"]),
        ("\x1b[", ["\x1b["]),
        ("\x1b" + RIGHT, ["\x1b", RIGHT]),
    ],
)
def test_terminal_input_is_split_into_keys(text: str, keys: list[str]) -> None:
    assert split(text) == keys


@given(st.text(alphabet="i,k\x1b[ABé", max_size=40))
def test_the_split_into_keys_loses_no_character(text: str) -> None:
    keys = split(text)
    assert "".join(keys) == text
    assert all(len(key) == 1 or key.startswith("\x1b[") for key in keys)
