"""acsard shows values as text that is correct, bounded in length and safe for a terminal."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.top.screen import clean, count, rate
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
