"""Describes a recording in words: the summary of a report and the table below it."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import NamedTuple

from msgspec import Struct

from acsard.core.config.live import flat
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.validation import show
from acsard.core.formatting import lasting, listed, many
from acsard.report.course import Course, Mark

Clock = Callable[[float, bool], str]
"""Formats a time in s since 1970 as local time, with the date if the second argument is true."""

MOST_REASONS = 8

NUMBER = re.compile(r"\d+(\.\d+)?")

MOST_NAMES = 5
"""Maximum number of names or different texts in a list."""


class Origin(Struct, frozen=True):
    """Source of the recording."""

    file: str
    robot: str
    version: str
    """Version of the acsard that made the recording."""
    python: str
    notes: tuple[str, ...] = ()
    """Notes about missing parts of the recording, in words."""


class Setting(NamedTuple):
    key: str
    here: str
    default: str


def differences(config: Config) -> list[Setting]:
    """Return the settings that differ from their defaults.

    A source that was added or removed appears with all its keys.
    """
    here, default = (dict(flat(effective(one))) for one in (config, Config()))
    return [
        Setting(key, _shown(here, key), _shown(default, key))
        for key in {**default, **here}
        if key not in here or key not in default or _plain(here[key]) != _plain(default[key])
    ]


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _shown(table: dict[str, object], key: str) -> str:
    return show(table[key]) if key in table else "-"


def summary(course: Course) -> str:
    """Return the course of events in two or three sentences."""
    fast, counts = course.fastest, course.marks.counts
    drove = sum(one.seconds for one in course.driven.values())
    way = (
        f"The robot drove {course.metres:.2f} m in {lasting(drove)} of {lasting(course.seconds)}, "
        f"at most {fast.linear:.2f} m/s and {fast.angular:.2f} rad/s."
        if drove
        else f"The robot did not drive in these {lasting(course.seconds)}."
    )
    stops = many(counts["stop"], "stop")
    by = _names([mark for mark in course.marks.all() if mark.name == "stop"])
    faults = many(counts["fault"], "fault")
    lost = counts["link_down"] + counts["link_stale"]
    link = f", {many(lost, 'loss', 'losses')} of the link" if lost else ""
    late = counts["link_late"]
    link += f", {many(late, 'stall')} of the robot's computer" if late else ""
    be = "was" if counts["fault"] == 1 else "were"
    return f"{way} There {be} {faults}, {stops}{by}{link}."


def _names(marks: list[Mark]) -> str:
    names = list(dict.fromkeys(mark.by for mark in marks if mark.by))
    if not names:
        return ""
    return f" (by {listed(names, MOST_NAMES)})"


def reasons(course: Course) -> list[tuple[str, str, str, float]]:
    """Return source, state, reason and duration in s of the times that a source did not drive.

    The longest come first, at most `MOST_REASONS`. Sentences that differ only in numbers count as
    one, represented by the one that lasted longest.
    """
    found: dict[tuple[str, str, str], dict[str, float]] = {}
    for name, band in course.sources.bands.items():
        for span in band.spans():
            if span.kind != "drives":
                alike = NUMBER.sub("#", span.words)
                seconds = found.setdefault((name, span.kind, alike), defaultdict(float))
                seconds[span.words] += span.end - span.begin
    told = [
        (name, does, max(each, key=each.__getitem__), math.fsum(each.values()))
        for (name, does, _), each in found.items()
    ]
    return sorted(told, key=lambda one: -one[3])[:MOST_REASONS]


def _first_of_each(marks: list[Mark], began: float, clock: Clock) -> str:
    """Return each distinct text with the time of its first occurrence."""
    first: dict[str, Mark] = {}
    for mark in marks:
        first.setdefault(mark.text, mark)
    told = [f"{clock(began + one.t, False)} {one.text}" for one in first.values()]
    return listed(told, MOST_NAMES, "; ")


def notes(course: Course, origin: Origin) -> list[str]:
    """Return notes about missing steps and about the resolution of the pictures."""
    found = list(origin.notes)
    if course.missing:
        found.append(
            f"{many(course.missing, 'step is', 'steps are')} missing: after them, the "
            "commanded and limited speeds and the reasons of waiting sources may be wrong."
        )
    curves = [*course.linear.values(), *course.angular.values()]
    width = max(curve.width for curve in curves)
    if width > 0.05:
        found.append(
            f"A point of a picture stands for up to {width:.2g} s and shows the lowest and the "
            "highest value of that time. --from and --to draw a shorter time in more detail."
        )
    return found


def rows(course: Course, origin: Origin, clock: Clock) -> Iterator[tuple[str, str]]:
    """Yield the label and the content of each row of the summary table."""
    began, config = course.began or 0.0, course.config
    yield "When", f"{clock(began, True)} to {clock(began + course.seconds, True)}"
    yield "Duration", f"{lasting(course.seconds)}, {course.steps} steps"
    yield "Distance", f"{course.metres:.2f} m, forward and backward"
    fast = course.fastest
    yield "Top speed", f"{fast.linear:.2f} m/s, {fast.angular:.2f} rad/s (measured)"
    driven = [
        f"{name} {one.metres:.2f} m in {lasting(one.seconds)}"
        for name, one in course.driven.items()
    ]
    yield "Driven by", ", ".join(driven) or "no source"
    marks = course.marks.all()
    for name, title in (("fault", "Faults"), ("stop", "Stops")):
        told = [mark for mark in marks if mark.name == name]
        count = course.marks.counts[name]
        yield title, f"{count}: {_first_of_each(told, began, clock)}" if count else "none"
    totals = course.link.totals
    shares = f"{totals.sent} lines sent, {totals.good} answers, {totals.dropped} dropped"
    lost = "" if config.mcu.reply_period else f", {totals.unanswered} without an answer"
    yield "Serial line", shares + lost
    late = course.lateness
    yield (
        "Control loop",
        f"{config.rate_hz:g} Hz, at most {late.most:.1f} ms late, {many(late.missed, 'period')} "
        "missed",
    )
    simulated = " on the simulator" if config.mcu.simulated else f" on {config.mcu.port}"
    yield "Robot", f"{origin.robot}{simulated}"
    yield "Recorded by", f"acsard {origin.version}, Python {origin.python}"
    yield "File", origin.file
