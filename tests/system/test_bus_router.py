"""`acsard router` routes until a signal ends it, and says why it cannot start."""

from __future__ import annotations

import signal
import socket
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from acsard.machine.authority import Authority
from tests.system.fleet_router import (
    ITS_NAME,
    Member,
    acsard_router,
    certified,
    listens,
    robot_at,
    secured_config,
)
from tests.system.harness import Bus, Daemon, Tables, acsard, finish, free_endpoint, until
from tests.system.identities import free_tls_endpoint

pytestmark = [pytest.mark.network, pytest.mark.timeout(60)]


@pytest.fixture
def where(tmp_path: Path) -> Path:
    certified(tmp_path, ITS_NAME)
    return tmp_path


def test_a_robot_reports_the_end_of_its_routers_certificate(where: Path) -> None:
    endpoint, plain = free_tls_endpoint(), free_endpoint()
    robot = where / "robot1"
    Authority.load(where).issue(robot, "robot1", [], 5)
    bus = {"listen": [plain], "connect": [endpoint], "tls": str(robot)}
    with acsard_router(where, endpoint) as router:
        listens(router)
        tables: Tables = {"robot": {"id": "robot1"}, "bus": bus}
        with Daemon(where, config=tables, endpoint=plain), Bus(plain, robot_id="robot1") as client:
            expiry = f"expires in 24 hours (certificate of the router {endpoint})"
            until(lambda: client.state()["certificate_expiry"] == expiry, 10.0, expiry)


@pytest.mark.parametrize("away_s", [0.0, pytest.param(11.0, marks=pytest.mark.nightly)])
def test_robots_stop_when_their_router_is_killed_and_only_a_live_program_drives_on(
    tmp_path: Path, away_s: float
) -> None:
    """The program of robot1 goes on, that of robot2 ends meanwhile, and robot3 is stopped."""
    names, endpoint = ("robot1", "robot2", "robot3"), free_tls_endpoint()
    certified(tmp_path, *names, "operator", ITS_NAME)
    with ExitStack() as stack:
        router = stack.enter_context(acsard_router(tmp_path, endpoint, names))
        listens(router)
        daemons = [robot_at(endpoint, tmp_path, name, ready=False) for name in names]
        for daemon in daemons:
            stack.enter_context(daemon)
        for daemon in daemons:
            daemon.says("bus ")
        config = secured_config(endpoint, tmp_path / "operator")
        first, second, third = (stack.enter_context(Member(config, name)) for name in names)
        for member in (first, second, third):
            member.linked()
        third.put("stop", {})
        third.comes_to("stopped")
        going, ending = (
            stack.enter_context(member.commanding(0.2, certificate="operator"))
            for member in (first, second)
        )
        for member in (first, second):
            member.comes_to("driving")

        router.signal(signal.SIGKILL)
        router.ended(5.0)

        def ready() -> bool:
            texts = [daemon.events("mode")[-1]["text"] for daemon in daemons[:2]]
            return all(text.startswith("driving -> ready") for text in texts)

        until(ready, 5.0, "both stop")
        ending.silence()
        time.sleep(away_s)
        listens(stack.enter_context(acsard_router(tmp_path, endpoint, names)))
        members = (first, second, third)
        until(lambda: all(member.ask("state") for member in members), 20.0, "all are connected")
        if away_s:
            until(lambda: "send a zero first" in first.state()["reason"], 10.0, "it waits")
        else:
            # Its program connects again later than its robot.
            until(lambda: first.state()["mode"] == "driving", 20.0, "it drives on")
        second.at_rest()
        assert third.state()["mode"] == "stopped"
        going.silence()
        first.at_rest()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_router(where: Path, number: signal.Signals) -> None:
    with acsard_router(where, free_tls_endpoint()) as router:
        listens(router)
        router.signal(number)
        assert router.ended(5.0) == 0


def test_an_address_in_use_ends_the_router_with_its_reason(where: Path) -> None:
    endpoint = free_tls_endpoint()
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    with (
        socket.create_server((host, int(port))),
        acsard_router(where, endpoint) as router,
    ):
        assert router.ended(10.0) == 1
        assert f"at {endpoint}: " in router.stderr


@pytest.mark.parametrize("text", ["{ mode", '{ mode: "peer" }'])
def test_an_invalid_router_file_ends_with_78(tmp_path: Path, text: str) -> None:
    (tmp_path / "zenoh.json5").write_text(text)
    done = finish(acsard("router", "zenoh.json5"), tmp_path)
    assert done.code == 78
    assert "zenoh.json5" in done.err
    assert "Traceback" not in done.err


def test_a_router_without_its_key_ends_with_one_sentence(where: Path) -> None:
    (where / ITS_NAME / "key.pem").unlink()
    with acsard_router(where, free_tls_endpoint()) as router:
        assert router.ended(10.0) == 78
        assert [
            line for line in router.err if f"cannot read {where / ITS_NAME / 'key.pem'}" in line
        ]
