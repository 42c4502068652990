"""Containers that store long curves, bands and paths in bounded memory.

A curve is a value over time, a band a state over time, a path a series of poses. Times are in s and
never decrease. A full container halves its resolution; a curve keeps every peak.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

MAX_BINS = 1500  # time intervals of a curve: twice the width of a picture in pixels

FIRST_WIDTH = 0.001  # s, shorter than the robot's steps: a short recording is not thinned

MAX_SPANS = 1500

MAX_PLACES = 4000

FIRST_STRIDE = 0.001  # m between places of a new path; doubles when it is full


class Point(NamedTuple):
    t: float
    value: float


class _Bin(NamedTuple):
    number: int
    low: Point
    high: Point
    breaks: bool = False  # a gap follows


class Curve:
    """A value over time; each interval (bin) keeps its lowest and highest value."""

    def __init__(self, most: int = MAX_BINS) -> None:
        self._most, self._bins = most, list[_Bin]()
        self.width = FIRST_WIDTH  # of a bin, s; doubles when there are too many

    def add(self, t: float, value: float | None) -> None:
        """Add a value at `t`, s; None, NaN and inf are a gap."""
        bins = self._bins
        if value is None or not math.isfinite(value):
            if bins:
                bins[-1] = bins[-1]._replace(breaks=True)
            return
        number, point = int(t / self.width), Point(t, value)
        if bins and bins[-1].number == number:
            _, low, high, breaks = bins[-1]
            if breaks or not low.value <= value <= high.value:
                bins[-1] = _merged(bins[-1], _Bin(number, point, point))
            return
        bins.append(_Bin(number, point, point))
        while len(bins) > self._most:
            self.width *= 2
            self._bins = bins = list(_halved(bins))

    def points(self) -> list[Point]:
        """Return the points to draw, in order; NaN is a gap."""
        points: list[Point] = []
        for _, low, high, breaks in self._bins:
            points += [low] if low == high else sorted((low, high))
            if breaks:
                points.append(Point(points[-1].t, math.nan))
        return points


def _merged(first: _Bin, other: _Bin) -> _Bin:
    # A gap between them would be too short to see.
    low = other.low if other.low.value < first.low.value else first.low
    high = other.high if other.high.value > first.high.value else first.high
    return _Bin(first.number, low, high, other.breaks)


def _halved(bins: list[_Bin]) -> Iterator[_Bin]:
    last: _Bin | None = None
    for current in bins:
        wide = current._replace(number=current.number // 2)
        if last is not None and last.number != wide.number:
            yield last
            last = wide
        else:
            last = wide if last is None else _merged(last, wide)
    if last is not None:
        yield last


class Span(NamedTuple):
    """A time in which the state is `kind`, in s, with its reason in words and its code."""

    begin: float
    end: float
    kind: str
    words: str
    code: str = ""


class Band:
    """A state over time; short spans merge with neighbors if there are too many."""

    def __init__(self, ranks: Sequence[str], most: int = MAX_SPANS) -> None:
        # `ranks` are the kinds, the most important first, which wins a merge. Raises `ValueError`.
        if most < 2:
            raise ValueError(f"a band must keep at least 2 spans, not {most}")
        self._rank = {kind: at for at, kind in enumerate(ranks)}
        self._most, self._least = most, FIRST_WIDTH
        self._spans: list[Span] = []

    def add(self, t: float, kind: str, words: str = "", code: str = "") -> None:
        """Record that the state is `kind` from `t` s on ("": none), for a reason."""
        spans = self._spans
        if spans:
            last = spans[-1] = spans[-1]._replace(end=max(t, spans[-1].end))
            if (last.kind, last.words) == (kind, words):
                return
        spans.append(Span(t, t, kind, words, code))
        while len(spans) > self._most:
            self._least *= 2
            self._spans = spans = self._wider(spans)

    def end(self, t: float) -> None:
        """End the last span at `t`, s."""
        self.add(t, "")

    def spans(self) -> list[Span]:
        """Return the spans in order, without times of no state."""
        return [span for span in self._spans if span.kind]

    def _wider(self, spans: list[Span]) -> list[Span]:
        wide_spans: list[Span] = []
        for span in spans[:-1]:
            last = wide_spans[-1] if wide_spans else None
            short = last is not None and last.end - last.begin < self._least
            if last is not None and (short or span.end - span.begin < self._least):
                worse = min(last, span, key=lambda item: self._rank.get(item.kind, len(self._rank)))
                wide_spans[-1] = worse._replace(begin=last.begin, end=span.end)
            else:
                wide_spans.append(span)
        return [*wide_spans, spans[-1]]


class Place(NamedTuple):
    """A pose in the frame odom, m and rad, at `t`, s; `new` if it was not driven to."""

    t: float
    x: float
    y: float
    yaw: float
    new: bool = False


class Track:
    """A path that keeps some of its places.

    A dropped place is less than `2 * self.stride` m from a kept one, unless it is too old or before
    a jump.
    """

    def __init__(
        self,
        most: int = MAX_PLACES,
        stride: float = FIRST_STRIDE,
        lasts: float = math.inf,
        jump: float = math.inf,
    ) -> None:
        # `most` places, `stride` m apart at first, for `lasts` s. A step over `jump` m drops all
        # earlier ones.
        self._most, self._lasts, self._jump = most, lasts, jump
        self._kept = deque[Place]()
        self.stride = stride
        self._last: Place | None = None

    def add(self, place: Place) -> None:
        places, last = self._kept, self._last
        self._last = place
        if last is not None and _apart(last, place) > self._jump:
            places.clear()
        while places and place.t - places[0].t > self._lasts:
            places.popleft()
        if places and not place.new and _apart(places[-1], place) < self.stride:
            return
        places.append(place)
        while len(places) > self._most:
            self.stride *= 2
            self._kept = places = self._wider(places)

    def places(self) -> list[Place]:
        """Return the kept places in the order of time, with the newest."""
        last = self._last
        return [*self._kept, *([last] if last and last != self._kept[-1] else [])]

    def _wider(self, places: deque[Place]) -> deque[Place]:
        new_places, broken = deque([places[0]]), False
        for place in islice(places, 1, None):
            broken = broken or place.new
            if _apart(new_places[-1], place) >= self.stride:
                new_places.append(place._replace(new=broken))
                broken = False
        return new_places


def _apart(place: Place, other: Place) -> float:
    return math.hypot(place.x - other.x, place.y - other.y)
