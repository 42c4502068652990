"""The TLS gateway's process restarts whenever it ends, and ends with the daemon."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.bus.certificate_watch import FILES_CHECK_PERIOD_NS
from acsard.bus.tls_files import KEY, peer_ends_ns
from acsard.core.config.settings import BusConfig, Config
from acsard.core.values import NS_PER_S
from acsard.daemon.gateway.tls_gateway import Gateway
from acsard.host.errors import InUseError
from acsard.machine.authority import Authority
from tests.system.harness import (
    Bus,
    children,
    free_endpoint,
    until,
)
from tests.system.identities import Certificates, Gated

pytestmark = pytest.mark.network


def gateway_of(robot: Gated) -> int:
    """Return the pid of the gateway's process."""
    (pid,) = until(lambda: children(robot.daemon.pid, "acsard gateway"), 5.0, "a gateway")
    return pid


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certificates"))


@pytest.fixture
def robot(tmp_path: Path, certificates: Certificates) -> Iterator[Gated]:
    robot = Gated(tmp_path, certificates)
    with robot.daemon:
        yield robot


def has_ended(pid: int) -> bool:
    """Return whether the process has ended. A zombie counts as ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_a_gateway_that_is_killed_is_restarted_and_counted(robot: Gated) -> None:
    assert robot.lets_in("viewer")
    first = gateway_of(robot)
    with Bus(robot.daemon.endpoint) as bus:
        until(
            lambda: bus.count("gateway_opened") == 1,
            5.0,
            "the gateway has reported that it is open",
        )
    os.kill(first, signal.SIGKILL)
    robot.daemon.gateway_opens(times=2)
    assert robot.lets_in("viewer")
    assert gateway_of(robot) != first
    (line,) = robot.daemon.events("gateway_ended")
    assert "ended by signal 9" in line["text"]
    with Bus(robot.daemon.endpoint) as bus:
        until(lambda: bus.count("gateway_opened") == 2, 5.0, "it is counted")


@pytest.mark.nightly
def test_a_new_certificate_is_used_and_the_daemon_runs_on(tmp_path: Path) -> None:
    certificates = Certificates(tmp_path / "own")
    robot, own = Gated(tmp_path, certificates), certificates.robot
    with robot.daemon:
        assert robot.lets_in("viewer")
        before_ns = peer_ends_ns(robot.tls, str(own))
        key = (own / KEY).read_bytes()
        Authority.load(own).issue(own, "robot", ["127.0.0.1"], 0.5)
        new = (own / KEY).read_bytes()
        (own / KEY).write_bytes(key)  # as long as a person has copied only a part of the files
        time.sleep(3 * FILES_CHECK_PERIOD_NS / NS_PER_S)
        assert len(robot.daemon.events("gateway_open")) == 1
        (own / KEY).write_bytes(new)
        robot.daemon.gateway_opens(times=3)  # the second line says that it opens again
        assert "restarts with its new certificate" in robot.daemon.events("gateway_open")[1]["text"]
        assert robot.lets_in("viewer")
        after_ns = peer_ends_ns(robot.tls, str(own))
        assert before_ns is not None
        assert after_ns is not None
        assert after_ns < before_ns
        with Bus(robot.daemon.endpoint) as bus:
            until(lambda: bus.count("gateway_opened") == 2, 5.0, "it is counted")
            # The new certificate of this test ends after half a day.
            expiry = "expires in 12 hours"
            until(lambda: bus.state()["certificate_expiry"] == expiry, 5.0, expiry)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_gateway_closes_with_the_daemon(robot: Gated, number: signal.Signals) -> None:
    gateway = gateway_of(robot)
    robot.daemon.signal(number)
    robot.daemon.ended(5.0)
    until(lambda: has_ended(gateway), 1.0, "it closes")
    assert not robot.lets_in("viewer")


def test_no_gateway_that_hangs_outlives_its_daemon(robot: Gated) -> None:
    gateway = gateway_of(robot)
    os.kill(gateway, signal.SIGSTOP)
    robot.daemon.signal(signal.SIGTERM)
    begun = time.monotonic()
    assert robot.daemon.ended(2.0) == 0, robot.daemon
    until(
        lambda: has_ended(gateway), 1.0, f"gone, {time.monotonic() - begun:.1f} s after the signal"
    )


@pytest.mark.parametrize("paused", ["daemon", "gateway"])
def test_a_stop_over_tls_that_waits_for_longer_than_two_seconds_stops_the_robot(
    robot: Gated, paused: str
) -> None:
    until(lambda: robot.lets_in("viewer"), 5.0, "it is open")
    with robot.opened("viewer") as viewer, Bus(robot.daemon.endpoint) as bus:
        assert any(reply.ok for reply in viewer.get("acsard/acsar/state", timeout=3.0))
        assert bus.state()["mode"] != "stopped"
        pid = robot.daemon.pid if paused == "daemon" else gateway_of(robot)
        os.kill(pid, signal.SIGSTOP)
        try:
            viewer.put("acsard/acsar/stop", b"")
            # The supervisor of the gateway ends a gateway that is paused for 3 s.
            time.sleep(2.4)
        finally:
            os.kill(pid, signal.SIGCONT)
        with Bus(robot.daemon.endpoint) as other:
            until(lambda: other.state()["mode"] == "stopped", 5.0, "the stop arrives")
        if paused == "gateway":
            assert gateway_of(robot) == pid


def gateway_with(own: Path, tls: str) -> Gateway:
    bus = BusConfig(listen=(free_endpoint(), tls), tls=str(own))
    return Gateway(replace(Config(), bus=bus))


def test_an_address_in_use_is_not_a_bad_certificate(certificates: Certificates) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        tls = f"tls/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(
            InUseError, match=f"cannot listen on {tls}: Address already in use; .*stop that program"
        ):
            gateway_with(certificates.robot, tls).open()
