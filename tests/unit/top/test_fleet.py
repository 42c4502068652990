"""What `acsard fleet` knows of robots that come and go, or are too many."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from acsard.top import fleet as fleets
from acsard.top.fleet import Fleet


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


def fleet_of(session: Session) -> Fleet:
    robot: Any = SimpleNamespace(session=session)
    robot.like = lambda name: SimpleNamespace(ask=lambda key, take: None)
    return Fleet(robot, ("*",), "tcp/127.0.0.1:7448")


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
