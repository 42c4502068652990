"""A crowd of connections from another host moves no robot and costs no control period.

The crowd has no token. While it connects, a phone that has opened the page drives on, and a browser
on the robot itself stops the robot. After the crowd has gone, the page works again for a new phone.
With `-s` pytest prints the figures of each crowd.
"""

from __future__ import annotations

import http.client
import json
import math
import ssl
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from acsard.machine.authority import Authority
from acsard.web.connections import MAX_CONNECTIONS
from tests.system.browser import Page
from tests.system.bystander import lost
from tests.system.harness import (
    PATIENCE_S,
    Daemon,
    Periods,
    Program,
    free_endpoint,
    kept_waiting,
    resident_kb,
    until,
)
from tests.system.hosts import ROBOT_AT, STRANGER_AT, Hosts, inside, ip, on
from tests.system.strangers import command_line

pytestmark = pytest.mark.network

ROBOT_6 = "fd00:77::1"
OLDER = [f"198.18.77.{n}" for n in range(11, 16)]
NEWER = [f"fd00:77::a:{n:x}" for n in range(1, 65)]

MORE_KB = 0.5 * 1000 * MAX_CONNECTIONS
"""The buffers of as many TLS connections as the page accepts, 0.5 MB each."""

HERE_S = 0.05
"""The time of a stop from the robot itself."""

BACK_S = 10.0
"""The time after the end of a crowd in which a new phone can stop the robot."""

CROWD = """\
import os, resource, socket, ssl, sys, time
os.nice(19)
kind, host, port, count, *sources = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_NOFILE, (8192, 8192))
trusting = ssl._create_unverified_context()
kept = []
for n in range(int(count)):
    one = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    one.bind((sources[n % len(sources)], 0))
    one.settimeout(5.0)
    try:
        one.connect((host, int(port)))
        if kind == "tls":
            one = trusting.wrap_socket(one)
        elif kind == "hello":
            one.sendall(b"\\x16\\x03\\x01\\x02\\x00\\x01")
    except OSError:
        pass
    kept.append(one)
print("opened", flush=True)
time.sleep(600)
"""
"""Opens connections from these addresses in turn and keeps them idle.

They are silent, or have TLS, or have sent the beginning of its first message.
"""

CROWDS: dict[str, tuple[str, int, Sequence[str]]] = {
    "2500 silent": ("silent", 2500, OLDER),
    "300 idle TLS of 5 addresses": ("tls", 300, OLDER),
    "300 beginnings of TLS of 5 addresses": ("hello", 300, OLDER),
    "300 idle TLS of a /64": ("tls", 300, NEWER),
}


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("crowds")
    names = [ROBOT_AT, ROBOT_6]
    Authority.make(where / "tls", "test", 1, names).issue(where / "tls", "robot", names, 1)
    return where


@pytest.fixture(scope="module")
def robot(hosts: Hosts, where: Path) -> Iterator[Daemon]:
    ip("-n", hosts.robot, "address", "add", f"{ROBOT_6}/64", "dev", "cable", "nodad")
    for address in OLDER:
        ip("-n", hosts.stranger, "address", "add", f"{address}/24", "dev", "cable")
    for address in NEWER:
        ip("-n", hosts.stranger, "address", "add", f"{address}/64", "dev", "cable", "nodad")
    with on(hosts.robot, Daemon(where)) as daemon:
        yield daemon


class Scene:
    """The robot's page, and a crowd on another host."""

    def __init__(self, hosts: Hosts, robot: Daemon, where: Path, crowd: str) -> None:
        self._hosts, self._stack = hosts, ExitStack()
        newer = f"https://[{ROBOT_6}]:{free_endpoint().rpartition(':')[2]}"
        page = Page(robot, where, "--address", newer, at=ROBOT_AT)
        self.page = self._stack.enter_context(on(hosts.robot, page))
        kind, count, sources = CROWDS[crowd]
        at = newer if ":" in sources[0] else self.page.away
        host, _, port = at.removeprefix("https://").rpartition(":")
        self._words = command_line(CROWD, kind, host.strip("[]"), port, count, *sources)
        self.token = self.page.invite("operator", f"phone-{time.time_ns()}")
        self._trusted = ssl.create_default_context(cafile=str(self.page.tls / "ca.pem"))

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *error: object) -> None:
        self.goes()
        assert error[0] is not None or self.page.process.poll() is None
        assert "Traceback" not in self.page.stderr
        self._stack.close()

    def comes(self) -> None:
        """Start the crowd, and wait until it has opened all its connections."""
        self.crowd = Program(self._words, self.page.tls)
        with inside(self._hosts.stranger):
            self.crowd.__enter__()
        self.crowd.says("opened", PATIENCE_S)

    def goes(self) -> None:
        if hasattr(self, "crowd"):
            self.crowd.__exit__()
            del self.crowd

    def ask_here(self, path: str, payload: object = None) -> Any:
        """Send a request from the robot itself, and return the answer."""
        with inside(self._hosts.robot):
            place = self.page.here.removeprefix("http://")
            return _asked(http.client.HTTPConnection(place, timeout=PATIENCE_S), path, payload)

    def works_away(self) -> bool:
        """Return whether a new connection of a phone stops the robot. Release the stop."""
        with inside(self._hosts.stranger):
            connection = http.client.HTTPSConnection(
                self.page.away.removeprefix("https://"), timeout=2.0, context=self._trusted,
                source_address=(STRANGER_AT, 0),
            )  # fmt: skip
            bearer = {"Authorization": f"Bearer {self.token}"}
            try:
                _asked(connection, "/api/srv/stop", {}, **bearer)
            except (OSError, http.client.HTTPException, AssertionError):
                return False
        causes = self.ask_here("/api/state")["causes"]
        numbers = [cause["number"] for cause in causes]
        return bool(self.ask_here("/api/srv/clear", {"numbers": numbers})["success"])


def _asked(
    connection: http.client.HTTPConnection, path: str, payload: object, **headers: str
) -> Any:
    try:
        body = None if payload is None else json.dumps(payload)
        headers["Content-Type"] = "application/json"
        connection.request("GET" if body is None else "POST", path, body, headers)
        answer = connection.getresponse()
        told = json.loads(answer.read())
    finally:
        connection.close()
    assert answer.status == 200, told
    return told


@pytest.mark.parametrize(
    "crowd",
    [pytest.param(crowd, marks=pytest.mark.nightly if n else ()) for n, crowd in enumerate(CROWDS)],
)
def test_a_crowd_without_a_token_moves_no_robot_costs_no_period_and_leaves_a_page_that_works(
    hosts: Hosts, robot: Daemon, where: Path, crowd: str
) -> None:
    with Scene(hosts, robot, where, crowd) as scene:
        until(scene.works_away, BACK_S, "the page works before")
        kb = resident_kb(scene.page.pid)
        before, waited = scene.ask_here("/api/state"), kept_waiting(robot.pid)
        scene.comes()
        time.sleep(1.0)
        after, waited = scene.ask_here("/api/state"), kept_waiting(robot.pid) - waited
        more = resident_kb(scene.page.pid) - kb
        took = min(_timed(lambda: scene.ask_here("/api/srv/stop", {})) for _ in range(5))
        scene.goes()
        begun = time.monotonic()
        until(scene.works_away, BACK_S, "the page works for a new phone")
        back = time.monotonic() - begun
    moved = math.hypot(after["x"] - before["x"], after["y"] - before["y"])
    missed = Periods.between(before, after).missed
    print(f"\n{more / 1000:+.1f} MB, moved {1000 * moved:.1f} mm, {missed} periods missed "
          f"({waited:.2f} s without a core), a stop from here {1000 * took:.0f} ms, back after "
          f"{back:.2f} s")  # fmt: skip
    assert moved < 0.001
    assert missed <= 100.0 * waited
    assert took < HERE_S
    assert more < MORE_KB


def _timed(call: Callable[[], object]) -> float:
    begun = time.monotonic()
    call()
    took = time.monotonic() - begun
    return max(0.0, took - 4 * lost(begun, begun + took))
