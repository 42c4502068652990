"""Tests of `acsard fleet` with robots that appear and disappear, or are too many."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from acsard.client import fleet as fleets
from acsard.client.follower import FLEET_ASK_S
from acsard.core.messages.schema import Info, Time
from acsard.daemon.bus.address import Address
from acsard.top.fleet import Fleet
from acsard.top.roster import table
from tests.unit.top.screens import STATE, sample_of


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

    def comes(self, name: str, kind: Any = zenoh.SampleKind.PUT) -> None:
        self.tell(SimpleNamespace(key_expr=f"acsard/{name}/alive", kind=kind))


class Clock:
    """A clock that stands still until it is set."""

    now = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(fleets, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def session() -> Session:
    return Session()


def fleet_of(
    session: Session, ids: Sequence[str] = ("*",), answering: Collection[str] = ()
) -> Fleet:
    """Return a fleet in which the robots of `answering` answer queries."""
    robot: Any = SimpleNamespace(session=session, where=Address("tcp/127.0.0.1:7448", "acsar", ""))
    stamps = count(2000)
    robot.like = lambda name: SimpleNamespace(ask=lambda key, take: answer(name, key, take))

    def answer(name: str, key: str, take: Callable[[Any], object]) -> None:
        if name in answering:
            said = {"state": replace(STATE, stamp=Time(next(stamps))), "info": INFO}
            take(sample_of(said[key], f"acsard/{name}/{key}"))

    return Fleet(robot, ids, most=3)


INFO = Info("robot1", "0.1", 1, "sim", simulated=True, rate=100.0, listen=[], connect=[])


def test_robots_beyond_what_is_kept_are_said_to_be_left_out(session: Session) -> None:
    fleet = fleet_of(session)
    for number in range(3):
        session.comes(f"robot{number}")
    assert fleet.more == ""
    assert fleet.seen == "all robots visible at tcp/127.0.0.1:7448: 3 robots"
    session.comes("robot3")
    assert [row.robot_id for row in fleet.rows()] == ["robot0", "robot1", "robot2"]
    assert "more than 3 robots: the others are left out" in fleet.more
    assert "--id" in fleet.more


def test_who_is_gone_for_longest_makes_room_for_who_comes(session: Session, clock: Clock) -> None:
    fleet = fleet_of(session, ("robot0", "*"))
    for number in range(3):
        session.comes(f"robot{number}")
    for name in ("robot0", "robot2", "robot1"):
        clock.now += 1.0
        session.comes(name, zenoh.SampleKind.DELETE)
    session.comes("robot3")
    assert sorted(row.robot_id for row in fleet.rows()) == ["robot0", "robot1", "robot3"]
    assert fleet.more == ""


def test_a_robot_whose_token_goes_is_not_here(session: Session) -> None:
    fleet = fleet_of(session)
    session.comes("robot1")
    session.comes("robot1", zenoh.SampleKind.DELETE)
    assert [row.here for row in fleet.rows()] == [False]
    assert fleet.more == ""


def test_the_version_of_a_robot_that_publishes_its_state_often_is_asked_for(
    session: Session, clock: Clock
) -> None:
    fleet = fleet_of(session, ("robot1",), ("robot1",))
    session.comes("robot1")
    for _ in range(3):
        fleet._state(sample_of(STATE, "acsard/robot1/state"))
        version = fleet.rows()[0].version
        clock.now += 0.1
    assert version == "0.1"


@pytest.mark.parametrize(
    ("ids", "answering", "here", "whole"),
    [
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1", "robot2"), True),
        (("robot1", "robot2"), ("robot1",), ("robot1", "robot2"), False),
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1",), False),
        (("*",), ("robot1",), ("robot1",), False),  # another robot may still appear
    ],
)
def test_it_is_whole_once_each_who_was_named_is_here_and_has_said_all(
    session: Session, clock: Clock, ids: tuple[str, ...], answering: tuple[str, ...],
    here: Sequence[str], whole: bool,
) -> None:  # fmt: skip
    fleet = fleet_of(session, ids, answering)
    assert not fleet.whole
    for name in here:
        session.comes(name)
    # the first query may be answered by a storage, the second one only by the robot
    for _ in range(2):
        fleet.rows()
        clock.now += FLEET_ASK_S
    assert fleet.whole is whole


class Remembers:
    """A client of a router whose storage holds this robot's last state.

    The storage may receive a newer state.
    """

    where = Address("tcp/127.0.0.1:7448", "acsar", "")

    def __init__(self, session: Session) -> None:
        self.session, self.stored = session, STATE

    def like(self, name: str) -> Remembers:
        return self

    def ask(self, key: str, take: Callable[[Any], object]) -> None:
        if key == "state":
            take(sample_of(self.stored, f"acsard/robot1/{key}"))


def told(fleet: Fleet, clock: Clock, seconds: float) -> str:
    """Return the line of the robot after watching it for this many seconds."""
    for _ in range(int(seconds / 0.25)):
        fleet.rows()
        clock.now += 0.25
    return table(fleet.rows(), 120)[1]


def test_a_robot_whose_state_only_a_storage_still_has_is_gone_and_not_heard(
    session: Session, clock: Clock
) -> None:
    robot: Any = Remembers(session)
    line = told(Fleet(robot, ("robot1",)), clock, 20.0)
    assert "never" in line
    assert line.endswith("GONE, was: commanded by app")


def test_a_daemon_that_hangs_is_silent_though_a_storage_answers_for_it(
    session: Session, clock: Clock
) -> None:
    robot: Any = Remembers(session)
    fleet = Fleet(robot, ("robot1",))
    session.comes("robot1")
    assert told(fleet, clock, 0.5).endswith("waiting for its state")
    assert told(fleet, clock, 5.0).endswith("SILENT, was: commanded by app")
    robot.stored = replace(STATE, stamp=Time(1001))
    assert told(fleet, clock, 2.5).endswith("commanded by app")
    assert "SILENT" not in told(fleet, clock, 0.0)
    assert told(fleet, clock, 9.0).endswith("SILENT, was: commanded by app")
