"""`utc` agrees with the calendar of the standard library."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.utc_text import utc
from acsard.core.values import NS_PER_S


@pytest.mark.parametrize(
    ("wall_ns", "text"),
    [
        (0, "1970-01-01 00:00:00 UTC"),
        (-1, "1969-12-31 23:59:59 UTC"),
        (1_795_352_707 * NS_PER_S + 999_999_999, "2026-11-22 13:05:07 UTC"),
        (951_782_400 * NS_PER_S, "2000-02-29 00:00:00 UTC"),
        (951_868_800 * NS_PER_S, "2000-03-01 00:00:00 UTC"),
    ],
)
def test_a_time_is_written_as_date_and_time_in_utc(wall_ns: int, text: str) -> None:
    assert utc(wall_ns) == text


@given(st.datetimes(timezones=st.just(UTC)))
def test_every_date_agrees_with_the_calendar(at: datetime) -> None:
    seconds = int((at - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() // 1)
    assert utc(seconds * NS_PER_S) == f"{at:%Y-%m-%d %H:%M:%S} UTC".rjust(23, "0")
