"""A stranger on another host has no access to the robot, and can disturb it little by force.

The other host is a network namespace, which a virtual cable connects to the robot's namespace. The
tests with another host are skipped without root or without `ip`.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh

from tests.system.harness import (
    Bus,
    Daemon,
    Periods,
    Program,
    finish,
    free_endpoint,
    resident_kb,
    running,
    until,
)
from tests.system.hosts import Hosts, inside, on
from tests.system.identities import Certificates, Identity, free_tls_endpoint
from tests.system.strangers import command_line

pytestmark = pytest.mark.network

PORT, TLS_PORT = 7448, 7449

# another host


def daemon_on(host: str, where: Path, bus: dict[str, object]) -> AbstractContextManager[Daemon]:
    """Run a daemon on a host, with these settings in its `[bus]` table."""
    return on(host, Daemon(where, config={"bus": {"listen": NEAR} | bus}))


def visit(
    host: str, where: Path, endpoints: list[str], tls: dict[str, object] | None = None
) -> dict[str, Any]:
    """Run a stranger on this host for a second, and return its report of all it found and did."""
    arguments = [json.dumps(endpoints), json.dumps(tls)]
    with inside(host):
        done = finish(command_line(VISIT, 1.0, *arguments), where)
    assert done.code == 0, done
    report: dict[str, Any] = json.loads(done.out)
    return report


VISIT = """\
import json, sys, threading, time
import zenoh
seconds, endpoints, tls = float(sys.argv[1]), json.loads(sys.argv[2]), json.loads(sys.argv[3])
scouted, heard, counted, opened, own = set(), set(), [], [], []
scouting = zenoh.scout(lambda hello: scouted.add(str(hello.zid)), what="peer|router")

def visit(endpoint):
    config = zenoh.Config()
    if endpoint:
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        if tls:
            config.insert_json5("transport/link/tls", json.dumps(tls))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        return
    if endpoint:
        opened.append(endpoint)
    else:
        own.append(str(session.zid()))
    subscribers = [
        session.declare_subscriber(
            key, lambda s: heard.add(str(s.key_expr)), allowed_origin=zenoh.Locality.REMOTE
        )
        for key in ("**", "acsard/acsar/**", "acsard/acsar/odom")
    ]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for reply in session.get("acsard/acsar/state", timeout=0.2):
            if reply.ok:
                counters = json.loads(reply.ok.payload.to_bytes())["counters"]
                counted.append(counters.get("commands", 0))
        for key in ("acsard/acsar/cmd/app", "acsard/acsar/cmd/app/operator"):
            session.put(key, '{"linear": {"x": 0.0}, "angular": {"z": 0.0}}')
        time.sleep(0.05)
    session.close()

threads = [threading.Thread(target=visit, args=(endpoint,)) for endpoint in ["", *endpoints]]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
scouting.stop()
scouted -= set(own)
print(json.dumps({"scouted": sorted(scouted), "opened": opened, "heard": sorted(heard),
                  "counted": counted}))
"""
"""Scouts, joins as a peer without any configuration, and connects to each address.

There it looks, queries and commands for the given seconds. Prints the ids it scouted, the addresses
that admitted it, the keys it received, and the robot's command counts.
"""

ORDINARY = """\
import sys
import zenoh
session = zenoh.open(zenoh.Config())
print("here", session.zid(), flush=True)
sys.stdin.read()
"""
"""A Zenoh program without configuration, as a user runs it: other programs can discover it."""


NEAR = [f"tcp/127.0.0.1:{PORT}"]
FAR = [f"tcp/198.18.77.1:{port}" for port in (PORT, 7447)]


def test_a_stranger_on_another_host_neither_sees_nor_commands_the_default_daemon(
    hosts: Hosts, tmp_path: Path
) -> None:
    ordinary = Program(command_line(ORDINARY), tmp_path, stdin=subprocess.PIPE)
    with daemon_on(hosts.robot, tmp_path, {}), on(hosts.robot, ordinary):
        other = ordinary.says("here").split()[1]
        there = visit(hosts.stranger, tmp_path, FAR)
        # The discoverable program is found: the cable carries everything that scouting needs.
        assert there == {"scouted": [other], "opened": [], "heard": [], "counted": []}
        here = visit(hosts.robot, tmp_path, NEAR)
        assert here["scouted"] == [other]
        assert here["opened"] == NEAR
        assert "acsard/acsar/odom" in here["heard"]
        assert here["counted"][0] == 0, "a command of the stranger's arrived"
        assert here["counted"][-1] > 0


def test_a_stranger_drives_an_insecure_daemon_from_another_host(
    hosts: Hosts, tmp_path: Path
) -> None:
    with daemon_on(hosts.robot, tmp_path, {"listen": [f"tcp/0.0.0.0:{PORT}"], "insecure": True}):
        there = visit(hosts.stranger, tmp_path, FAR)
    assert there["opened"] == FAR[:1]
    assert "acsard/acsar/odom" in there["heard"]
    assert there["counted"][-1] > there["counted"][0] == 0


def test_over_the_network_the_certificate_decides(hosts: Hosts, tmp_path: Path) -> None:
    certificates = Certificates(tmp_path, "198.18.77.1")
    listen = [*NEAR, f"tls/0.0.0.0:{TLS_PORT}"]
    endpoints = [*FAR, f"tls/198.18.77.1:{TLS_PORT}"]
    with daemon_on(hosts.robot, tmp_path, {"listen": listen, "tls": str(certificates.robot)}):
        without = visit(hosts.stranger, tmp_path, endpoints, certificates.settings(own=None))
        assert without == {"scouted": [], "opened": [], "heard": [], "counted": []}
        own = certificates.robot / "clients" / "operator"
        there = visit(hosts.stranger, tmp_path, endpoints, certificates.settings(own))
        assert there["opened"] == endpoints[-1:]
        assert "acsard/acsar/odom" in there["heard"]
        assert there["counted"][-1] > there["counted"][0] == 0


# by force


ATTACK = """\
import json, os, socket, sys, time
import zenoh
kind, doors, settings, seconds, count = sys.argv[1:]
doors, seconds, count = json.loads(doors), float(seconds), int(count)
os.nice(19)

def session(door):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([door]))
    config.insert_json5("transport/link/tls", settings)
    return zenoh.open(config)

def connection(door):
    host, _, port = door.partition("/")[2].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=0.1)

done, held, end = 0, [], time.monotonic() + seconds
if kind in ("flood", "huge"):
    sessions = [session(door) for door in doors]
    print("begun", flush=True)
    end = time.monotonic() + seconds
if kind == "flood":
    twist = b'{"linear": {"x": 0.0}, "angular": {"z": 0.0}}'
    keys = ("cmd/app", "cmd/ghost", "stop/x", "srv/stop", "more")
    puts = [s.declare_publisher("acsard/acsar/" + key).put for s in sessions for key in keys]
    while time.monotonic() < end:
        for put in puts:
            put(twist)
        done += len(keys)
elif kind == "huge":
    big, block = bytes(200 * 2**20), zenoh.CongestionControl.BLOCK
    while not done or time.monotonic() < end:
        for one in sessions:
            one.put("acsard/acsar/cmd/app", big, congestion_control=block)
        done += 1
elif kind == "idle":
    while done < count:
        held += [connection(door) for door in doors]
        done += 1
    print("begun", done, flush=True)
    time.sleep(seconds)
else:
    print("begun", flush=True)
    while done < count or time.monotonic() < end:
        for door in doors:
            try:
                with connection(door) as one:
                    one.sendall(os.urandom(512))
            except OSError:
                pass  # shut in our face
        done += 1
print("done", done, flush=True)
os._exit(0)
"""
"""Disturbs several endpoints at once in one way, for given seconds and at least given times.

It yields the processor to all others: the test does not measure its own work.
"""


class Figures(NamedTuple):
    """How a period of time affected the robot, clients that were connected, and new clients."""

    periods: Periods
    calm: Periods
    """The periods of a second daemon that no client attacked: the cost of the machine itself."""
    grown_kb: int
    answered: float
    """The longest wait of a connected operator for an answer, s."""
    entered: float
    """The longest wait of a newcomer until it is connected and answered, s."""
    came: int

    def __str__(self) -> str:
        return (
            f"{self.periods.missed} of {self.periods.elapsed:.0f} periods missed (in calm "
            f"{self.calm.missed}), {self.periods.superseded} superseded, memory "
            f"{self.grown_kb:+d} kB, answered within {1e3 * self.answered:.0f} ms, "
            f"{self.came} came in within {1e3 * self.entered:.0f} ms"
        )


class Robot:
    """A daemon with a plain and a TLS endpoint."""

    def __init__(self, where: Path, certificates: Certificates, calm: Bus) -> None:
        self._where, self._certificates, self._calm = where, certificates, calm
        self.plain, self.tls = free_endpoint(), free_tls_endpoint()
        bus = {"listen": [self.plain, self.tls], "tls": str(certificates.robot)}
        self.daemon = Daemon(where, config={"bus": bus}, endpoint=self.plain)

    def __enter__(self) -> Robot:
        self.daemon.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.daemon.__exit__()

    @contextmanager
    def attacked(
        self, kind: str, doors: list[str], seconds: float, count: int = 0
    ) -> Iterator[Program]:
        """Run an attack of this kind on these endpoints, and yield its process.

        The attacker has a viewer's certificate for attacks that need one.
        """
        viewer = self._certificates.robot / "clients" / "viewer"
        settings = json.dumps(self._certificates.settings(viewer))
        arguments = (kind, json.dumps(doors), settings, seconds, count)
        with Program(command_line(ATTACK, *arguments), self._where) as attack:
            attack.says("begun")
            yield attack

    def watched(
        self,
        during: Callable[[], AbstractContextManager[Callable[[], bool]]],
        comers: tuple[Identity, ...] = ("local", "operator"),
    ) -> Figures:
        """Measure the robot and its clients while `during` goes on.

        Each identity in `comers` connects again and again as a new client.
        """
        own = self._certificates.config("operator", self.plain, self.tls)
        with Bus(self.plain) as bus, zenoh.open(own) as operator:
            bus.linked()
            memory = resident_kb(self.daemon.pid)
            grown = 0
            answered: list[float] = []
            entered: list[float] = []
            before, calm_before = bus.state(), self._calm.state()
            with during() as going_on:
                while not answered or going_on():
                    answered.append(_answered(operator))
                    entered += [self._entered(identity) for identity in comers]
                    grown = max(grown, resident_kb(self.daemon.pid) - memory)
            periods = Periods.between(before, bus.state())
            calm = Periods.between(calm_before, self._calm.state())
        return Figures(periods, calm, grown, max(answered), max(entered, default=0.0), len(entered))

    def _entered(self, identity: Identity) -> float:
        """Connect as a new client, and return the time until the daemon answered it, s."""
        config = self._certificates.config(identity, self.plain, self.tls)
        begun = time.monotonic()

        def enter() -> bool:
            try:
                with zenoh.open(config) as session:
                    _answered(session)
            except (zenoh.ZError, AssertionError):
                return False
            return True

        until(enter, 20.0, f"{identity} gets in")
        return time.monotonic() - begun


def _answered(session: zenoh.Session) -> float:
    """Query the `state`, and return the time until the answer came, s."""
    begun = time.monotonic()
    assert any(reply.ok for reply in session.get("acsard/acsar/state", timeout=5.0))
    return time.monotonic() - begun


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """Provide a client of a daemon that is not attacked."""
    with running(tmp_path_factory.mktemp("calm")) as (_, bus):
        yield bus


@pytest.fixture
def robot(tmp_path: Path, certificates: Certificates, calm: Bus) -> Iterator[Robot]:
    """Provide a new daemon for each test, because the effects of an attack last."""
    with Robot(tmp_path, certificates, calm) as robot:
        yield robot


def hold(
    robot: Robot,
    kind: str,
    seconds: float,
    doors: tuple[str, ...] = ("tcp", "tls"),
    comers: tuple[Identity, ...] = ("local", "operator"),
    count: int | None = None,
) -> None:
    """Attack these endpoints, and check that connected and new clients still get their answers."""
    at = [door for door in (robot.plain, robot.tls) if door.startswith(doors)]
    times = TIMES[kind] if count is None else count

    @contextmanager
    def attack() -> Iterator[Callable[[], bool]]:
        # The idle attackers stay for longer than the test watches; the others end by themselves.
        lasts = 60.0 if kind == "idle" else seconds
        with robot.attacked(kind, at, lasts, times) as program:
            end = time.monotonic() + seconds
            yield lambda: program.process.poll() is None and time.monotonic() < end
            if kind != "idle":
                assert program.ended(20.0) == 0, program
        print(f"\n{kind} at {' and '.join(doors)}: {program.stdout.split()[-1]}", end="")

    figures = robot.watched(attack, comers)
    print(f" times; {figures}")
    # A few periods in either direction are the machine's. With two cores and other tests it is a
    # poor reference.
    assert figures.periods.missed <= 2 * figures.calm.missed + 0.01 * figures.periods.elapsed + 4
    assert figures.grown_kb < 64_000
    assert figures.answered < 1.0
    assert figures.entered < 2.0
    assert robot.daemon.process.poll() is None


TIMES = {"flood": 0, "huge": 0, "idle": 300, "garbage": 3000}
"""The kinds of attack, and the least number of connections that each makes to an endpoint."""

SHORT, LONG = 0.5, pytest.param(20.0, marks=pytest.mark.soak)


@pytest.mark.parametrize("seconds", [SHORT, LONG])
@pytest.mark.parametrize("kind", ["flood", "huge"])
def test_floods_and_huge_messages_cost_no_tick_and_keep_no_client_out(
    robot: Robot, kind: str, seconds: float
) -> None:
    hold(robot, kind, seconds)


@pytest.mark.parametrize("seconds", [SHORT, LONG])
def test_idle_plain_connections_cost_no_tick_and_keep_no_client_out(
    robot: Robot, seconds: float
) -> None:
    hold(robot, "idle", seconds, doors=("tcp",))


def test_idle_tls_connections_cost_no_tick_and_keep_no_client_out(
    robot: Robot,
) -> None:
    hold(robot, "idle", SHORT, doors=("tls",))


@pytest.mark.parametrize("seconds", [SHORT, LONG])
def test_garbage_at_the_plain_endpoint_costs_no_tick_and_keeps_no_client_out(
    robot: Robot, seconds: float
) -> None:
    hold(robot, "garbage", seconds, doors=("tcp",))


@pytest.mark.parametrize("seconds", [SHORT, LONG])
def test_garbage_at_the_tls_endpoint_disturbs_no_loop_and_no_connected_or_plain_client(
    robot: Robot, seconds: float
) -> None:
    count = 300 if seconds == SHORT else None  # because the daemon accepts 10 a second
    hold(robot, "garbage", seconds, doors=("tls",), comers=("local",), count=count)


@pytest.mark.xfail(
    strict=True,
    reason="Zenoh 1.10 waits 100 ms after each TLS handshake that fails, or that is not made in "
    "10 s, before it accepts the next (eclipse-zenoh/zenoh issue 2685); no setting mends that",
)
def test_garbage_at_the_tls_endpoint_keeps_no_operator_out(robot: Robot) -> None:
    hold(robot, "garbage", 0.0, doors=("tls",), comers=("operator",), count=25)
