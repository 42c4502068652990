"""Each promise of `contract.py` holds through each door that offers it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.system.contract import PAGE, ROWS, marks, matrix
from tests.system.doors import Door, Stage
from tests.system.doors_of_programs import DOORS, Example
from tests.system.fleet_router import ITS_NAME, certified, robot_at, router
from tests.system.harness import Bus, Daemon
from tests.system.identities import Gated, free_tls_endpoint

NewStage = Callable[[str], Stage]


@contextmanager
def plain(where: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    with Daemon(where) as daemon, Bus(daemon.endpoint) as bus:
        yield Stage(daemon, bus, where, request, daemon.endpoint)


@contextmanager
def gateway(where: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    robot = Gated(where)
    with robot.daemon as daemon, Bus(robot.plain) as bus:
        own = robot.certificates.robot / "clients"
        yield Stage(daemon, bus, where, request, robot.tls, own.joinpath)


@contextmanager
def behind_router(where: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    tls = free_tls_endpoint()
    certified(where, "robot2", "viewer", "operator", "maintainer", ITS_NAME)
    with (
        router(where, tls),
        robot_at(tls, where, "robot2", mode="peer") as daemon,
        Bus(daemon.endpoint, "robot2") as bus,
    ):
        yield Stage(daemon, bus, where, request, tls, where.joinpath)


STAGES = {"plain": plain, "gateway": gateway, "router": behind_router}


@pytest.fixture(scope="module")
def stages(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[NewStage]:
    """Return a function that starts a robot of this kind, or returns the one that runs."""
    started: dict[str, Stage] = {}
    with ExitStack() as stack:

        def stage(kind: str) -> Stage:
            if kind not in started:
                opened = STAGES[kind](tmp_path_factory.mktemp(kind), request)
                started[kind] = stack.enter_context(opened)
                started[kind].bus.linked()
            return started[kind]

        yield stage
        for kind, robot in started.items():
            assert robot.daemon.process.poll() is None, kind
            assert "Traceback" not in robot.daemon.stderr, kind


@pytest.fixture(scope="module")
def opened(
    request: pytest.FixtureRequest, stages: NewStage, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[type[Door]], Door]]:
    """Return a function that opens a door, or returns the one that is open."""
    with ExitStack() as stack:
        now: list[Door] = []

        def door(kind: type[Door]) -> Door:
            if not now or type(now[0]) is not kind:
                stack.close()
                where = tmp_path_factory.mktemp("door")
                stage = stages(kind.stage)._replace(where=where, request=request)
                now[:] = [stack.enter_context(kind(stage))]
            return now[0]

        yield door


CELLS = [
    pytest.param(door, row, marks=marks(door), id=f"{door.name}-{row}")
    for door in DOORS
    for row in ROWS
    if row not in door.lacks
]


@pytest.mark.parametrize(("kind", "row"), CELLS)
def test_the_promise_holds_through_the_door(
    opened: Callable[[type[Door]], Door], kind: type[Door], row: str
) -> None:
    door = opened(kind)
    try:
        ROWS[row](door)
    finally:
        if door.bus.state()["mode"] == "stopped":
            assert door.bus.get("srv/clear")["success"]
    door.bus.at_rest()


def test_every_door_that_can_drive_can_stop() -> None:
    # The door of an `Example` is the page's WebSocket.
    drives = [d for d in DOORS if "units" not in d.lacks and not issubclass(d, Example)]
    assert len(drives) > 10
    assert [door.name for door in drives if "stop" in door.lacks] == []


def test_the_page_has_the_matrix() -> None:
    assert PAGE.read_text() == matrix(), "run `python -m tests.system.contract`"
