"""A window with too many dropped lines is reported once, with its correction."""

from __future__ import annotations

from acsard.core.motion.impossible_lines import SHARE, WINDOW, ImpossibleLines
from acsard.core.values import Event

WHY = "front_left from 0.00 to 20.00 rad/s is over feedback.wheel_acceleration"
MOST = int(SHARE * WINDOW)


def told(dropped: ImpossibleLines, bad: int, lines: int = WINDOW) -> list[Event]:
    """Return the events of a window whose first `bad` lines are dropped."""
    events = [dropped.line(WHY if i < bad else "") for i in range(lines)]
    return [event for event in events if event is not None]


def test_one_line_in_a_hundred_is_not_worth_a_word() -> None:
    dropped = ImpossibleLines()
    assert [told(dropped, MOST) for _ in range(5)] == [[]] * 5


def test_more_are_told_once_in_each_window() -> None:
    dropped = ImpossibleLines()
    assert [len(told(dropped, MOST + 1 + more)) for more in (0, 1, 500)] == [1, 1, 1]


def test_it_is_told_as_soon_as_there_are_too_many() -> None:
    dropped = ImpossibleLines()
    assert told(dropped, MOST, MOST) == []
    assert dropped.line(WHY) is not None


def test_the_words_say_what_was_dropped_and_what_to_do() -> None:
    (event,) = told(ImpossibleLines(), WINDOW)
    assert (event.name, event.level) == ("lines_implausible", "warning")
    assert event.text.startswith(f"{MOST + 1} of {MOST + 1} lines were dropped")
    assert WHY in event.text
    assert "mcu.link_check" in event.text
