"""A line for each robot: it says what each does, who is gone, and fits."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.top.roster import HEADS, Row, table
from tests.unit.top.screens import STATE

ROW = Row("robot1", True, replace(STATE, reason="driving: commanded by app"), 0.1, "0.1.0")


def test_a_line_has_all_of_a_robot() -> None:
    head, line = table([ROW], 120)
    assert tuple(head.split()) == HEADS
    assert line.split() == [
        "robot1", "driving", "+0.50", "up", "0.1.0", "0.1", "s", "commanded", "by", "app",
    ]  # fmt: skip


def test_robots_are_in_the_order_of_their_names() -> None:
    rows = [replace(ROW, robot_id=name) for name in ("c", "a", "b")]
    assert [line[0] for line in table(rows, 80)[1:]] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (replace(ROW, here=False, age=90.0), "GONE, was: commanded by app"),
        (replace(ROW, age=7.0), "SILENT, was: commanded by app"),
        (replace(ROW, state=None), "waiting for its state"),
        (replace(ROW, state=None, here=False), "not there"),
    ],
)
def test_who_is_gone_or_silent_is_told(row: Row, words: str) -> None:
    assert table([row], 120)[1].endswith(words)


def test_a_narrow_terminal_has_what_matters_most() -> None:
    head, line = table([ROW], 40)
    assert head.split() == ["ROBOT", "MODE", "M/S", "HEARD", "WHY"]
    assert len(line) <= 40
    assert "driving" in line


def test_more_robots_than_lines_are_counted() -> None:
    rows = [replace(ROW, robot_id=f"robot{n}") for n in range(10)]
    shown = table(rows, 80, 5)
    assert len(shown) == 5
    assert shown[-1] == "and 7 more"


@given(st.text(max_size=80), st.floats(), st.floats(0, 1e12), st.integers(20, 200))
def test_it_holds_whatever_comes(text: str, number: float, age: float, width: int) -> None:
    state = replace(STATE, mode=text, reason=text, link=text, linear=number)
    for line in table([Row(text, True, state, age, text)], width):
        assert len(line) <= width
        assert line.isprintable()
