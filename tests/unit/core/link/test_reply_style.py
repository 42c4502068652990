"""Tests that detect whether an MCU reports on its own or answers, as soon as the two differ."""

from __future__ import annotations

import pytest

from acsard.core.link.reply_style import ReplyStyle


def stall(habit: ReplyStyle, lines: int, periods: float, left: int) -> None:
    for _ in range(left):
        habit.left()
    habit.read(lines, periods)


def test_while_we_send_every_period_nobody_can_tell() -> None:
    habit = ReplyStyle(speaks=False)
    for _ in range(1000):
        stall(habit, 1, 1.0, 1)
    assert habit.speaks is None


@pytest.mark.parametrize(("lines", "speaks"), [(15, True), (12, True), (1, False), (2, False)])
def test_a_stall_of_ours_tells_by_the_lines_that_came_in_it(lines: int, speaks: bool) -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, lines, 15.2, 1)
    assert habit.speaks is speaks


def test_short_stalls_tell_together() -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, 3, 3.0, 1)
    assert habit.speaks is None
    stall(habit, 3, 3.0, 1)
    assert habit.speaks is True


def test_lines_that_an_adapter_still_holds_belong_to_the_stall_they_were_made_in() -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, 13, 15.2, 11)
    assert habit.speaks is None, "neither is clearly nearer"
    stall(habit, 2, 0.3, 0)
    assert habit.speaks is True


def test_a_silence_that_fits_neither_tells_nothing() -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, 1, 40.0, 13)
    assert habit.speaks is None


def test_later_evidence_counts() -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, 15, 15.0, 1)
    stall(habit, 1, 15.0, 1)
    assert habit.speaks is False


def test_what_is_configured_is_not_doubted() -> None:
    habit = ReplyStyle(speaks=True)
    stall(habit, 1, 15.0, 1)
    assert habit.speaks is True


def test_nothing_is_expected_after_a_long_silence() -> None:
    habit = ReplyStyle(speaks=False)
    stall(habit, 1, 200.0, 1)
    assert habit.speaks is None
