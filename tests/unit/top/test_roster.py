"""Each robot has a line that states its activity, shows when it has gone, and fits."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.client.fleet import Row
from acsard.top.roster import HEADS, table
from tests.each import each
from tests.unit.top.screens import STATE

ROW = Row("robot1", True, replace(STATE, reason="driving: commanded by app"), 0.1, "0.1.0")


def test_a_line_has_all_of_a_robot() -> None:
    head, line = table([ROW], 120)
    assert tuple(head.split()) == tuple(one for one in HEADS if one != "FILE")
    assert line.split() == [
        "robot1", "driving", "+0.50", "up", "0.1.0", "0.1", "s", "commanded", "by", "app",
    ]  # fmt: skip


def test_a_robot_whose_settings_differ_from_its_file_is_marked_and_no_other() -> None:
    differ = "limits.linear_speed = 0.8, not 1.0"
    state = replace(STATE, settings_differ=differ)
    rows = [replace(ROW, state=state), replace(ROW, robot_id="robot2")]
    head, first, second = table(rows, 160)
    assert tuple(head.split()) == HEADS
    at = head.index("FILE")
    assert (first[at : at + 7], second[at : at + 7].strip()) == ("differs", "")
    assert first.endswith(f"; settings: {differ}")
    narrow = table(rows, 70)
    assert "FILE" not in narrow[0]
    assert "; settings: limits" in table(rows, 71)[1]


def test_without_feedback_no_speed_is_shown() -> None:
    (_, line) = table([replace(ROW, state=replace(STATE, linear=None))], 120)
    assert line.split()[2] == "-"


def test_robots_are_in_the_order_of_their_names() -> None:
    rows = [replace(ROW, robot_id=name) for name in ("c", "a", "b")]
    assert [line[0] for line in table(rows, 80)[1:]] == ["a", "b", "c"]


@each(
    ("row", "words"),
    [
        (replace(ROW, here=False, age=90.0), "GONE, was: commanded by app"),
        (replace(ROW, age=7.0, silent=True), "SILENT, was: commanded by app"),
        (replace(ROW, state=None), "waiting for its state"),
        (replace(ROW, state=None, here=False), "not there"),
    ],
)
def test_a_robot_that_is_gone_or_silent_is_reported(row: Row, words: str) -> None:
    assert table([row], 120)[1].endswith(words)


def test_a_narrow_terminal_has_what_matters_most() -> None:
    head, line = table([ROW], 40)
    assert head.split() == ["ROBOT", "MODE", "M/S", "SEEN", "WHY"]
    assert len(line) <= 40
    assert "driving" in line


@each("width", [40, 80, 160])
@each(
    "ids",
    [
        ("warehouse-west-1", "warehouse-west-2"),
        ("1-of-the-robots-in-the-warehouse", "2-of-the-robots-in-the-warehouse"),
        ("robots-in-the-warehouse-west-0-1", "robots-in-the-warehouse-west-0-2"),
        ("left-robot-of-the-warehouse-west", "left-robot-of-the-warehouse-east"),
        ("warehouse1-of-the-north-and-west", "warehouse2-of-the-north-and-west"),
    ],
)
def test_two_robots_look_different_at_every_width(ids: tuple[str, str], width: int) -> None:
    first, second = (line.split()[0] for line in table(rows_of(*ids), width)[1:])
    assert first != second
    if width == 160 or (width == 80 and len(ids[0]) == 16):
        assert [first, second] == sorted(ids)


def test_of_a_narrow_name_the_middle_is_left_out_and_why_keeps_its_room() -> None:
    shown = table(rows_of("warehouse-west-1", "warehouse-west-2"), 40)
    assert [line.split()[0] for line in shown[1:]] == ["wareh…west-1", "wareh…west-2"]
    wide = table(rows_of("robots-in-the-warehouse-west-0-1"), 80)[1]
    assert wide.endswith("commanded by app")
    assert len(wide) == 80


def rows_of(*ids: str) -> list[Row]:
    return [replace(ROW, robot_id=one) for one in ids]


IN_NEED = {
    "fault": replace(ROW, state=replace(STATE, mode="fault", reason="fault: a wheel is stuck")),
    "stopped": replace(ROW, state=replace(STATE, mode="stopped", reason="stopped by request")),
    "gone": replace(ROW, here=False, age=90.0),
    "silent": replace(ROW, age=7.0, silent=True),
    "not there": replace(ROW, state=None, here=False),
}


@each("need", IN_NEED)
def test_of_more_robots_than_lines_the_one_that_needs_a_person_is_shown(need: str) -> None:
    rows = [replace(ROW, robot_id=f"robot{n:02d}") for n in range(29)]
    shown = table([*rows, replace(IN_NEED[need], robot_id="robot99")], 120, 22)
    assert shown[1].startswith("robot99")
    assert [line.split()[0] for line in shown[2:-1]] == [row.robot_id for row in rows[:19]]


def test_a_robot_in_fault_is_before_those_that_are_off() -> None:
    rows = [replace(row, robot_id=str(9 - n)) for n, row in enumerate(IN_NEED.values())]
    names = [line[0] for line in table([*rows, ROW], 120)[1:]]
    assert names == ["9", "8", "5", "7", "6", "r"]


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
