"""Thinning shortens long series of values and keeps the extremes that a person looks for."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.thinning import Band, Curve, Place, Point, Track


def test_a_short_curve_is_not_thinned() -> None:
    curve = Curve()
    values = [Point(n / 100, math.sin(n)) for n in range(1500)]
    for point in values:
        curve.add(*point)
    assert curve.points() == values


def test_thinning_a_long_curve_keeps_its_only_peak() -> None:
    curve, peak = Curve(most=200), 37_777
    for n in range(60_000):
        curve.add(n / 100, 9.0 if n == peak else -7.0 if n == peak + 1 else 0.0)
    points = curve.points()
    assert len(points) <= 400
    assert Point(peak / 100, 9.0) in points
    assert Point((peak + 1) / 100, -7.0) in points
    assert points[0].t == 0.0
    assert [point.t for point in points] == sorted(point.t for point in points)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60), st.integers(2, 20))
def test_thinning_keeps_the_lowest_and_highest_value_of_any_curve(
    values: list[float], most: int
) -> None:
    curve = Curve(most)
    for n, value in enumerate(values):
        curve.add(n * 0.37, value)
    drawn = [point.value for point in curve.points()]
    assert (min(drawn), max(drawn)) == (min(values), max(values))
    assert len(drawn) <= 2 * most


def test_missing_and_infinite_values_break_the_curve() -> None:
    curve = Curve()
    for t, value in ((0.0, 1.0), (0.1, None), (0.2, math.inf), (0.3, 2.0)):
        curve.add(t, value)
    first, gap, last = curve.points()
    assert (first, last) == (Point(0.0, 1.0), Point(0.3, 2.0))
    assert math.isnan(gap.value)


def test_a_long_gap_remains_one_gap_after_thinning() -> None:
    curve = Curve(most=20)
    for n in range(1000):
        curve.add(n / 10, None if 400 <= n < 600 else 1.0)
    points = curve.points()
    (gap,) = [at for at, point in enumerate(points) if math.isnan(point.value)]
    assert points[gap - 1].t < 40.0
    assert points[gap + 1].t >= 60.0


def test_a_band_reports_the_begin_and_end_of_each_span() -> None:
    band = Band(("fault", "driving"))
    for t, kind in (
        (0.0, "driving"),
        (1.0, "driving"),
        (2.0, "fault"),
        (3.0, ""),
        (5.0, "driving"),
    ):
        band.add(t, kind, kind and f"by {kind}")
    band.end(6.0)
    assert [span[:3] for span in band.spans()] == [
        (0.0, 2.0, "driving"), (2.0, 3.0, "fault"), (5.0, 6.0, "driving"),
    ]  # fmt: skip


def test_thinning_too_many_spans_keeps_the_most_severe_kind() -> None:
    band = Band(("fault", "driving", "ready"), most=30)
    for n in range(3000):
        band.add(n / 10, "fault" if n == 1234 else "driving" if n % 2 else "ready")
    band.end(300.0)
    spans = band.spans()
    assert len(spans) <= 30
    (fault,) = [span for span in spans if span.kind == "fault"]
    assert fault.begin <= 123.4 < fault.end
    assert (spans[0].begin, spans[-1].end) == (0.0, 300.0)


def test_a_band_refuses_to_keep_fewer_than_two_spans() -> None:
    with pytest.raises(ValueError, match="at least 2 spans, not 1"):
        Band(["fault"], most=1)


def test_every_place_of_a_thinned_path_is_near_a_kept_place() -> None:
    dice, track = random.Random(1), Track(most=100)
    x = y = 0.0
    driven = []
    for n in range(5000):
        x, y = x + dice.uniform(-0.01, 0.02), y + dice.uniform(-0.02, 0.02)
        driven.append(Place(n / 100, x, y, 0.0))
        track.add(driven[-1])
    places = track.places()
    assert len(places) <= 101
    assert (places[0], places[-1]) == (driven[0], driven[-1])
    away = [min(math.hypot(p.x - k.x, p.y - k.y) for k in places) for p in driven[::50]]
    assert max(away) <= 2 * track.stride


def test_thinning_a_path_keeps_a_jump_of_the_pose() -> None:
    track = Track(most=50)
    for n in range(1000):
        track.add(Place(n / 100, n / 100 + (5.0 if n >= 500 else 0.0), 0.0, 0.0, new=n == 500))
    (jump,) = [place for place in track.places() if place.new]
    assert jump.x >= 10.0


def test_the_path_of_a_robot_at_rest_is_one_place() -> None:
    track = Track()
    for n in range(1000):
        track.add(Place(n / 10, 1.0, 2.0, 0.0))
    assert {place[1:3] for place in track.places()} == {(1.0, 2.0)}
    assert len(track.places()) <= 2


def test_a_path_of_the_last_minutes_forgets_older_places() -> None:
    track = Track(most=100, stride=0.02, lasts=10.0)
    for n in range(1001):
        track.add(Place(n / 10, n / 100, 0.0, 0.0))
    places = track.places()
    assert len(places) <= 101
    assert places[0].t == pytest.approx(90.0, abs=0.5)
    assert places[-1].t == 100.0


def test_an_impossibly_long_step_restarts_the_path() -> None:
    track = Track(jump=1.0)
    for n in range(10):
        track.add(Place(n / 10, 0.1 * n, 0.0, 0.0))
    track.add(Place(1.0, 50.0, 0.0, 0.0))
    assert track.places() == [Place(1.0, 50.0, 0.0, 0.0)]
