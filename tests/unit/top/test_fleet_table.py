"""Each robot has a line that says what it does and when it was last seen, and fits the terminal."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.cells import cell_len

from acsard.bus.address import Address
from acsard.client import fleet as fleets
from acsard.client.fleet import Row
from acsard.client.follower import FLEET_QUERY_PERIOD_S
from acsard.core.messages.schema import Time
from acsard.core.values import NS_PER_S
from acsard.host import clock as clocks
from acsard.top.fleet_table import COLUMNS, Roster
from acsard.top.fleet_table import table as table_of
from tests.each import each
from tests.unit.top.screens import STATE, drawn, sample_of


def table(rows: Sequence[Row], width: int, most: int | None = None) -> list[str]:
    return [line.rstrip() for line in drawn(table_of(rows, width, most), width).splitlines()]


ROW = Row("robot1", True, replace(STATE, reason="commanded by app"), 0.1)


def test_a_version_with_a_lower_number_than_the_newest_in_the_table_is_marked_as_older() -> None:
    versions = {
        "r1": "0.2.0.dev0+g1a2b3c4d5", "r2": "0.2.0", "r3": "0.10.0rc1", "r4": "0.10.0rc1+g1.dirty",
        "r5": "unreadable", "r6": "",
    }  # fmt: skip
    rows = [Row(name, True, replace(STATE, version=text), 0.1) for name, text in versions.items()]
    lines = table([*rows, Row("r7", True, None, 0.1)], 200)[1:]
    assert {line[:2] for line in lines if " older " in line} == {"r1", "r2"}


READY = replace(STATE, mode="ready", reason="waiting for a command", linear=0.0)
DIFFER = "limits.linear_speed = 0.8, not 1.0"
FULL = "the disk is full: nothing is recorded"


def test_the_details_of_each_warning_follow_the_list_of_warnings() -> None:
    expiry = "expires in 10 days (certificate of the authority)"
    state = replace(
        READY,
        recording_error=FULL,
        certificate="expires",
        certificate_days=10.0,
        certificate_expiry=expiry,
        settings_differ=DIFFER,
    )
    (_, line) = table([replace(ROW, state=state)], 400)
    assert line.endswith(
        "WARNING: certificate expires in 10 days, recording fails, settings differ; waiting for a "
        f"command; certificate: {expiry}; "
        f"recording: {FULL}; settings: {DIFFER}"
    )


@each("width", [40, 60, 80, 100, 120, 200])
def test_a_narrow_terminal_has_fewer_columns_but_mode_and_reason(width: int) -> None:
    rows = [replace(ROW, state=replace(READY, recording_error=FULL))]
    head, line = table(rows, width)
    assert head.split() == [c for c, least in COLUMNS.items() if width >= least and c != "BATTERY"]
    assert line.startswith("robot1  ready")
    assert "WARNING: rec" in line
    assert len(line) <= width


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
    lines = table(rows_of(*ids), width)[1:]
    assert all(len(line) <= width for line in lines)
    names = "".join(line[: max(map(len, ids))].split()[0] for line in lines)
    assert names == "".join(sorted(ids))


def rows_of(*ids: str) -> list[Row]:
    return [replace(ROW, robot_id=robot_id) for robot_id in ids]


IN_NEED = {
    "fault": replace(ROW, state=replace(STATE, mode="fault", reason="a wheel is stuck")),
    "stopped": replace(ROW, state=replace(STATE, mode="stopped", reason="stopped by request")),
    "gone": replace(ROW, here=False, age=90.0),
    "silent": replace(ROW, age=7.0, silent=True),
    "not there": replace(ROW, state=None, here=False),
}


@each("need", IN_NEED)
def test_a_robot_that_needs_help_is_shown_first_if_the_fleet_exceeds_the_screen(need: str) -> None:
    rows = [replace(ROW, robot_id=f"robot{n:02d}") for n in range(29)]
    lines = table([*rows, replace(IN_NEED[need], robot_id="robot99")], 120, 20)
    assert lines[1].startswith("robot99")
    assert [line.split()[0] for line in lines[2:-1]] == [row.robot_id for row in rows[:19]]


def test_more_robots_than_lines_are_counted() -> None:
    rows = [replace(ROW, robot_id=f"robot{n}") for n in range(10)]
    lines = table(rows, 80, 3)
    assert len(lines) == 5
    assert lines[-1] == "and 7 more"


@given(st.text(max_size=80), st.floats(), st.floats(0, 1e12), st.integers(20, 200))
def test_any_text_and_number_fits_the_width_and_is_printable(
    text: str, number: float, age: float, width: int
) -> None:
    state = replace(STATE, mode=text, reason=text, link=text, linear=number, version=text)
    for line in table([Row(text, True, state, age)], width):
        assert cell_len(line) <= width
        assert line.isprintable()


class Session:
    """A session that hands over liveliness tokens as a router would."""

    def __init__(self) -> None:
        self.tell: Any = None

    def liveliness(self) -> Session:
        return self

    def declare_subscriber(self, key: str, take: Any, history: bool = False) -> Any:
        if history:
            self.tell = take
        return SimpleNamespace(undeclare=lambda: None)

    def announce(self, name: str, kind: Any = zenoh.SampleKind.PUT) -> None:
        self.tell(SimpleNamespace(key_expr=f"acsard/{name}/alive", kind=kind))


class Clock:
    """A clock that stands still until it is set."""

    now = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(fleets, "clock", SimpleNamespace(steady_s=lambda: clock.now))
    return clock


@pytest.fixture
def session() -> Session:
    return Session()


def fleet_of(
    session: Session, ids: Sequence[str] = ("*",), answering: Collection[str] = ()
) -> Roster:
    """Return a fleet in which only the robots in `answering` answer queries."""
    robot: Any = SimpleNamespace(session=session, where=Address("tcp/127.0.0.1:7448", "acsar", ""))
    stamps = count(2000)
    robot.sibling = lambda name: SimpleNamespace(
        start_query=lambda key, take: answer(name, key, take)
    )

    def answer(name: str, key: str, take: Callable[[Any], object]) -> None:
        if name in answering:
            take(sample_of(replace(STATE, stamp=Time(next(stamps))), f"acsard/{name}/{key}"))

    return Roster(robot, ids, most=3)


def test_robots_beyond_the_limit_are_reported_as_left_out(session: Session) -> None:
    fleet = fleet_of(session)
    for number in range(3):
        session.announce(f"robot{number}")
    assert fleet.left_out_text == ""
    assert fleet.presence_text == "all robots visible at tcp/127.0.0.1:7448: 3 robots"
    session.announce("robot3")
    assert [row.robot_id for row in fleet.rows()] == ["robot0", "robot1", "robot2"]
    assert "more than 3 robots, and this list shows only 3 of them" in fleet.left_out_text
    assert "--id" in fleet.left_out_text


def test_the_robot_that_is_gone_for_longest_makes_room_for_a_new_one(
    session: Session, clock: Clock
) -> None:
    fleet = fleet_of(session, ("robot0", "*"))
    for number in range(3):
        session.announce(f"robot{number}")
    for name in ("robot0", "robot2", "robot1"):
        clock.now += 1.0
        session.announce(name, zenoh.SampleKind.DELETE)
    session.announce("robot3")
    assert sorted(row.robot_id for row in fleet.rows()) == ["robot0", "robot1", "robot3"]
    assert fleet.left_out_text == ""


def test_a_robot_whose_liveliness_token_is_deleted_is_not_present(session: Session) -> None:
    fleet = fleet_of(session)
    session.announce("robot1")
    session.announce("robot1", zenoh.SampleKind.DELETE)
    assert [row.here for row in fleet.rows()] == [False]
    assert fleet.left_out_text == ""


def test_a_state_from_before_a_suspend_is_old(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age must include the suspend, in which the monotonic clock stands still."""
    fleet = fleet_of(session)
    session.announce("robot1")
    fleet._state(sample_of(STATE, "acsard/robot1/state"))
    slept_ns = clocks.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clocks, "asleep_ns", lambda: slept_ns)
    (row,) = fleet.rows()
    assert row.silent
    assert row.age >= 3600.0


@pytest.mark.parametrize(
    ("ids", "answering", "here", "whole"),
    [
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1", "robot2"), True),
        (("robot1", "robot2"), ("robot1",), ("robot1", "robot2"), False),
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1",), False),
        (("*", "robot1"), ("robot1",), ("robot1",), True),
        (("*", "robot2"), ("robot1",), ("robot1",), False),
    ],
)
def test_the_fleet_is_complete_once_each_named_robot_is_present_and_has_answered(
    session: Session, clock: Clock, ids: tuple[str, ...], answering: tuple[str, ...],
    here: Sequence[str], whole: bool,
) -> None:  # fmt: skip
    fleet = fleet_of(session, ids, answering)
    assert not fleet.all_reported
    for name in here:
        session.announce(name)
    # the first query may be answered by a storage, the second one only by the robot
    for _ in range(2):
        fleet.rows()
        clock.now += FLEET_QUERY_PERIOD_S
    assert fleet.all_reported is whole


class Remembers:
    """A client of a router whose storage holds this robot's last state.

    The storage may receive a newer state.
    """

    where = Address("tcp/127.0.0.1:7448", "acsar", "")

    def __init__(self, session: Session) -> None:
        self.session, self.stored = session, STATE

    def sibling(self, name: str) -> Remembers:
        return self

    def start_query(self, key: str, take: Callable[[Any], object]) -> None:
        if key == "state":
            take(sample_of(self.stored, f"acsard/robot1/{key}"))


def line_after(fleet: Roster, clock: Clock, seconds: float) -> str:
    """Return the line of the robot after watching it for this many seconds."""
    for _ in range(int(seconds / 0.25)):
        fleet.rows()
        clock.now += 0.25
    return table(fleet.rows(), 120)[1]


def test_a_robot_whose_state_only_a_storage_has_is_gone_and_was_never_seen(
    session: Session, clock: Clock
) -> None:
    robot: Any = Remembers(session)
    line = line_after(Roster(robot, ("robot1",)), clock, 20.0)
    assert "never" in line
    assert line.endswith("GONE, was: commanded by app")


def test_a_daemon_that_hangs_is_silent_though_a_storage_answers_for_it(
    session: Session, clock: Clock
) -> None:
    robot: Any = Remembers(session)
    fleet = Roster(robot, ("robot1",))
    session.announce("robot1")
    assert line_after(fleet, clock, 0.5).endswith("waiting for its state")
    assert line_after(fleet, clock, 5.0).endswith("SILENT, was: commanded by app")
    robot.stored = replace(STATE, stamp=Time(1001))
    assert line_after(fleet, clock, 2.5).endswith("commanded by app")
    assert "SILENT" not in line_after(fleet, clock, 0.0)
    assert line_after(fleet, clock, 9.0).endswith("SILENT, was: commanded by app")
