"""The MCU's answer is timed from the youngest line it can belong to."""

from __future__ import annotations

import pytest

from acsard.mcu.roundtrip import MOST_NS, RoundTrip

MS = 1_000_000
SHORTEST_NS = 6 * MS


def matched(trips: list[int], period: int = 10) -> list[int | None]:
    """Lines every `period` ms, each answered after so many ms: what is told, in ms."""
    round_trip, told = RoundTrip(SHORTEST_NS), []
    happenings = [(n * period, "line") for n in range(len(trips))]
    happenings += [(n * period + trip, "reply") for n, trip in enumerate(trips)]
    for at_ms, what in sorted(happenings):
        if what == "line":
            round_trip.sent(at_ms * MS)
        else:
            found = round_trip.replied(at_ms * MS)
            told.append(None if found is None else found // MS)
    return told


@pytest.mark.parametrize("trips", [[7, 8, 9], [11, 7, 12, 9], [6, 15, 6]])
def test_answers_within_a_period_and_the_wires_time_are_told_exactly(trips: list[int]) -> None:
    assert matched(trips) == trips


def test_lines_on_their_way_one_behind_the_other_are_told_apart() -> None:
    assert matched([71, 71, 71], period=43) != [71, 71, 71]
    round_trip = RoundTrip(68 * MS)
    for at_ms in (0, 43):
        round_trip.sent(at_ms * MS)
    assert round_trip.replied(71 * MS) == 71 * MS


def test_a_lost_answer_does_not_make_the_next_one_late() -> None:
    round_trip = RoundTrip(SHORTEST_NS)
    round_trip.sent(0)
    round_trip.sent(10 * MS)
    assert round_trip.replied(18 * MS) == 8 * MS
    assert round_trip.replied(19 * MS) is None, "no line is left that it could answer"


def test_an_answer_faster_than_the_wire_belongs_to_no_line() -> None:
    round_trip = RoundTrip(SHORTEST_NS)
    round_trip.sent(0)
    assert round_trip.replied(SHORTEST_NS - 1) is None
    assert round_trip.replied(SHORTEST_NS) == SHORTEST_NS


def test_after_a_silence_nothing_old_is_matched() -> None:
    round_trip = RoundTrip(SHORTEST_NS)
    round_trip.sent(0)
    assert round_trip.replied(MOST_NS + 1) is None
