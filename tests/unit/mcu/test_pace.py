"""A line goes every period, and at once for what is new, never two too close together."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from acsard.mcu.pace import BREATH_NS, IDLE_WAKES, Pace

MS = 1_000_000
WIRE_NS = 3 * MS
GAP_NS = WIRE_NS + BREATH_NS


def ticked(at_ns: int = 0) -> Pace:
    """After the line of a period at `at_ns`."""
    pace = Pace(WIRE_NS)
    assert pace.tick()
    pace.note(at_ns, True, True, False, False)
    return pace


def test_every_period_has_its_line() -> None:
    pace = Pace(WIRE_NS)
    for number in range(5):
        assert pace.tick()
        pace.note(number * 10 * MS, True, True, False, False)


def test_a_line_at_once_keeps_the_gap() -> None:
    pace = ticked()
    assert not pace.at_once(GAP_NS - 1)
    assert pace.at_once(GAP_NS)


def test_a_line_at_once_takes_the_next_periods_place() -> None:
    pace = ticked()
    pace.note(6 * MS, False, True, True, False)
    assert not pace.at_once(9 * MS), "only one"
    assert not pace.tick()
    pace.note(10 * MS, False, False, False, False)
    assert pace.tick()


def test_what_comes_too_soon_is_sent_as_soon_as_the_gap_has_passed() -> None:
    pace = ticked()
    pace.note(1 * MS, False, False, True, False)
    assert pace.retry_ns == GAP_NS
    assert not pace.listens, "it is awake for the newest command anyway"


def test_there_is_nothing_to_retry_without_news() -> None:
    pace = ticked()
    pace.note(1 * MS, False, False, False, False)
    assert pace.retry_ns is None
    assert pace.listens


def test_a_stranger_wakes_it_only_so_often_a_period() -> None:
    pace = ticked()
    for _ in range(IDLE_WAKES):
        pace.note(5 * MS, False, False, False, True)
        assert pace.listens
    pace.note(5 * MS, False, False, False, True)
    assert not pace.listens
    pace.tick()
    pace.note(10 * MS, True, True, False, False)
    assert pace.listens


def test_the_line_before_the_first_is_long_ago() -> None:
    assert Pace(WIRE_NS).at_once(0)


@given(st.lists(st.tuples(st.integers(1, 12), st.booleans()), max_size=200))
def test_no_traffic_makes_more_lines_than_the_clock_or_closer_ones(
    wakes: list[tuple[int, bool]],
) -> None:
    pace, now_ns, due_ns = Pace(WIRE_NS), 0, 10 * MS
    periods = 0
    lines: list[int] = []
    for wait_ms, news in wakes:
        now_ns += wait_ms * MS
        tick = now_ns >= due_ns
        if tick:
            periods += 1
            due_ns += 10 * MS * (1 + (now_ns - due_ns) // (10 * MS))
        own = tick and pace.tick()
        sent = (own and (not lines or now_ns - lines[-1] >= WIRE_NS)) or (
            news and pace.at_once(now_ns)
        )
        pace.note(now_ns, own, sent, news, False)
        if sent:
            lines.append(now_ns)
    assert len(lines) <= periods + 1
    gaps = [after - before for before, after in pairwise(lines)]
    assert all(gap >= WIRE_NS for gap in gaps)
