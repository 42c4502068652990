"""How late the control loop runs, by figures and by its pace."""

from __future__ import annotations

import math
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.messages.schema import Latency, Spread
from acsard.core.values import NS_PER_S
from acsard.daemon.latencies import (
    DECADES,
    PER_DECADE,
    SLOT_NS,
    SLOTS,
    Histogram,
    LastMinuteCount,
    Stopwatch,
)
from acsard.daemon.pacing import REPLY_TIME_NS, Pace

BUCKET = 10 ** (1 / PER_DECADE)
"""Upper end of a bucket divided by its lower end: 1.122."""


US, MS = 1000, 1_000_000


def spread_of(durations_ns: list[int]) -> Spread:
    histogram = Histogram()
    histogram.add(durations_ns)
    return histogram.spread()


def order_statistic(values: list[int], share: float) -> int:
    """Return the quantile `share`: the smallest value that at least this share do not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


@settings(max_examples=100)
@given(st.lists(st.integers(US, US * 10**DECADES), min_size=1, max_size=300))
def test_a_percentile_is_at_most_one_bucket_above_the_truth(durations_ns: list[int]) -> None:
    spread = spread_of(durations_ns)
    for share, percentile in ((0.50, spread.p50), (0.99, spread.p99)):
        truth = order_statistic(durations_ns, share) / US
        assert truth * (1 - 1e-9) <= percentile <= truth * BUCKET * (1 + 1e-9)


@settings(max_examples=100)
@given(st.lists(st.integers(-(10**6), 10**15), min_size=1, max_size=100))
def test_count_and_maximum_are_exact_and_the_percentiles_in_order(durations_ns: list[int]) -> None:
    spread = spread_of(durations_ns)
    assert spread.count == len(durations_ns)
    assert spread.max == max(0, *durations_ns) / US
    assert 0.0 <= spread.p50 <= spread.p99 <= spread.max


MINUTE_NS = SLOT_NS * SLOTS


def step_time(stopwatch: Stopwatch, now_ns: int) -> Latency:
    return stopwatch.measured(now_ns)["step_time"]


def test_a_measurement_older_than_a_minute_counts_only_since_the_start() -> None:
    stopwatch = Stopwatch()
    stopwatch.figures["step_time"].add(250 * US)
    assert step_time(stopwatch, 0).last_minute.count == 1
    assert step_time(stopwatch, MINUTE_NS - 1).last_minute.count == 1
    figure = step_time(stopwatch, MINUTE_NS + NS_PER_S)
    assert (figure.since_start.count, figure.last_minute.count) == (1, 0)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 20 * NS_PER_S), st.integers(0, 10**9)), max_size=60))
def test_the_last_minute_is_a_histogram_of_its_figures(
    measurements: list[tuple[int, int]],
) -> None:
    stopwatch, now_ns, samples = Stopwatch(), 0, []
    for wait_ns, duration_ns in measurements:
        now_ns += wait_ns
        stopwatch.figures["mcu_round_trip"].add(duration_ns)
        stopwatch.figures["mcu_round_trip"].sort(now_ns)
        samples.append((now_ns, duration_ns))
    minute = Histogram()
    minute.add([d for at_ns, d in samples if now_ns // SLOT_NS - at_ns // SLOT_NS < SLOTS])
    assert stopwatch.measured(now_ns)["mcu_round_trip"].last_minute == minute.spread()


def test_an_occurrence_counts_for_a_minute_and_then_no_longer() -> None:
    happened = LastMinuteCount()
    assert happened.count(0) == 0
    happened.add(0, 3)
    happened.add(SLOT_NS - 1, 2)
    happened.add(SLOT_NS, 1)
    assert happened.count(SLOT_NS) == 6
    assert happened.count(MINUTE_NS - 1) == 6
    assert happened.count(MINUTE_NS) == 1
    assert happened.count(MINUTE_NS + SLOT_NS) == 0


MS = 1_000_000
WIRE_NS = 3 * MS
PERIOD_NS = 10 * MS
GAP_NS = WIRE_NS + REPLY_TIME_NS


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(1, 12), st.booleans(), st.booleans()), max_size=200))
def test_each_period_has_its_line_or_an_early_one_and_no_traffic_makes_more(
    wakes: list[tuple[int, bool, bool]],
) -> None:
    pace, now_ns, due_ns, periods = Pace(WIRE_NS, PERIOD_NS), 0, PERIOD_NS, 0
    lines: list[int] = []
    early = False
    for wait_ms, news, blocked in wakes:
        now_ns += wait_ms * MS
        expired = max(0, (now_ns - due_ns) // PERIOD_NS + 1)
        due_ns += expired * PERIOD_NS
        periods += expired
        tick = expired > 0 and pace.period_ended(expired - 1)
        if expired:
            # An early line takes the place of the periodic one, but not if it did not leave.
            assert tick == (expired > 1 or not early)
            early = False
        sent_ns = lines[-1] if lines else -GAP_NS
        due = tick or (news and pace.at_once(now_ns, sent_ns))
        assert tick or not due or now_ns - sent_ns >= GAP_NS
        sent = due and not blocked and (not lines or now_ns - lines[-1] >= WIRE_NS)
        lines += [now_ns] * sent
        early |= sent and not tick
        pace.record_step(tick, due, sent, news, news, lines[-1] if lines else -GAP_NS)
        retry_ns = pace.retry_ns
        assert retry_ns is None or retry_ns > now_ns
    assert len(lines) <= periods + 1
    assert all(after - before >= WIRE_NS for before, after in pairwise(lines))
