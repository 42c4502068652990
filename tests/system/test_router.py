"""`acsard router` restarts its router after any failure, until a signal ends it."""

from __future__ import annotations

import os
import signal
import socket
from pathlib import Path
from unittest import mock

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from acsard.bus.tls import peer_ends_ns
from acsard.machine.authority import Authority
from tests.system.fleet_router import ITS_NAME, certified, watched_router
from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    Tables,
    acsard,
    children,
    finish,
    free_endpoint,
    until,
)
from tests.system.identities import free_tls_endpoint

pytestmark = [pytest.mark.network, pytest.mark.timeout(60)]


def listens(program: Program, times: int = 1) -> None:
    """Wait until the log shows that the router has started to listen for the nth time."""
    until(
        lambda: sum("router_open" in line for line in list(program.err)) >= times,
        10.0,
        f"the router listens\n{program}",
    )


def the_router(program: Program) -> int:
    """Return the process id of the supervised router."""
    return until(lambda: children(program.pid, "--supervised"), 5.0, "its process")[0]


def has_ended(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


@pytest.fixture
def where(tmp_path: Path) -> Path:
    certified(tmp_path, ITS_NAME)
    return tmp_path


def test_a_router_that_is_killed_is_restarted(where: Path) -> None:
    with watched_router(where, free_tls_endpoint()) as router:
        listens(router)
        first = the_router(router)
        os.kill(first, signal.SIGKILL)
        listens(router, 2)
        assert the_router(router) != first
        assert "was ended by signal 9" in router.stderr


@pytest.mark.nightly
def test_a_router_that_is_suspended_is_ended_and_restarted(where: Path) -> None:
    with watched_router(where, free_tls_endpoint()) as router:
        listens(router)
        first = the_router(router)
        os.kill(first, signal.SIGSTOP)
        listens(router, 2)
        assert has_ended(first)
        assert "stopped or hung" in router.stderr


@pytest.mark.nightly
def test_the_router_restarts_with_a_new_certificate(where: Path) -> None:
    endpoint = free_tls_endpoint()
    with watched_router(where, endpoint) as router:
        listens(router)
        before_ns = peer_ends_ns(endpoint, str(where / ITS_NAME))
        Authority.load(where, lambda: "").issue(where / ITS_NAME, ITS_NAME, ["127.0.0.1"], 0.5)
        listens(router, 3)
        assert "restarts with its new certificate" in router.stderr
        after_ns = peer_ends_ns(endpoint, str(where / ITS_NAME))
        assert before_ns is not None
        assert after_ns is not None
        assert after_ns < before_ns


@pytest.mark.nightly
def test_the_router_stays_open_if_zenoh_refuses_a_new_certificate(where: Path) -> None:
    endpoint, own = free_tls_endpoint(), where / ITS_NAME
    with watched_router(where, endpoint) as router:
        listens(router)
        before_ns = peer_ends_ns(endpoint, str(own))
        assert before_ns is not None
        # OpenSSL accepts a key of this curve, and Zenoh does not.
        authority = Authority.load(where, lambda: "")
        with mock.patch.object(ec, "SECP256R1", ec.SECP521R1):
            authority.issue(own, ITS_NAME, ["127.0.0.1"], 0.5)
        until(lambda: "goes on with its old certificate" in router.stderr, 10.0, "it says so")
        client = where / "client"
        authority.issue(client, "client", [], 5)
        assert peer_ends_ns(endpoint, str(client)) == before_ns
        assert "restarted" not in router.stderr
        authority.issue(own, ITS_NAME, ["127.0.0.1"], 0.5)
        until(lambda: "restarts with its new certificate" in router.stderr, 10.0, "it opens")


def test_a_robot_reports_the_end_of_its_routers_certificate(where: Path) -> None:
    endpoint, plain = free_tls_endpoint(), free_endpoint()
    robot = where / "robot1"
    Authority.load(where, str).issue(robot, "robot1", [], 5)
    bus = {"listen": [plain], "connect": [endpoint], "tls": str(robot)}
    with watched_router(where, endpoint) as router:
        listens(router)
        tables: Tables = {"robot": {"id": "robot1"}, "bus": bus}
        with Daemon(where, config=tables, endpoint=plain), Bus(plain, robot_id="robot1") as client:
            expiry = f"expires in 1 days (certificate of the router {endpoint})"
            until(lambda: client.state()["certificate_expiry"] == expiry, 10.0, expiry)


@pytest.mark.variations(3)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_signal_ends_the_router_and_its_child_process(
    where: Path, number: signal.Signals
) -> None:
    with watched_router(where, free_tls_endpoint()) as router:
        listens(router)
        inner = the_router(router)
        router.signal(number)
        assert router.ended(5.0) == (-number if number == signal.SIGKILL else 0)
        until(lambda: has_ended(inner), 5.0, "nothing of it is left")


def test_an_address_in_use_is_reported_and_retried(where: Path) -> None:
    endpoint = free_tls_endpoint()
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    with (
        socket.create_server((host, int(port))) as other,
        watched_router(where, endpoint) as router,
    ):
        until(lambda: "ended with exit code 75" in router.stderr, 10.0, "the exit is reported")
        assert f"cannot listen on {endpoint}" in router.stderr
        other.close()
        listens(router)


@pytest.mark.parametrize("text", ["{ mode", '{ mode: "peer" }'])
def test_an_invalid_router_file_ends_with_78(tmp_path: Path, text: str) -> None:
    (tmp_path / "zenoh.json5").write_text(text)
    done = finish(acsard("router", "zenoh.json5"), tmp_path)
    assert done.code == 78
    assert "zenoh.json5" in done.err
    assert "Traceback" not in done.err


def test_a_router_without_its_key_ends_with_78_and_one_sentence(where: Path) -> None:
    (where / ITS_NAME / "key.pem").unlink()
    with watched_router(where, free_tls_endpoint()) as router:
        assert router.ended(10.0) == 78
        assert [
            line for line in router.err if "private key" in line and "this user can read" in line
        ]
        assert "gateway" not in router.stderr
