"""How connections and failed drives end: with zeros, and with the reason if one hangs."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from typing import Any

import pytest

from acsard.bus.address import Address
from acsard.client import (
    AsyncClient,
    Client,
    NoAnswerError,
    asynchronous,
    connect_async,
    connection,
    synchronous,
)
from acsard.client.connection import Connection, open_connection
from acsard.client.driving import UnheardError
from acsard.client.ride import MAX_SOURCE_TIMEOUT_S
from acsard.core.values import REST, Twist
from acsard.host.errors import NotDrivenError, NotPermittedError, UnreachableError
from tests.unit.test_client_connection import Session, client_of, without_states

ENDPOINT = "tcp/127.0.0.1:1"


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Session:
    """Return the session that each connection of the test gets."""
    session = Session("0123456789abcdef")

    def opened(endpoint: str, tls: str) -> Session:
        assert (endpoint, tls) == (ENDPOINT, "")
        return session

    for module in (asynchronous, connection):
        monkeypatch.setattr(module, "client_session", opened)
    monkeypatch.setattr("acsard.client.driving.MAX_END_S", 0.0)
    monkeypatch.setattr(connection, "_open", {})
    return session


def driving(robot: Connection, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the robot follow this client, and check that the end of the program would stop it."""
    without_states(robot, monkeypatch)
    for speed in (0.0, 0.3):
        robot.send(speed)
    assert list(connection._open) == [robot]


def ended(session: Session) -> bool:
    """Return whether a zero was the last command before the connection was closed."""
    twists = [command.twist for command in session.heard]
    return session.closed and twists == [REST, Twist(0.3, 0.0), REST] and not connection._open


def test_the_end_of_a_block_stops_the_robot(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_connection(Address(ENDPOINT, "acsar", "")) as robot:
        driving(robot, monkeypatch)
    assert ended(session)


@pytest.mark.parametrize("fails", [False, True])
async def test_the_end_of_an_asynchronous_block_stops_the_robot(
    fails: bool, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyError) if fails else nullcontext():
        async with connect_async(ENDPOINT, robot_id="acsar") as robot:
            assert isinstance(robot, AsyncClient)
            driving(robot._connection, monkeypatch)
            if fails:
                raise KeyError
    assert ended(session)


async def test_a_connection_that_cannot_be_closed_is_reported_unless_the_block_failed(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    monkeypatch.setattr(asynchronous, "CLOSE_TIMEOUT_S", 0.01)
    monkeypatch.setattr(session, "close", lambda: released.wait(20.0))
    try:
        with pytest.raises(NoAnswerError, match="final zeros may be lost"):
            async with connect_async(ENDPOINT, robot_id="acsar"):
                pass
        with pytest.raises(KeyError):
            async with connect_async(ENDPOINT, robot_id="acsar"):
                raise KeyError
    finally:
        released.set()


def test_a_robot_that_is_not_reached_is_reported_with_the_advice_of_its_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unreachable(*_: object) -> None:
        raise UnreachableError("nobody listens")

    monkeypatch.setattr(connection, "client_session", unreachable)
    where = Address(ENDPOINT, "acsar", "", advice="start the daemon")
    with (
        pytest.raises(UnreachableError, match=r"^nobody listens; start the daemon$"),
        open_connection(where),
    ):
        pass


def test_the_end_of_a_program_ends_the_connections_whose_threads_cannot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A child has none of its parent's threads, and Python waits for a thread that still runs."""
    over = threading.Thread(target=lambda: None)
    over.start()
    over.join()
    waits, main = threading.Event(), threading.main_thread()
    runs = threading.Thread(target=waits.wait)
    daemon = threading.Thread(target=waits.wait, daemon=True)
    for thread in (runs, daemon):
        thread.start()
    pid, ends = os.getpid(), list[str]()
    clients: Any = {
        "main": (pid, main), "over": (pid, over), "daemon": (pid, daemon), "runs": (pid, runs),
        "parent": (pid + 1, main),
    }  # fmt: skip
    monkeypatch.setattr(connection, "_open", clients)
    monkeypatch.setattr(connection, "_end", ends.extend)
    connection._end_all()
    waits.set()
    assert ends == ["main", "over", "daemon"]


def test_no_zero_is_sent_to_a_robot_that_no_longer_follows_its_last_speed(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late zero would stop the next sender."""
    robot = client_of(session)
    without_states(robot, monkeypatch)
    for speed in (0.0, 0.3):
        robot.send(speed)
    robot._spacing.moving[robot] -= MAX_SOURCE_TIMEOUT_S
    robot.end()
    assert session.closed
    assert session.heard[-1].twist.linear == 0.3


def test_the_same_client_may_have_another_name_in_the_log() -> None:
    robot = client_of(Session("0123456789abcdef"))
    other = robot.named("ann@page")
    assert (other.session, other.where, other.sender) == (robot.session, robot.where, robot.sender)
    assert other.caller.startswith("ann@page/")
    assert not robot.caller.startswith("ann@page/")


class Steps:
    """A drive that fails with this error, and the driver whose zeros follow."""

    def __init__(self, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
        self.zeros_sent, self.is_ended = 0, False
        self.error = error
        for module in (asynchronous, synchronous):
            monkeypatch.setattr(module, "Driver", lambda _: self)
            monkeypatch.setattr(module, "drive", lambda *_: self.steps)

    def steps(self, _: object) -> Iterator[float]:
        yield 0.0
        raise self.error

    def zeros(self) -> Iterator[float]:
        for _ in range(3):
            self.zeros_sent += 1
            yield 0.0

    def end(self) -> None:
        self.is_ended = True


@pytest.mark.parametrize("kind", [Client, AsyncClient])
async def test_each_way_to_drive_has_its_own_steps_and_speeds(
    kind: type[Client] | type[AsyncClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[tuple[object, ...]]()
    Steps(KeyError(), monkeypatch)

    def steps_of(name: str, *numbers: float) -> Callable[[object], Iterator[float]]:
        def steps(_: object) -> Iterator[float]:
            asked.append((name, *numbers))
            yield 0.0

        return steps

    for module in (asynchronous, synchronous):
        for name in ("drive", "move", "turn"):
            monkeypatch.setattr(module, name, partial(steps_of, name))
    robot: Any = kind(client_of(Session("0123456789abcdef")))
    for ask in (
        partial(robot.drive, 0.3, 0.1, seconds=2.0), partial(robot.drive, 0.3, seconds=2.0),
        partial(robot.move, -1.0), partial(robot.move, 1.0, speed=0.2),
        partial(robot.turn, 90.0), partial(robot.turn, -90.0, speed=0.4),
    ):  # fmt: skip
        result = ask()
        if kind is AsyncClient:
            await result
    assert asked == [
        ("drive", 0.3, 0.1, 2.0), ("drive", 0.3, 0.0, 2.0), ("move", -1.0, 0.3),
        ("move", 1.0, 0.2), ("turn", 90.0, 0.8), ("turn", -90.0, 0.4),
    ]  # fmt: skip


async def drive(robot: Client | AsyncClient) -> None:
    if isinstance(robot, Client):
        robot.drive(0.3, seconds=1.0)
    else:
        await robot.drive(0.3, seconds=1.0)


@pytest.mark.parametrize(
    ("error", "is_explained"),
    [
        (UnheardError("no command arrives", lacks_only_commands=True), True),
        (NoAnswerError("nothing received"), True),
        (NotDrivenError("stopped by ann"), False),
        (KeyError("a bug"), False),
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
async def test_a_drive_that_fails_ends_with_zeros_and_the_reason_that_the_role_may_give(
    kind: type[Client] | type[AsyncClient], error: Exception, is_explained: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    steps, explained = Steps(error, monkeypatch), NotPermittedError("you are a viewer")
    robot = client_of(Session("0123456789abcdef"))
    monkeypatch.setattr(robot, "explain_error", lambda _: explained)
    with pytest.raises(type(explained if is_explained else error)) as raised:
        await drive(kind(robot))
    assert raised.value is (explained if is_explained else error)
    assert (steps.zeros_sent, steps.is_ended) == (3, True)
