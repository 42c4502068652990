"""A link that loses lines is reported once, in whichever direction they are lost."""

from __future__ import annotations

from acsard.core.motion.unanswered_lines import LOST, WINDOW, UnansweredLines


def told(every: int, windows: int = 3, period: float = 0.0, linked: bool = True) -> list[str]:
    """Return the events of a link that loses every n-th line."""
    answered = UnansweredLines(period)
    events = [
        answered.look(sent, sent - sent // every if every else sent, linked)
        for sent in range(windows * WINDOW + 1)
    ]
    return [event.text for event in events if event is not None]


def test_a_fifth_lost_is_told_once_with_its_figures() -> None:
    (text,) = told(5)
    assert f"only {WINDOW * 4 // 5} of {WINDOW} lines were answered" in text
    assert "`acsard mcu check`" in text


def test_what_a_sound_link_loses_is_not_told() -> None:
    assert told(0) == told(int(1 / LOST) + 1) == []


def test_a_board_known_to_report_by_its_own_clock_and_no_link_are_not_judged() -> None:
    assert told(5, period=0.1) == told(5, linked=False) == []


def test_it_is_told_again_after_the_link_was_lost() -> None:
    answered, events = UnansweredLines(0.0), []
    for sent in range(3 * WINDOW):
        events.append(answered.look(sent, sent // 2, sent != WINDOW + 10))
    assert len([event for event in events if event]) == 2
