"""A client that is admitted over TLS cannot disturb the loop, the stop or the other users.

Each attack is tried with a viewer's or an unlisted certificate, while a local client drives. It
goes to the robot's own TLS gateway, or to the router of a fleet with this robot.
"""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, cast

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.fleet_router import ITS_NAME, acsard_router, certified, tls_settings
from tests.system.harness import (
    Bus,
    Daemon,
    FarPeer,
    Periods,
    Program,
    Tables,
    client_config,
    free_endpoint,
    resident_kb,
    until,
    wheels,
)
from tests.system.identities import Certificates, Identity, free_tls_endpoint
from tests.system.strangers import HOSTILE, command_line

pytestmark = [pytest.mark.network, pytest.mark.timeout(120)]

ATTACK_S = 1.5
GROWTH_KB = 20_000
STOP_S = 0.05
BACK_S = 2.0

FORMS = (
    "subscribe", "chunk", "late", "ros", "alive", "token", "ask", "serve", "name", "many",
    "many_chunks", "many_exact", "publish", "querier", "sessions", "come_and_go", "flood",
    "as_router", "as_peer", "may_ask",
)  # fmt: skip

HALT = ("may_stop", "may_call")
"""Attacks that stop the robot.

Any client that sees the robot may stop it; it then stands and no client drives on.
"""

HOLD_UP = ("publish", "querier", "as_peer")
"""Attacks that the rules of a router do not cover: they block it, and a person must restart it."""


class Figures(NamedTuple):
    """The measured effects of an attack."""

    periods: Periods
    stop_s: float
    """Time from a local `stop` to the first slower line, less what the machine took."""
    grown_kb: int
    back_s: float
    """Time until an operator gets an answer after the attacker has gone."""
    taken_s: float
    """The time that the machine took meanwhile from a bare process."""


class Network(NamedTuple):
    """How other hosts reach a robot: over its gateway or over a router."""

    tls: str
    """The endpoint."""
    shown: Callable[[Identity], dict[str, object]]
    """Zenoh's `transport/link/tls` of a client that comes there."""
    tables: Tables
    """The settings that it needs in the robot's configuration."""
    robot: str = "acsar"


class Robot:
    """A robot that a local client drives."""

    def __init__(self, where: Path, network: Network) -> None:
        self._where, self._network, self._plain = where, network, free_endpoint()
        self._peer = FarPeer(where)
        self._root = f"acsard/{network.robot}"
        tables = {name: dict(table) for name, table in network.tables.items()}
        tables["bus"]["listen"] = [self._plain, *cast(list[str], tables["bus"]["listen"])]
        tables["robot"] = {"id": network.robot}
        self.counters: Mapping[str, int] = {}
        self.daemon = Daemon(where, self._peer.path, tables, endpoint=self._plain)

    def attacked(self, form: str, identity: Identity, reported: str = "") -> Figures:
        """Run an attack, with a stop in it, and return its effects.

        If `reported` is given, the attack ends when the daemon logs this event.
        """
        network, text = self._network, HOSTILE.replace("acsard/acsar", self._root)
        length = 40.0 if reported else ATTACK_S
        shown = json.dumps(network.shown(identity))
        with self._peer, self.daemon, Bus(self._plain, network.robot) as bus:
            bus.linked()
            with bus.commanding(0.3):
                until(lambda: (bus.state()["linear"] or 0.0) > 0.25, 5.0, "it drives")
                first, begun, memory_kb = (
                    bus.state(),
                    time.monotonic(),
                    resident_kb(self.daemon.pid),
                )
                attack = command_line(text, form, network.tls, shown, length)
                with Program(attack, self._where) as attacker:
                    attacker.says("begun")
                    half, stop_s, most_kb = time.monotonic() + ATTACK_S / 2, 0.0, memory_kb
                    while attacker.process.poll() is None:
                        if reported and self.daemon.events(reported):
                            break
                        most_kb = max(most_kb, resident_kb(self.daemon.pid))
                        if not stop_s and form not in HALT and time.monotonic() > half:
                            stop_s = self._stopped()
                        time.sleep(0.02)
                back_s = self._back()
            last = bus.state()
            self.counters = last["counters"]
            taken_s = lost(begun)
            if form in HALT:
                assert last["mode"] == "stopped"
                clears = lambda: bus.get("srv/clear")["success"] and bus.state()["mode"] == "ready"  # noqa: E731
                until(clears, 5.0, "none of those stops waits to come")
        return Figures(Periods.between(first, last), stop_s, most_kb - memory_kb, back_s, taken_s)

    def locked(self, silent: bool) -> tuple[Periods, Mapping[str, int], float]:
        """Return the effects while Zenoh cleans up after a local attacker.

        These are the control periods, the counters, and the time lost to other programs, in s. A
        `silent` board stops and goes on when the lock is held, so that the first message of its
        feedback meets the lock.
        """
        with (
            self._peer,
            self.daemon,
            Bus(self._plain, self._network.robot) as bus,
            bus.follow("odom"),
        ):
            bus.linked()
            begun, now = bus.state(), time.monotonic()
            attack = command_line(HOSTILE, "many", self._plain, "{}", 1.0)
            with Program(attack, self._where) as attacker:
                attacker.says("declared")
                if silent:
                    self._peer.signal(signal.SIGSTOP)
                assert attacker.ended(10.0) == 0
            self._peer.signal(signal.SIGCONT)
            until(lambda: self.daemon.events("bus_stuck"), 10.0, "the log says it")
            time.sleep(0.5)
            # A query waits as long as the lock is held.
            until(lambda: bus.ask("info"), 30.0, "the bus is free again")
            ended, lost_s = bus.state(), lost(now)
        return Periods.between(begun, ended), ended["counters"], lost_s

    def _stopped(self) -> float:
        """Let a new local client stop the robot. Return the time until a slower line, s."""
        with Bus(self._plain, self._network.robot) as other:
            start = time.monotonic()
            before = wheels(self._peer.lines[-1].line)[0]
            other.put("stop", True)

            def slower() -> float | None:
                lines = self._peer.since(start)
                return next((h.at for h in lines if wheels(h.line)[0] < before), None)

            at = until(slower, 5.0, "the stop is on the wire")
        return at - start - lost(start, at)

    def _back(self) -> float:
        """Return the time until an operator over TLS gets an answer."""
        begun = time.monotonic()

        def answered() -> bool:
            config = client_config(self._network.tls)
            settings = json.dumps(self._network.shown("operator"))
            config.insert_json5("transport/link/tls", settings)
            try:
                with zenoh.open(config) as session:
                    # The timeout is long, so that a late answer is timed and not requested again.
                    return any(r.ok for r in session.get(f"{self._root}/state", timeout=5.0))
            except zenoh.ZError:
                return False

        until(answered, 10.0, "an operator is let in again")
        return time.monotonic() - begun


class Gateway(NamedTuple):
    """A robot with its own TLS gateway, and the certificates for it."""

    certificates: Certificates

    def network(self, *, wildcards: bool = False) -> Network:
        tls, own = free_tls_endpoint(), self.certificates
        bus: dict[str, object] = {"listen": [tls], "tls": str(own.robot)}
        tables: Tables = {"bus": bus, "access": {"wildcards": wildcards}}
        return Network(tls, lambda identity: own.settings(own.own(identity)), tables)


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Gateway:
    return Gateway(Certificates(tmp_path_factory.mktemp("certificates")))


@contextmanager
def fleet(where: Path) -> Iterator[Network]:
    """Run a router with the rules of deploy/zenoh. Yield how a client reaches a robot behind it."""
    tls = free_tls_endpoint()
    certified(where, "robot1", ITS_NAME, "viewer", "operator", "unlisted")
    bus: dict[str, object] = {"listen": [], "connect": [tls], "tls": str(where / "robot1")}
    tables: Tables = {"bus": bus, "access": {"maintainers": [ITS_NAME]}}
    with acsard_router(where, tls) as program:
        until(lambda: _answers(tls), 10.0, f"the router listens\n{program}")
        yield Network(tls, lambda identity: tls_settings(where / identity), tables, "robot1")


def _answers(endpoint: str) -> bool:
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    try:
        socket.create_connection((host, int(port)), 1.0).close()
    except OSError:
        return False
    return True


def undisturbed(figures: Figures, back_s: float = BACK_S) -> None:
    """Check the loop, the stop, the daemon's memory and the other users."""
    print(f"\n{figures}")
    periods = figures.periods
    assert periods.missed <= 0.01 * periods.elapsed + 4 + 100.0 * figures.taken_s
    assert figures.stop_s <= STOP_S
    assert figures.grown_kb <= GROWTH_KB
    assert figures.back_s <= back_s


NIGHTLY = pytest.mark.nightly
IN_CI = ("many", "as_router", "may_stop")
"""The attacks of `.ci/run`: keys that are slow to remove, another mode, and a permitted action."""


@pytest.mark.parametrize(
    "form",
    [pytest.param(form, marks=() if form in IN_CI else NIGHTLY) for form in (*FORMS, *HALT)],
)
def test_an_admitted_attacker_disturbs_neither_the_loop_nor_a_stop_nor_other_clients(
    tmp_path: Path, gateway: Gateway, form: str
) -> None:
    undisturbed(Robot(tmp_path, gateway.network()).attacked(form, "viewer"))


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(form, marks=() if form == "subscribe" else NIGHTLY)
        for form in FORMS
        if form not in HOLD_UP
    ],
)
def test_an_attack_on_the_fleets_router_does_not_disturb_the_robot_behind_it(
    tmp_path: Path, form: str
) -> None:
    with fleet(tmp_path) as network:
        undisturbed(Robot(tmp_path, network).attacked(form, "viewer"))


@pytest.mark.parametrize(
    "silent", [False, pytest.param(True, marks=NIGHTLY)], ids=["during puts", "before the first"]
)
def test_a_bus_that_is_locked_costs_messages_and_no_period(
    tmp_path: Path, gateway: Gateway, silent: bool
) -> None:
    """With `access.wildcards` a client can hold the lock on Zenoh's tables for a while.

    The lock blocks every program that puts. The daemon loses messages then, but no period: it never
    puts in the thread of the control loop.
    """
    robot = Robot(tmp_path, gateway.network(wildcards=True))
    periods, counters, lost_s = robot.locked(silent)
    assert periods.missed <= 0.01 * periods.elapsed + 4 + 100.0 * lost_s
    assert counters["bus_dropped"] > 20
    assert counters["bus_stuck"] >= 1


@pytest.mark.nightly
@pytest.mark.parametrize("form", ["many", "subscribe"])
def test_wildcards_of_a_client_do_not_disturb_a_robot_behind_the_gateway(
    tmp_path: Path, gateway: Gateway, form: str
) -> None:
    # The gateway's tables are cleaned at the machine's speed, 1.7 s on a fast one; newcomers wait.
    network = gateway.network(wildcards=True)
    undisturbed(Robot(tmp_path, network).attacked(form, "viewer"), back_s=3 * BACK_S)


def test_a_client_that_takes_all_connections_is_named_in_the_log_and_counted(
    tmp_path: Path, gateway: Gateway
) -> None:
    robot = Robot(tmp_path, gateway.network())
    # A quiet machine makes the 255 handshakes in less than 5 s, a busy one in more.
    undisturbed(robot.attacked("sessions", "unlisted", "gateway_full"))
    (line,) = robot.daemon.events("gateway_full")
    assert line["text"].startswith("all 255 connections are in use, 255 by unlisted")
    assert robot.counters["gateway_full"] > 0
