"""What `acsard fleet` knows of robots that come and go, or are too many."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from acsard.messages.encodings import encode
from acsard.messages.schema import Info, Message
from acsard.top import fleet as fleets
from acsard.top.fleet import Fleet
from tests.unit.top.screens import STATE


class Session:
    """Hands over what a router would tell of tokens."""

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


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr(fleets, "MOST", 3)
    return Session()


def fleet_of(
    session: Session, ids: Sequence[str] = ("*",), answering: Collection[str] = ()
) -> Fleet:
    """Of robots of which some answer what they are asked."""
    robot: Any = SimpleNamespace(session=session)
    robot.like = lambda name: SimpleNamespace(ask=lambda key, take: answer(name, key, take))

    def answer(name: str, key: str, take: Callable[[Any], object]) -> None:
        if name in answering:
            payload = SimpleNamespace(to_bytes=lambda: encode(SAID[key], "json"))
            full = f"acsard/{name}/{key}"
            take(SimpleNamespace(key_expr=full, payload=payload, encoding="application/json"))

    return Fleet(robot, ids, "tcp/127.0.0.1:7448")


SAID: dict[str, Message] = {
    "state": STATE,
    "info": Info("robot1", "0.1", 1, "sim", simulated=True, rate=100.0, listen=[], connect=[]),
}


def test_robots_beyond_what_is_kept_are_said_to_be_left_out(session: Session) -> None:
    fleet = fleet_of(session)
    for number in range(3):
        session.comes(f"robot{number}")
    assert fleet.more == ""
    assert fleet.seen == "all seen at tcp/127.0.0.1:7448: 3 robots"
    session.comes("robot3")
    assert [row.robot_id for row in fleet.rows()] == ["robot0", "robot1", "robot2"]
    assert "more than 3 robots: the others are left out" in fleet.more
    assert "--id" in fleet.more


def test_a_robot_whose_token_goes_is_not_here(session: Session) -> None:
    fleet = fleet_of(session)
    session.comes("robot1")
    session.comes("robot1", zenoh.SampleKind.DELETE)
    assert [row.here for row in fleet.rows()] == [False]
    assert fleet.more == ""


@pytest.mark.parametrize(
    ("ids", "answering", "here", "whole"),
    [
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1", "robot2"), True),
        (("robot1", "robot2"), ("robot1",), ("robot1", "robot2"), False),
        (("robot1", "robot2"), ("robot1", "robot2"), ("robot1",), False),
        (("*",), ("robot1",), ("robot1",), False),  # another may come yet
    ],
)
def test_it_is_whole_once_each_who_was_named_is_here_and_has_said_all(
    session: Session, ids: tuple[str, ...], answering: tuple[str, ...], here: Sequence[str],
    whole: bool,
) -> None:  # fmt: skip
    fleet = fleet_of(session, ids, answering)
    assert not fleet.whole
    for name in here:
        session.comes(name)
    fleet.rows()  # asks
    assert fleet.whole is whole
