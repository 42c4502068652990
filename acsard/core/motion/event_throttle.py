"""Limits the log lines of one event name to one per second, after a few without a delay.

Each line has the number of events since the last one, so neither a client that floods the bus nor a
loose contact floods the log.
"""

from __future__ import annotations

from operator import itemgetter
from typing import get_args

from msgspec import Struct, field
from msgspec.structs import replace

from acsard.core.throttle import Rate, Throttle
from acsard.core.values import Event, Level, Ns

BURST = 5  # lines of one name without a delay: enough for a person who presses buttons

MAX_LISTED = 8  # kinds of events, and clients; further ones are "others"

LEVELS: tuple[Level, ...] = get_args(Level)


class Held(Struct):
    """Events of one name that wait for their line."""

    last: Event
    count: int = 0
    news: bool = False
    level: int = 0  # the highest, in `LEVELS`
    number: int = 0  # of the newest, in the sequence of all names
    kinds: dict[str, int] = {}
    by: dict[str, int] = {}

    def add(self, event: Event, number: int) -> None:
        self.last, self.number = event, number
        self.count += event.count
        self.news = self.news or event.news
        self.level = max(self.level, LEVELS.index(event.level))
        _count(self.kinds, event.kind, event.count)
        _count(self.by, event.by, event.count)

    def line(self) -> Event:
        last, what = self.last, _numbered(self.kinds)
        if self.count > 1 and not what:
            what = f"{self.count} times"
        if self.count > last.count and last.text:
            what = f"{what}; the last"
        text = ": ".join(part for part in (what, last.text) if part)
        level, by = LEVELS[self.level], ", ".join(self.by)
        kind = what if self.count > 1 else ""
        return replace(
            last, text=text, level=level, by=by, kind=kind, count=self.count, news=self.news
        )


class EventThrottle(Struct):
    """Decides which events are logged now, and keeps the events that must wait."""

    held: dict[str, Held] = {}  # by name
    number: int = 0  # of events of all names
    rates: Throttle = field(default_factory=Throttle)  # of the lines, by name

    def lines(self, events: list[Event], now_ns: Ns) -> tuple[Event, ...]:
        """Return the events to log now, which may stand for several of the same name."""
        if not (events or self.held):
            return ()
        for event in events:
            self.number += 1
            self.held.setdefault(event.name, Held(event)).add(event, self.number)
        # The burst is for news, and for each stop, whose time matters.
        due_names = [
            name
            for name, group in self.held.items()
            if self.rates.take(
                now_ns, Rate(1.0, BURST if group.news or name == "stop" else 1), name
            )
        ]
        if "stop" in due_names or "clear" in due_names:
            # A stop and a `clear` stay in order: the end of the log shows whether the robot stands.
            due_names += [
                name for name in ("stop", "clear") if name in self.held and name not in due_names
            ]
            due_names.sort(key=lambda name: self.held[name].number)
        return tuple([self.held.pop(name).line() for name in due_names])


def merge(before: Event, line: Event) -> Event:
    """Return one line for two of the same name: all events, the higher level, the later text."""
    count = before.count + line.count
    last = line.text.removeprefix(f"{line.kind}: ")
    level = max(before.level, line.level, key=LEVELS.index)
    names = dict.fromkeys(filter(None, [*before.by.split(", "), *line.by.split(", ")]))
    by = [name for name in names if name != "others"]
    more = ["others"] if len(by) > MAX_LISTED or "others" in names else []
    kind = f"{count} times; the last"
    text, by_text = f"{kind}: {last}", ", ".join(by[:MAX_LISTED] + more)
    return replace(line, text=text, level=level, by=by_text, kind=kind, count=count, news=False)


def _count(counts: dict[str, int], what: str, times: int) -> None:
    if what:
        name = what if what in counts or len(counts) < MAX_LISTED else "others"
        counts[name] = counts.get(name, 0) + times


def _numbered(counts: dict[str, int]) -> str:
    if sum(counts.values()) == 1:
        return next(iter(counts))
    by_count = sorted(counts.items(), key=itemgetter(1), reverse=True)
    return ", ".join(f"{times} x {what}" for what, times in by_count)
