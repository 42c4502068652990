"""A stranger on another host has no access to the robot, and can disturb it little by force.

The other host is a network namespace, which a virtual cable connects to the robot's namespace. The
tests with another host are skipped without root or without `ip`.
"""

from __future__ import annotations

import json
import subprocess
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Periods,
    Program,
    finish,
    resident_kb,
    until,
)
from tests.system.hosts import Hosts, inside, on
from tests.system.identities import Certificates, Gated
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
kind, door, settings, seconds, count = sys.argv[1:]
seconds, count = float(seconds), int(count)
os.nice(19)

def session():
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([door]))
    config.insert_json5("transport/link/tls", settings)
    return zenoh.open(config)

def connection():
    host, _, port = door.partition("/")[2].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=0.1)

done, held = 0, []
visitor = session() if kind in ("flood", "huge") else None
print("begun", flush=True)
end = time.monotonic() + seconds
if kind == "flood":
    twist = b'{"linear": {"x": 0.0}, "angular": {"z": 0.0}}'
    keys = ("cmd/app", "cmd/ghost", "stop/x", "srv/stop", "more")
    puts = [visitor.declare_publisher("acsard/acsar/" + key).put for key in keys]
    while time.monotonic() < end:
        for put in puts:
            put(twist)
elif kind == "huge":
    big, block = bytes(200 * 2**20), zenoh.CongestionControl.BLOCK
    while not done or time.monotonic() < end:
        visitor.put("acsard/acsar/cmd/app", big, congestion_control=block)
        done += 1
elif kind == "idle":
    while done < count:
        held.append(connection())
        done += 1
    time.sleep(60)
else:
    while done < count:
        try:
            with connection() as one:
                one.sendall(os.urandom(512))
        except OSError:
            pass  # shut in our face
        done += 1
os._exit(0)
"""
"""Disturbs an endpoint in one way, for given seconds or given times.

It yields the processor to all others: the test does not measure its own work.
"""


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certificates"))


def attacked(robot: Gated, kind: str, count: int) -> tuple[Periods, int, float, float]:
    """Attack the TLS gateway of a daemon. The attacker may make that unreachable, and nothing else.

    It has a viewer's certificate for attacks that need one. Returns the control periods, the
    daemon's growth in kB, and the longest waits of a connected client on the robot's machine for an
    answer, and of a new one until it is connected and answered, in s.
    """
    viewer = json.dumps(robot.certificates.settings(robot.certificates.own("viewer")))
    words = command_line(ATTACK, kind, robot.tls, viewer, ATTACK_S, count)
    answers, entries, most_kb = [0.0], [0.0], 0
    with robot.daemon, Bus(robot.plain) as bus:
        bus.linked()
        memory_kb, before = resident_kb(robot.daemon.pid), bus.state()
        with Program(words, robot.daemon.config.parent) as attack:
            attack.says("begun")
            end = time.monotonic() + max(ATTACK_S, count / 1000)
            while len(entries) == 1 or (attack.process.poll() is None and time.monotonic() < end):
                answers.append(answered(bus.session))
                begun = time.monotonic()
                until(lambda: robot.lets_in("local"), 20.0, "it gets in")
                entries.append(time.monotonic() - begun - lost(begun))
                most_kb = max(most_kb, resident_kb(robot.daemon.pid) - memory_kb)
        periods = Periods.between(before, bus.state())
    return periods, most_kb, max(answers), max(entries)


ATTACK_S = 0.5


def answered(session: zenoh.Session) -> float:
    """Query the `state`, and return the time until the answer came, less the machine's, s."""
    begun = time.monotonic()
    assert any(reply.ok for reply in session.get("acsard/acsar/state", timeout=5.0))
    return time.monotonic() - begun - lost(begun)


@pytest.mark.parametrize(
    ("kind", "count"),
    [pytest.param("flood", 0, marks=pytest.mark.nightly), ("huge", 0), ("idle", 300),
     ("garbage", 25)],
)  # fmt: skip
def test_an_attack_by_force_costs_no_tick_and_keeps_no_local_client_out(
    tmp_path: Path, certificates: Certificates, kind: str, count: int
) -> None:
    begun = time.monotonic()
    robot = Gated(tmp_path, certificates)
    periods, grown_kb, answered_s, took_s = attacked(robot, kind, count)
    print(f"{kind}: {periods}, {grown_kb:+d} kB, {answered_s:.3f} s, {took_s:.3f} s")
    assert periods.missed <= 0.01 * periods.elapsed + 4 + 100.0 * lost(begun)
    assert grown_kb < 64_000
    assert answered_s < 1.0
    assert took_s < 2.0
