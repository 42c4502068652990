"""`acsard router` routes until a signal ends it, and says why it cannot start."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

from acsard.machine.authority import Authority
from tests.system.fleet_router import ITS_NAME, acsard_router, certified
from tests.system.harness import Bus, Daemon, Program, Tables, acsard, finish, free_endpoint, until
from tests.system.identities import free_tls_endpoint

pytestmark = [pytest.mark.network, pytest.mark.timeout(60)]


def listens(program: Program) -> None:
    until(lambda: "router_open" in program.stderr, 10.0, f"the router listens\n{program}")


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
