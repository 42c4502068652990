"""The daemon sends a line in every period, and an extra line at once for a new command.

Two lines are never too close together.
"""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from acsard.daemon.pacing import MAX_IDLE_WAKES, REPLY_TIME_NS, Pace

MS = 1_000_000
WIRE_NS = 3 * MS
PERIOD_NS = 10 * MS
GAP_NS = WIRE_NS + REPLY_TIME_NS


class Paced:
    """The pacing under test, called as the control loop calls it."""

    def __init__(self, period_ns: int = PERIOD_NS) -> None:
        self.pace = Pace(WIRE_NS, period_ns)
        self.sent_ns = -GAP_NS
        """Time of the last sent line, as the port remembers it."""

    def ticks(self, at_ns: int, missed: int = 0) -> bool:
        """End a period without a new command, and return whether a line was sent."""
        due = self.pace.period_ended(missed)
        self.sent_ns = at_ns if due else self.sent_ns
        self.pace.record_step(due, due, due, False, False, self.sent_ns)
        return due

    def hears(self, at_ns: int, *, news: bool = True, goes: bool = True) -> bool:
        """Receive a command between two periods. Return whether the loop tried to send a line."""
        due = news and self.at_once(at_ns)
        self.sent_ns = at_ns if due and goes else self.sent_ns
        self.pace.record_step(False, due, due and goes, news, True, self.sent_ns)
        return due

    def at_once(self, at_ns: int) -> bool:
        return self.pace.at_once(at_ns, self.sent_ns)

    @property
    def retry_ns(self) -> int | None:
        return self.pace.retry_ns


def ticked() -> Paced:
    """Return the pacing after a period whose line was sent at time 0."""
    paced = Paced()
    assert paced.ticks(0)
    return paced


def test_every_period_has_its_line() -> None:
    paced = Paced()
    assert all(paced.ticks(number * PERIOD_NS) for number in range(5))


def test_an_early_line_keeps_the_minimum_gap() -> None:
    paced = ticked()
    assert not paced.at_once(GAP_NS - 1)
    assert paced.at_once(GAP_NS)


def test_the_minimum_gap_begins_when_the_last_line_is_sent() -> None:
    paced = Paced()
    paced.pace.period_ended(0)
    paced.pace.record_step(True, True, True, False, False, 2 * MS)
    paced.sent_ns = 2 * MS
    assert not paced.at_once(2 * MS + GAP_NS - 1)
    assert paced.at_once(2 * MS + GAP_NS)


def test_an_early_line_replaces_the_line_of_the_next_period() -> None:
    paced = ticked()
    assert paced.hears(6 * MS)
    assert not paced.hears(9 * MS), "one early line in a period"
    assert not paced.ticks(10 * MS)
    assert paced.ticks(20 * MS)


def test_after_missed_periods_the_periodic_line_is_sent_even_after_an_early_one() -> None:
    paced = ticked()
    assert paced.hears(6 * MS)
    assert paced.ticks(50 * MS, missed=4)


def test_a_failed_early_line_does_not_replace_the_periodic_line() -> None:
    paced = ticked()
    assert paced.hears(6 * MS, goes=False)
    assert not paced.hears(7 * MS), "one try a period"
    assert paced.retry_ns is None
    assert not paced.pace.early
    assert paced.ticks(10 * MS)
    assert paced.pace.early


def test_a_command_within_the_minimum_gap_is_sent_as_soon_as_the_gap_has_passed() -> None:
    paced = ticked()
    assert not paced.hears(1 * MS)
    assert paced.retry_ns == GAP_NS
    assert not paced.pace.early, "the retry sends the newest command anyway"
    assert paced.hears(GAP_NS)
    assert paced.retry_ns is None


def test_without_a_changed_command_there_is_no_retry() -> None:
    paced = ticked()
    paced.hears(1 * MS, news=False)
    assert paced.retry_ns is None
    assert paced.pace.early


def test_messages_without_effect_wake_the_loop_a_limited_number_of_times_a_period() -> None:
    paced = ticked()
    for _ in range(MAX_IDLE_WAKES):
        paced.hears(5 * MS, news=False)
        assert paced.pace.early
    paced.hears(5 * MS, news=False)
    assert not paced.pace.early
    paced.ticks(10 * MS)
    assert paced.pace.early


def test_the_first_line_needs_no_gap() -> None:
    assert Paced().at_once(0)


def test_no_early_line_is_scheduled_if_the_next_period_comes_within_the_gap() -> None:
    paced = Paced(period_ns=GAP_NS)
    paced.ticks(0)
    assert not paced.pace.early
    assert not paced.hears(GAP_NS)
    assert paced.retry_ns is None


@given(st.lists(st.tuples(st.integers(1, 12), st.booleans(), st.booleans()), max_size=200))
def test_no_traffic_makes_more_lines_than_periods_or_lines_within_the_gap(
    wakes: list[tuple[int, bool, bool]],
) -> None:
    pace, now_ns, due_ns, periods = Pace(WIRE_NS, PERIOD_NS), 0, PERIOD_NS, 0
    lines: list[int] = []
    for wait_ms, news, blocked in wakes:
        now_ns += wait_ms * MS
        expired = max(0, (now_ns - due_ns) // PERIOD_NS + 1)
        due_ns += expired * PERIOD_NS
        periods += expired
        tick = expired > 0 and pace.period_ended(expired - 1)
        sent_ns = lines[-1] if lines else -GAP_NS
        due = tick or (news and pace.at_once(now_ns, sent_ns))
        sent = due and not blocked and (not lines or now_ns - lines[-1] >= WIRE_NS)
        lines += [now_ns] * sent
        pace.record_step(tick, due, sent, news, news, lines[-1] if lines else -GAP_NS)
        retry_ns = pace.retry_ns
        assert retry_ns is None or retry_ns > now_ns
    assert len(lines) <= periods + 1
    assert all(after - before >= WIRE_NS for before, after in pairwise(lines))
