"""Describes a recording in words, for the summary, the notes and two tables of a report."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import NamedTuple

from msgspec import Struct

from acsard.core.config.live import flat
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.validation import show
from acsard.core.formatting import lasting, listed, many
from acsard.recording.timeline import INCIDENT_WORDS
from acsard.report.report_data import Mark, ReportData

Clock = Callable[[float, bool], str]  # local time of s since 1970, and whether with the date

MAX_REASONS = 8  # of why sources did not drive

MAX_POINT_S = 0.05  # a coarser picture gets a note

MAX_NAMES = 5  # in one sentence


class Origin(Struct, frozen=True):
    file: str
    robot: str
    version: str  # of acsard
    python: str
    notes: tuple[str, ...] = ()  # for example about missing parts


class Setting(NamedTuple):
    """A setting that differs from its default, as texts."""

    key: str
    here: str  # "-" if it is missing
    default: str  # "-" if it is missing


# Events in which the board stopped the robot.
BOARD_STOPS = ("emergency_stop", "bumper_pressed", "battery_stop")


def differences(config: Config) -> list[Setting]:
    """Return the settings that differ from their defaults, all of an unmatched source."""
    here, default = (dict(flat(effective(each))) for each in (config, Config()))
    return [
        Setting(key, _cell_text(here, key), _cell_text(default, key))
        for key in {**default, **here}
        if key not in here or key not in default or _plain(here[key]) != _plain(default[key])
    ]


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _cell_text(table: dict[str, object], key: str) -> str:
    return show(table[key]) if key in table else "-"


def summary(data: ReportData) -> str:
    """Return how far and fast the robot drove, and its incidents, in two sentences."""
    fast, counts = data.fastest, data.marks.counts
    driving_s = sum(driven.seconds for driven in data.driven.values())
    drive = (
        f"The robot drove {data.metres:.2f} m in {lasting(driving_s)} of {lasting(data.seconds)}, "
        f"at most {fast.linear:.2f} m/s and {fast.angular:.2f} rad/s."
        if driving_s
        else f"The robot did not drive in the recorded {lasting(data.seconds)}."
    )
    stops = many(counts["stop"], "stop")
    by = _names([mark for mark in data.marks.all() if mark.name == "stop"])
    be = "was" if counts["fault"] == 1 else "were"
    faults = many(counts["fault"], "fault")
    for name in BOARD_STOPS:
        by += f", {many(counts[name], INCIDENT_WORDS[name])}" if counts[name] else ""
    lost = counts["link_down"] + counts["link_stale"]
    link = f", {many(lost, 'loss', 'losses')} of the link to the board" if lost else ""
    late = counts["link_late"]
    link += f", {many(late, 'stall')} of the robot's computer" if late else ""
    return f"{drive} There {be} {faults}, {stops}{by}{link}."


def _names(marks: list[Mark]) -> str:
    names = list(dict.fromkeys(mark.by for mark in marks if mark.by))
    return f" (by {listed(names, MAX_NAMES)})" if names else ""


def reasons(data: ReportData) -> list[tuple[str, str, str, float]]:
    """Return source, state, reason and s of why sources did not drive, the longest first.

    Reasons with the same code share a row.
    """
    durations: dict[tuple[str, str, str], dict[str, float]] = {}
    for name, band in data.sources.bands.items():
        for span in band.spans():
            if span.kind != "drives":
                seconds = durations.setdefault((name, span.kind, span.code), defaultdict(float))
                seconds[span.words] += span.end - span.begin
    table_rows = [
        (name, state, max(seconds, key=seconds.__getitem__), math.fsum(seconds.values()))
        for (name, state, _), seconds in durations.items()
    ]
    return sorted(table_rows, key=lambda row: -row[3])[:MAX_REASONS]


def _first_of_each(marks: list[Mark], clock: Clock) -> str:
    first: dict[str, Mark] = {}
    for mark in marks:
        first.setdefault(mark.text, mark)
    texts = [f"{clock(mark.seconds, False)} {mark.text}" for mark in first.values()]
    return listed(texts, MAX_NAMES, "; ")


def notes(data: ReportData, origin: Origin) -> list[str]:
    """Return the notes of `origin`, and on missing steps, the clock and the resolution."""
    texts = list(origin.notes)
    if data.missing:
        texts.append(
            f"{many(data.missing, 'step is', 'steps are')} missing: after the missing steps, the "
            "commanded and limited speeds, and the reasons why sources wait, may be wrong."
        )
    if data.marks.counts["clock"]:
        texts.append(
            "The clock of the robot's computer was set during this recording. In the list of "
            "events, each time is the clock's time at that event. The time axes of the pictures "
            "begin with the clock's time and ignore the later change."
        )
    curves = [*data.linear.values(), *data.angular.values()]
    width = max(curve.width for curve in curves)
    if width > MAX_POINT_S:
        texts.append(
            f"Each point of a picture covers up to {width:.2g} s, and shows the lowest and the "
            "highest value in that time. To see more detail, choose a shorter time with --from and "
            "--to."
        )
    return texts


def rows(data: ReportData, origin: Origin, clock: Clock) -> Iterator[tuple[str, str]]:
    """Yield the label and the content of each row of the summary."""
    began, config = data.began or 0.0, data.config
    yield "When", f"{clock(began, True)} to {clock(data.ended, True)}"
    yield "Duration", f"{lasting(data.seconds)}, {data.steps} steps"
    yield "Distance", f"{data.metres:.2f} m, the sum of forward and backward driving"
    fast = data.fastest
    yield "Top speed", f"{fast.linear:.2f} m/s, {fast.angular:.2f} rad/s (measured)"
    drivers = [
        f"{name} {driven.metres:.2f} m in {lasting(driven.seconds)}"
        for name, driven in data.driven.items()
    ]
    yield "Driven by", ", ".join(drivers) or "no source"
    for name in ("fault", "stop", *BOARD_STOPS):
        marks = [mark for mark in data.marks.all() if mark.name == name]
        count = data.marks.counts[name]
        # Few boards can report the events in `BOARD_STOPS`. Such an event has a row only if it
        # happened.
        if count or name not in BOARD_STOPS:
            title = f"{INCIDENT_WORDS[name].capitalize()}s"
            yield title, f"{count}: {_first_of_each(marks, clock)}" if count else "none"
    lines = data.serial
    # If `reply_period` is set, the board reports by its own clock and answers no line.
    good, lost = "reports received", ""
    if not config.mcu.reply_period:
        good, lost = "answers", f", {lines.unanswered.total} sent lines without an answer"
    yield (
        "Serial line",
        f"{lines.sent.total} lines sent, {lines.good.total} {good}, "
        f"{lines.dropped.total} dropped{lost}",
    )
    lateness = data.lateness
    yield (
        "Control loop",
        f"{config.rate_hz:g} Hz, at most {lateness.most_ms:.1f} ms late, "
        f"{many(lateness.missed, 'period')} missed",
    )
    simulated = " on the simulator" if config.mcu.simulated else f" on {config.mcu.port}"
    yield "Robot", f"{origin.robot}{simulated}"
    yield "Recorded by", f"acsard {origin.version}, Python {origin.python}"
    yield "File", origin.file
