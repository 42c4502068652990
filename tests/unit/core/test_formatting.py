"""Text from unknown senders is made harmless, and all messages format values in the same way."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.formatting import (
    json_line,
    lasting,
    lines,
    listed,
    many,
    printable,
    printable_bytes,
    rough,
    signed,
    utc,
)
from acsard.core.values import NS_PER_S
from tests.each import each

MOST = 64

HOSTILE = "a\x1b]0;PWNED\x07b\x9b2J\u202ec\r\nd\te"


def test_terminal_control_characters_are_replaced() -> None:
    assert printable(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc  d e"
    assert lines(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc \nd e"
    assert printable("Zürich, 8.5 °C") == "Zürich, 8.5 °C"


@each("data", [bytes(range(256)), b"\r\n", "é→`".encode(), b""])
def test_bytes_are_shown_as_printable_text_of_limited_length(data: bytes) -> None:
    text = printable_bytes(data, MOST)
    assert text.isprintable()
    assert text.removesuffix("…").isascii()
    assert len(text) <= MOST + 1
    assert text.endswith("…") == (len(data) > MOST)


def test_a_long_byte_string_shows_whole_escapes_from_its_start_or_its_end() -> None:
    data = b"\xff" * MOST + b"end"
    assert printable_bytes(data, MOST) == r"\xff" * (MOST // 4) + "…"
    assert printable_bytes(data, MOST, last=True) == "…" + r"\xff" * ((MOST - 3) // 4) + "end"


@given(st.text(alphabet=st.characters(exclude_categories=["Cs"], max_codepoint=0xFFFF)))
def test_printable_json_decodes_to_the_same_value(text: str) -> None:
    line = json_line(json.dumps(text, ensure_ascii=False))
    assert json.loads(line) == text
    assert line.isprintable()


@each(
    ("seconds", "text"),
    [
        (0.0, "0.0 µs"), (63.1e-6, "63 µs"), (999.4e-6, "999 µs"), (999.6e-6, "1.0 ms"),
        (8.9125e-3, "8.9 ms"), (9.949e-3, "9.9 ms"), (9.96e-3, "10 ms"), (0.3328, "333 ms"),
        (2.5, "2.5 s"), (9900.0, "2.8 h"), (1e12, "?"), (-1.0, "?"), (math.nan, "?"),
    ],
)  # fmt: skip
def test_a_short_duration_has_two_digits_in_its_own_unit(seconds: float, text: str) -> None:
    assert rough(seconds, 1e-6) == text


@each(
    ("seconds", "text"),
    [(None, "never"), (math.inf, "never"), (0.04, "0.0 s"), (9.96, "10 s"), (99.4, "99 s"),
     (240.0, "4.0 min"), (7300.0, "2.0 h"), (9e5, "10 d"), (math.nan, "?"), (-1.0, "?")],
)  # fmt: skip
def test_an_age_is_in_seconds_or_larger_units(seconds: float | None, text: str) -> None:
    assert rough(seconds) == text


@given(st.floats(), st.sampled_from([1e-6, 1.0]))
def test_a_rough_duration_never_takes_more_than_7_characters(seconds: float, unit: float) -> None:
    assert len(rough(seconds, unit)) <= 7


@each(
    ("seconds", "text"),
    [
        (0.04, "0 s"), (3.0, "3 s"), (59.94, "59.9 s"), (59.96, "1 min"), (303.0, "5 min 3 s"),
        (3599.7, "1 h"), (3600.0 + 59.0, "1 h"), (7500.0, "2 h 5 min"), (2_592_000.0, "30 d"),
        (2_591_999.0, "29 d 23 h"),
    ],
)  # fmt: skip
def test_a_duration_has_its_two_largest_units(seconds: float, text: str) -> None:
    assert lasting(seconds) == text


@each(
    ("value", "text"),
    [(1.5, "  +1.50"), (-0.001, "  +0.00"), (-2.0, "  -2.00"), (1e12, "  +1e12"),
     (math.inf, "   +inf"), (math.nan, "      -")],
)  # fmt: skip
def test_a_number_is_shown_with_its_sign_in_a_fixed_width(value: float, text: str) -> None:
    assert signed(value, 2, 7) == text


def test_a_count_agrees_with_its_noun() -> None:
    assert [many(count, "line") for count in (0, 1, 2)] == ["no lines", "1 line", "2 lines"]
    assert many(2, "change of commander") == "2 changes of commander"
    assert (many(1, "loss", "losses"), many(2, "loss", "losses")) == ("1 loss", "2 losses")


def test_a_shortened_list_ends_with_the_number_of_omitted_items() -> None:
    assert listed(["a", "b"], 2) == "a, b"
    assert listed(["a", "b", "c", "d"], 2, "; ") == "a; b; and 2 more"


def test_an_unprintable_character_beyond_16_bits_is_escaped_in_json() -> None:
    line = json_line('"\U000e0001\U0001f916"')
    assert line == '"\\udb40\\udc01\U0001f916"'
    assert json.loads(line) == "\U000e0001\U0001f916"


@pytest.mark.parametrize("value", [1000.0, -123456.0, 1e12])
def test_a_number_that_is_too_long_keeps_its_width(value: float) -> None:
    assert len(signed(value, 2, 5)) == 5
    assert float(signed(value, 2, 5)) == pytest.approx(value, rel=0.5)


@each(
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
