"""Tests of the lines per second, the lost lines, and the lateness of the loop."""

from __future__ import annotations

import pytest

from acsard.report.line import Lateness, Link

MS = 1_000_000


def linked(answers: dict[int, int], seconds: int = 10, in_flight: int = 0) -> Link:
    """Return a link with 100 lines a second; `answers` gives seconds with another number."""
    link, sent, good = Link(), 0, 0.0
    for n in range(100 * seconds):
        second = n // 100
        sent, good = sent + 1, good + answers.get(second, 100) / 100
        link.step(n / 100, True, {"lines": max(0, round(good) - in_flight), "line_header": 0})
    link.end()
    return link


def test_a_sound_line_loses_nothing() -> None:
    for in_flight in (0, 1):
        link = linked({}, in_flight=in_flight)
        assert link.totals.unanswered == 0
        assert [point.value for point in link.sent.points()] == [100.0] * 10


def test_lost_lines_are_told_in_their_second() -> None:
    link = linked({4: 70})
    lost = {int(point.t): point.value for point in link.unanswered.points()}
    assert link.totals.unanswered == 30
    # The newest line of a second counts once another one has followed it.
    assert lost[4] + lost[5] == 30
    assert {second: count for second, count in lost.items() if count and second not in (4, 5)} == {}


def test_lines_that_are_no_good_are_dropped_and_not_lost() -> None:
    link = Link()
    for n in range(300):
        bad = n // 10
        counters = {"lines": n + 1 - bad, "line_header": bad - bad // 2, "line_value": bad // 2}
        link.step(n / 100, True, counters)
    link.end()
    assert (link.totals.sent, link.totals.unanswered) == (300, 0)
    assert link.totals.good + link.totals.dropped == 299  # the first line had already arrived


def test_a_line_that_could_not_be_true_is_dropped_too() -> None:
    link = Link()
    link.step(0.0, True, {"lines": 0})
    link.step(0.5, True, {"lines": 2, "line_impossible": 1})
    link.end()
    assert (link.totals.good, link.totals.dropped) == (1, 1)


def late(lates: list[float], ahead: frozenset[int] = frozenset()) -> Lateness:
    """Return the lateness after periods of 10 ms, each late by this many ms.

    Periods in `ahead` had a line that left at once.
    """
    lateness, number = Lateness(100.0), 0
    for n, ms in enumerate(lates):
        if n in ahead:
            lateness.at_once()
            continue
        lateness.tick(n / 100, round(n * 10 * MS + ms * MS), 0, known=True)
        number += 1
    return lateness


def test_lateness_is_against_the_least_late() -> None:
    values = [point.value for point in late([0.3, 0.1, 7.1, 0.1, 9.6, 0.1]).points()]
    assert values == pytest.approx([0.2, 0.0, 7.0, 0.0, 9.5, 0.0])


def test_a_line_that_went_at_once_makes_no_period_late() -> None:
    assert late([0.0] * 50, ahead=frozenset({7, 8, 20})).most == pytest.approx(0.0)


@pytest.mark.parametrize("at_once", [False, True])
def test_missed_periods_are_lateness_from_the_first_of_them(at_once: bool) -> None:
    lateness = Lateness(100.0)
    for n in range(10):
        lateness.tick(n / 100, n * 10 * MS, 0, known=True)
    if at_once:  # it replaces the first missed line
        lateness.at_once()
    lateness.tick(0.132, 132 * MS, 3, known=True)
    lateness.tick(0.14, 140 * MS, 0, known=True)
    assert (lateness.missed, lateness.most_missed) == (3, 3)
    assert lateness.most == pytest.approx(32.0)
    assert lateness.points()[-1].value == pytest.approx(0.0)


def test_steps_that_are_missing_are_no_lateness() -> None:
    lateness = Lateness(100.0)
    lateness.tick(0.0, 0, 0, known=True)
    lateness.tick(60.0, 60_000 * MS, 2, known=False)
    lateness.tick(60.01, 60_010 * MS, 0, known=True)
    assert lateness.most == pytest.approx(0.0)
