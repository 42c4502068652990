"""Tests of the times that a person types for --from and --to."""

from __future__ import annotations

import math
import time

import pytest

from acsard.recording.time_span import Moment, Offset, TimeError, TimeOfDay, parse_when, resolve

NOW = time.mktime((2026, 11, 23, 15, 30, 0, 0, 0, -1))


def at(day: int, hours: int = 0, minutes: int = 0, seconds: float = 0.0) -> float:
    return time.mktime((2026, 11, day, hours, minutes, 0, 0, 0, -1)) + seconds


def moment(seconds: float) -> Moment:
    return Moment(seconds, seconds)


@pytest.mark.parametrize(
    ("text", "when"),
    [
        ("12.5", Offset(12.5)),
        ("14:05", TimeOfDay(14, 5, 0.0)),
        ("23:59:59.5", TimeOfDay(23, 59, 59.5)),
        ("yesterday 14:05", moment(at(22, 14, 5))),
        ("Today 14:05:30", moment(at(23, 14, 5, 30.0))),
        ("yesterday", Moment(at(22), at(23))),
        ("2026-11-21", Moment(at(21), at(22))),
        ("2026-11-21 14:05", moment(at(21, 14, 5))),
        ("2026-11-21T14:05:30", moment(at(21, 14, 5, 30.0))),
        ("2 h ago", moment(at(23, 13, 30))),
        ("2 hours ago", moment(at(23, 13, 30))),
        ("90min ago", moment(at(23, 14, 0))),
        ("1 d ago", moment(at(22, 15, 30))),
        ("99999999999999 h ago", moment(0.0)),
        ("9" * 400 + " h ago", moment(0.0)),
    ],
)
def test_a_time_is_read_as_a_person_writes_it(text: str, when: object) -> None:
    assert parse_when(text, NOW) == when


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("25:00", "25:00 is not a time of day: a day goes from 00:00 to 23:59:59; write for "),
        ("14:60", "14:60 is not a time of day"),
        ("yesterday 24:00", "24:00 is not a time of day"),
        ("2026-02-30", "2026-02-30 is not a date: the calendar has no such day"),
        ("2026-11-21 25:00", "25:00 is not a time of day"),
        ("late", "late is not a time; write for example 14:05, "),
        ("14:05 yesterday", "14:05 yesterday is not a time"),
        ("-1", "-1 is not a time"),
        ("2 h", "2 h is not a time"),
        ("", "is not a time"),
    ],
)
def test_a_text_that_is_not_a_time_is_refused_with_examples(text: str, words: str) -> None:
    with pytest.raises(TimeError) as error:
        parse_when(text, NOW)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("begin", "end", "span"),
    [
        ("14:05", None, (at(23, 14, 5), math.inf)),
        ("16:00", None, (at(22, 16), math.inf)),
        (None, "16:00", (-math.inf, at(22, 16))),
        ("15:00", "16:00", (at(23, 15), at(23, 16))),
        ("23:50", "00:10", (at(22, 23, 50), at(23, 0, 10))),
        ("16:00", "today", (at(22, 16), at(24))),
        ("00:00", "yesterday", (at(22), at(23))),
        ("14:05", "yesterday 15:00", (at(22, 14, 5), at(22, 15))),
        ("yesterday 23:00", "01:00", (at(22, 23), at(23, 1))),
        ("yesterday", "yesterday", (at(22), at(23))),
        (None, None, (-math.inf, math.inf)),
    ],
)
def test_a_time_of_day_is_its_most_recent_occurrence_and_a_range_goes_forward(
    begin: str | None, end: str | None, span: tuple[float, float]
) -> None:
    first, last = (None if text is None else parse_when(text, NOW) for text in (begin, end))
    assert resolve(first, last, NOW) == span


def test_a_range_that_ends_before_it_begins_is_refused() -> None:
    first, last = parse_when("1 h ago", NOW), parse_when("2 h ago", NOW)
    with pytest.raises(TimeError, match=r"--from is .* 14:30:00, which is after --to, .* 13:30:00"):
        resolve(first, last, NOW)
