"""`acsard fleet` and `acsard top` follow robots: who is there, who is silent, and since when."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client.follower import (
    FLEET_QUERY_PERIOD_S,
)
from acsard.core.messages.schema import Time
from acsard.top import feed as top_feed
from acsard.top import roster as rosters
from acsard.top.feed import Feed
from acsard.top.fleet_table import table
from acsard.top.roster import Roster
from tests.unit.screens import BEFORE, INFO, STATE, drawn, sample_of


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
    monkeypatch.setattr(rosters, "clock", SimpleNamespace(steady_s=lambda: clock.now))
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

    return Roster(robot, ids)


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
    assert not fleet._all_reported()
    for name in here:
        session.announce(name)
    # the first query may be answered by a storage, the second one only by the robot
    for _ in range(2):
        fleet.rows()
        clock.now += FLEET_QUERY_PERIOD_S
    assert fleet._all_reported() is whole


class Remembers:
    """A client of a router whose storage holds this robot's last state.

    The storage may receive a newer state.
    """

    where = Address("tcp/127.0.0.1:7448", "acsar", "")

    def __init__(self, session: Session) -> None:
        self.session, self.stored = session, replace(STATE, reason="commanded by app")

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
    return drawn(table(fleet.rows(), 120), 120).splitlines()[1].rstrip()


def test_a_hung_daemon_is_silent_though_a_storage_answers(session: Session, clock: Clock) -> None:
    robot: Any = Remembers(session)
    fleet = Roster(robot, ("robot1",))
    session.announce("robot1")
    assert line_after(fleet, clock, 0.5).endswith("waiting for its state")
    assert line_after(fleet, clock, 5.0).endswith("SILENT, was: commanded by app")
    robot.stored = replace(robot.stored, stamp=Time(1001))
    assert line_after(fleet, clock, 2.5).endswith("commanded by app")
    assert "SILENT" not in line_after(fleet, clock, 0.0)
    assert line_after(fleet, clock, 9.0).endswith("SILENT, was: commanded by app")


# one robot


def test_rates_are_between_two_states_of_one_daemon_by_the_viewer_s_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, states, key = Clock(), [STATE], "acsard/acsar/state"
    monkeypatch.setattr(top_feed, "clock", SimpleNamespace(steady_s=lambda: clock.now))
    queue: Any = SimpleNamespace(try_recv=lambda: sample_of(states.pop(0), key) if states else None)
    robot: Any = SimpleNamespace(
        where=Address("tcp/127.0.0.1:7448", "acsar", ""), get=lambda _: INFO, key=lambda _: key,
        start_query=lambda *_: None, subscribe=lambda _: queue,
    )  # fmt: skip
    feed = Feed(robot)
    feed.poll()
    assert feed.screen_data().passed == 0.0
    clock.now += 0.8
    states.append(replace(STATE, stamp=Time(9000)))
    feed.poll()
    assert feed.screen_data().passed == pytest.approx(0.8)
    states.append(BEFORE)  # another daemon's, whose counters are smaller
    feed.poll()
    assert (feed.screen_data().before, feed.screen_data().state) == (BEFORE, BEFORE)
