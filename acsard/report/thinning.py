"""Long rows of numbers kept short as they come: no peak is lost, and no more room is taken.

Time is in s since the first step, and does not go back. Each of these holds a bounded number of
entries; when there is one more, what lies close together becomes one, twice as wide as before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

MOST_BINS = 1500
"""Of a curve: two for each pixel that a picture has across."""

FIRST_WIDTH = 0.001
"""s; finer than the steps: a short recording is kept as it is."""

MOST_SPANS = 1500

MOST_PLACES = 4000

FIRST_STRIDE = 0.001
"""m"""


class Point(NamedTuple):
    t: float
    value: float


class _Bin(NamedTuple):
    number: int
    low: Point
    high: Point
    breaks: bool = False
    """There is no value after these."""


class Curve:
    """A value over time: of each bin the lowest and the highest, and when those were."""

    def __init__(self, most: int = MOST_BINS) -> None:
        self._most, self._bins = most, list[_Bin]()
        self.width = FIRST_WIDTH
        """s of one bin."""

    def add(self, t: float, value: float | None) -> None:
        """The value at `t`; None (or what is no number) is none, and breaks the line."""
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
        """What to draw, in order; a value that is NaN is a break."""
        found: list[Point] = []
        for _, low, high, breaks in self._bins:
            found += [low] if low == high else sorted((low, high))
            if breaks:
                found.append(Point(found[-1].t, math.nan))
        return found


def _merged(one: _Bin, other: _Bin) -> _Bin:
    """Both in one; a break between them is too short to be seen."""
    low = other.low if other.low.value < one.low.value else one.low
    high = other.high if other.high.value > one.high.value else one.high
    return _Bin(one.number, low, high, other.breaks)


def _halved(bins: list[_Bin]) -> Iterator[_Bin]:
    last: _Bin | None = None
    for one in bins:
        wide = one._replace(number=one.number // 2)
        if last is not None and last.number != wide.number:
            yield last
            last = wide
        else:
            last = wide if last is None else _merged(last, wide)
    if last is not None:
        yield last


class Span(NamedTuple):
    """From `begin` to `end` it was of this kind, for the reason in `words`."""

    begin: float
    end: float
    kind: str
    words: str


class Band:
    """What something was, over time; the shortest spans give way to their neighbours."""

    def __init__(self, ranks: Sequence[str], most: int = MOST_SPANS) -> None:
        """`ranks`: the kinds, those first that must not be lost where several become one."""
        self._rank = {kind: at for at, kind in enumerate(ranks)}
        self._most, self._least = most, FIRST_WIDTH
        self._spans: list[Span] = []

    def add(self, t: float, kind: str, words: str = "") -> None:
        """It is so from now on; kind "" is nothing."""
        spans = self._spans
        if spans:
            last = spans[-1] = spans[-1]._replace(end=max(t, spans[-1].end))
            if (last.kind, last.words) == (kind, words):
                return
        spans.append(Span(t, t, kind, words))
        while len(spans) > self._most:
            self._least *= 2
            self._spans = spans = self._wider(spans)

    def end(self, t: float) -> None:
        """Nothing is known after this."""
        self.add(t, "")

    def spans(self) -> list[Span]:
        """All of a kind, in order."""
        return [span for span in self._spans if span.kind]

    def _wider(self, spans: list[Span]) -> list[Span]:
        found: list[Span] = []
        for span in spans[:-1]:
            last = found[-1] if found else None
            short = last is not None and last.end - last.begin < self._least
            if last is not None and (short or span.end - span.begin < self._least):
                worse = min(last, span, key=lambda one: self._rank.get(one.kind, len(self._rank)))
                found[-1] = worse._replace(begin=last.begin, end=span.end)
            else:
                found.append(span)
        return [*found, spans[-1]]


class Place(NamedTuple):
    """m and rad in odom; `new` where it did not drive to here from the place before."""

    t: float
    x: float
    y: float
    yaw: float
    new: bool = False


class Track:
    """A path: no place of it is further than `stride` m from one that is kept."""

    def __init__(self, most: int = MOST_PLACES) -> None:
        self._most, self._kept = most, list[Place]()
        self.stride = FIRST_STRIDE
        self._last: Place | None = None

    def add(self, place: Place) -> None:
        """The next place."""
        self._last = place
        kept = self._kept
        if kept and not place.new and not self._far(kept[-1], place):
            return
        kept.append(place)
        while len(kept) > self._most:
            self.stride *= 2
            self._kept = kept = self._wider(kept)

    def places(self) -> list[Place]:
        """What to draw, in order: the first and the last place are among them."""
        last = self._last
        return [*self._kept, *([last] if last and last != self._kept[-1] else [])]

    def _far(self, one: Place, other: Place) -> bool:
        return math.hypot(one.x - other.x, one.y - other.y) >= self.stride

    def _wider(self, places: list[Place]) -> list[Place]:
        found, broken = places[:1], False
        for place in places[1:]:
            broken = broken or place.new
            if self._far(found[-1], place):
                found.append(place._replace(new=broken))
                broken = False
        return found
