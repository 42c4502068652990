"""The times that a person types for --from and --to."""

from __future__ import annotations

from datetime import datetime

import pytest

from acsard.cli.time_range import TimeError, time_range
from acsard.core.values import NS_PER_S

NOW = datetime(2026, 11, 23, 15, 30)


def at(day: int, hours: int = 0, minutes: int = 0, seconds: float = 0.0) -> int:
    moment = datetime(2026, 11, day, hours, minutes).timestamp() + seconds
    return round(moment * NS_PER_S)


@pytest.mark.parametrize(
    ("text", "begin_ns", "end_ns"),
    [
        ("14:05", at(23, 14, 5), at(23, 14, 5)),
        ("15:30", at(23, 15, 30), at(23, 15, 30)),  # now, not yesterday
        ("23:59:59.5", at(22, 23, 59, 59.5), at(22, 23, 59, 59.5)),
        ("yesterday 14:05", at(22, 14, 5), at(22, 14, 5)),
        ("today 14:05:30", at(23, 14, 5, 30.0), at(23, 14, 5, 30.0)),
        ("today", at(23), at(24)),
        ("yesterday", at(22), at(23)),
        ("2026-11-21", at(21), at(22)),
        ("2026-11-21 14:05", at(21, 14, 5), at(21, 14, 5)),
        ("2026-11-21T14:05:30", at(21, 14, 5, 30.0), at(21, 14, 5, 30.0)),
        ("2h", at(23, 13, 30), at(23, 13, 30)),
        ("2 h ago", at(23, 13, 30), at(23, 13, 30)),
        ("90min", at(23, 14), at(23, 14)),
        ("1.5 d ago", at(22, 3, 30), at(22, 3, 30)),
    ],
)
def test_a_time_is_read_as_a_person_writes_it(text: str, begin_ns: int, end_ns: int) -> None:
    assert time_range(text, None, NOW) == (begin_ns, None)
    assert time_range(None, text, NOW) == (None, end_ns)


@pytest.mark.parametrize(
    ("begin", "end", "begin_ns", "end_ns"),
    [
        ("14:05", "14:10", at(23, 14, 5), at(23, 14, 10)),
        ("23:50", "00:10", at(22, 23, 50), at(23, 0, 10)),
        ("2026-11-21", "02:00", at(21), at(21, 2)),
        ("2026-11-21 23:00", "02:00", at(21, 23), at(22, 2)),
        ("14:05", "+5m", at(23, 14, 5), at(23, 14, 10)),
        ("yesterday", "yesterday", at(22), at(23)),
    ],
)
def test_an_end_follows_its_begin(begin: str, end: str, begin_ns: int, end_ns: int) -> None:
    assert time_range(begin, end, NOW) == (begin_ns, end_ns)


@pytest.mark.parametrize(
    "text",
    ["", "noon", "25:00", "2026-02-30", "14:05 today", "+5m", "9" * 9 + "d", "30", "5 y"],
)
def test_a_wrong_time_is_refused_with_examples(text: str) -> None:
    with pytest.raises(TimeError, match=r"write for example 14:05|counts from --from"):
        time_range(text, None, NOW)


@pytest.mark.parametrize("end", ["14:05", "+0s", "2026-11-22"])
def test_an_end_that_is_not_after_its_begin_is_refused(end: str) -> None:
    with pytest.raises(TimeError, match="not after --from"):
        time_range("14:05", end, NOW)
