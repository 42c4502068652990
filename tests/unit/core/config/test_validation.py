"""Tests of generic validation: it converts a table to a struct, or reports a line per mistake.

The tests define their own structs, because validation depends only on msgspec types.
"""

from __future__ import annotations

import math
import tomllib
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, Struct

from acsard.core.config.validation import build, show, write
from tests.each import each


class Leg(Struct, frozen=True):
    name: Annotated[str, Meta(extra={"example": "left"})]
    length: Annotated[float, Meta(ge=0.5, le=2.0, extra={"unit": "m"})] = 1.0


class Table(Struct, frozen=True):
    toes: Annotated[int, Meta(ge=3, le=5)] = 4
    wood: Literal["oak", "ash"] = "oak"
    heavy: bool = False
    marks: tuple[str, ...] = ()
    speed: Annotated[float, Meta(ge=1.0, le=9.0, extra={"unit": "m/s"})] | Literal["auto"] = 2.0
    first: Leg = Leg("left")
    legs: tuple[Leg, ...] = ()


def problems_of(table: object) -> list[str]:
    problems: list[str] = []
    assert build(Table, table, "", problems) is None
    return problems


def build_table(table: object) -> Table:
    problems: list[str] = []
    result = build(Table, table, "", problems)
    assert problems == []
    assert result is not None
    return result


def test_an_empty_table_gives_all_defaults() -> None:
    assert build_table({}) == Table()


def test_every_kind_of_value_is_accepted() -> None:
    table = {
        "toes": 5,
        "wood": "ash",
        "heavy": True,
        "marks": ["a", "b"],
        "speed": "auto",
        "first": {"name": "x", "length": 2},
        "legs": [{"name": "y"}, {"name": "z", "length": 0.5}],
    }
    assert build_table(table) == Table(
        toes=5,
        wood="ash",
        heavy=True,
        marks=("a", "b"),
        speed="auto",
        first=Leg("x", 2.0),
        legs=(Leg("y"), Leg("z", 0.5)),
    )


def test_a_whole_number_is_accepted_as_a_float() -> None:
    assert build_table({"speed": 3}).speed == 3.0


@each(
    ("table", "line"),
    [
        ({"toes": 6}, "toes = 6: expected a whole number from 3 to 5; the default is toes = 4"),
        ({"toes": "4"}, 'toes = "4": expected a whole number from 3 to 5; '),
        ({"toes": True}, "toes = true: expected a whole number from 3 to 5; "),
        (
            {"wood": "elm"},
            'wood = "elm": expected one of "ash", "oak"; the default is wood = "oak"',
        ),
        ({"heavy": 1}, "heavy = 1: expected true or false; the default is heavy = false"),
        ({"marks": "a"}, 'marks = "a": expected a list, each a text in quotes; '),
        ({"marks": [1]}, "marks = [1]: expected a list, each a text in quotes; "),
        ({"speed": 0.5}, 'speed = 0.5: expected a number from 1 to 9 m/s or one of "auto"; '),
        ({"first": 7}, "first = 7: expected a table; write it as [first]"),
        ({"first": {}}, 'first.name: missing; write name = "left"'),
        ({"first": {"name": 3}}, 'first.name = 3: expected a text in quotes; for example "left"'),
        ({"legs": {"name": "x"}}, 'legs = {name = "x"}: expected tables; write them as [[legs]]'),
        ({"legs": [{"name": "x"}, {}]}, 'legs[1].name: missing; write name = "left"'),
        (
            {"legs": [{"name": "x", "length": 9}]},
            "legs[0].length = 9: expected a number from 0.5 to 2 m; the default is length = 1.0",
        ),
        ({"toe": 4}, "toe = 4: unknown key; did you mean toes?"),
        ({"first": {"name": "x", "lenght": 1}}, "first.lenght = 1: unknown key; did you mean leng"),
        ({"qqq": 4}, "qqq = 4: unknown key; known here: toes, wood, heavy, marks, speed, "),
    ],
)
def test_a_mistake_gives_one_line_with_key_value_and_remedy(table: object, line: str) -> None:
    (problem,) = problems_of(table)
    assert problem.startswith(line)


@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
def test_a_number_that_is_not_finite_is_refused_also_in_lists_and_tables(bad: float) -> None:
    assert len(problems_of({"speed": bad})) == 1
    assert len(problems_of({"first": {"name": "x", "length": bad}})) == 1


def test_all_mistakes_are_reported_together() -> None:
    messages = problems_of({"toes": 9, "wood": "elm", "legs": [{}, {"nam": 1}], "x": 0})
    starts = (
        "x = 0",
        "toes = 9",
        'wood = "elm"',
        "legs[0].name",
        "legs[1].nam = 1",
        "legs[1].name",
    )
    assert len(messages) == len(starts)
    assert all(any(line.startswith(start) for line in messages) for start in starts)


def test_a_long_value_is_shown_truncated_to_80_characters() -> None:
    assert show("x" * 500) == '"' + "x" * 76 + "..."


@each("value", ["", "plain", 'quote " and \\', "tab\tnl\n", "é ∞", True, False, 0])
def test_a_written_value_is_toml_for_the_same_value(value: object) -> None:
    assert tomllib.loads(f"key = {write(value)}") == {"key": value}


@given(st.recursive(st.integers() | st.floats(allow_nan=False) | st.booleans(), st.lists))
def test_written_numbers_and_lists_read_back_exactly(value: object) -> None:
    assert tomllib.loads(f"key = {write(value)}") == {"key": value}
