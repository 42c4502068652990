"""acsard shows values as text that is correct, bounded in length and safe for a terminal."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from acsard.top.text import bar, clean, count, ends, rate, rule
from acsard.top.text import row as labelled
from tests.each import each


@each(
    ("text", "expected"),
    [
        ("commanded by app", "commanded by app"),
        ("[bold]not markup[/bold] :smile:", "[bold]not markup[/bold] :smile:"),
        ("\x1b[2Jgone", "�[2Jgone"),
        ("\x9b2Jgone", "�2Jgone"),
        ("\x1b]0;title\x07", "�]0;title�"),
        ("two\nlines\tand\rback", "two lines and back"),
        ("over\x08\x7f", "over��"),
        ("right \u202eto left", "right �to left"),
        ("ze\u200bro wi\u0301dth", "ze�ro wi�dth"),
        ("Größe 大", "Größe 大"),
    ],
)
def test_text_from_the_bus_keeps_only_printable_characters(text: str, expected: str) -> None:
    assert clean(text) == expected


@settings(max_examples=30)
@given(st.text(max_size=300))
def test_cleaned_text_is_printable_and_bounded(text: str) -> None:
    assert clean(text).isprintable()
    assert len(clean(text)) <= 256


@each(("number", "text"), [(0, "0"), (1234567, "1,234,567"), (10**30, "1.0e+30"), (-5, "-5")])
def test_a_count_is_readable_however_large(number: int, text: str) -> None:
    assert count(number) == text
    assert len(count(number**1000)) < 15


@each(
    ("later", "earlier", "seconds", "text"),
    [
        (300, 200, 1.0, "100.0/s"),
        (20_000, 0, 2.0, "10000/s"),
        (10, 200, 1.0, "    -/s"),  # the daemon restarted
        (300, 200, 0.0, "    -/s"),  # there is only one state
        (300, 200, -5.0, "    -/s"),  # the clock was set
    ],
)
def test_an_unknown_rate_is_not_invented(
    later: int, earlier: int, seconds: float, text: str
) -> None:
    assert rate(later, earlier, seconds) == text


@each(
    ("value", "drawn"),
    [(0.0, ""), (20.0, "██████"), (-20.0, "██████"), (10.0, "███"), (99.0, "██████"),
     (0.5, "▏"), (math.nan, "")],
)  # fmt: skip
def test_a_bar_is_as_long_as_the_value_and_never_longer_than_its_place(
    value: float, drawn: str
) -> None:
    assert bar(value, 20.0, 6) == drawn


def test_columns_are_joined_to_lines_of_the_full_width() -> None:
    line = rule(30, ((0, "pose"), (15, "wheels")))
    assert line.plain == "pose ───────── wheels ────────"
    assert cell_len(ends(labelled("a", "b"), labelled("c", "d"), 40).plain) == 40
    assert ends(labelled("a", "much too long"), labelled("c", "d"), 20).plain.endswith("d")
