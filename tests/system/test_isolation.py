"""Whoever is let in over TLS: the loop, the stop and the other users are not disturbed.

Each attack comes with a viewer's certificate and with one that nobody listed, while somebody at the
machine drives.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    FarPeer,
    Periods,
    Program,
    free_endpoint,
    resident_kb,
    until,
    wheels,
)
from tests.system.identities import Certificates, Identity, free_tls_endpoint
from tests.system.strangers import HOSTILE, words

pytestmark = [pytest.mark.network, pytest.mark.timeout(120)]

SHORT, LONG = 1.5, pytest.param(30.0, marks=pytest.mark.soak)

GROWTH_KB = 20_000
STOP_S = 0.05
BACK_S = 2.0

FORMS = [
    "subscribe",
    "chunk",
    "late",
    "ros",
    "alive",
    "token",
    "ask",
    "serve",
    "name",
    "many",
    "many_chunks",
    "many_exact",
    "publish",
    "querier",
    "sessions",
    "come_and_go",
    "flood",
    "as_router",
    "as_peer",
]


class Figures(NamedTuple):
    """What an attack did."""

    periods: Periods
    calm: Periods
    """Of the same robot, driven for as long before it."""
    stopped: float
    """From a local `stop` to the first slower line, s."""
    grown_kb: int
    back: float
    """How long an operator takes to be answered when the attacker has gone, s."""
    taken: float
    """What the machine took meanwhile of a bare process, s."""


class Robot:
    """A robot that somebody at the machine drives, with a door to the network."""

    def __init__(self, where: Path, certificates: Certificates, *, wildcards: bool = False) -> None:
        self._where, self._certificates = where, certificates
        self._plain, self._tls = free_endpoint(), free_tls_endpoint()
        self._peer = FarPeer(where)
        bus: dict[str, object] = {
            "listen": [self._plain, self._tls],
            "tls": str(certificates.robot),
        }
        tables: dict[str, dict[str, object]] = {"bus": bus, "access": {"wildcards": wildcards}}
        self.counters: Mapping[str, int] = {}
        self.daemon = Daemon(where, self._peer.path, tables, endpoint=self._plain)

    def attacked(self, form: str, who: Identity, seconds: float) -> Figures:
        """What becomes of it."""
        with self._peer, self.daemon, Bus(self._plain) as bus:
            bus.linked()
            with bus.commanding(0.3):
                until(lambda: bus.state()["linear"] > 0.25, 5.0, "it drives")
                first = bus.state()
                time.sleep(seconds)
                begun, now = bus.state(), time.monotonic()
                grown_kb, stopped = self._under(form, who, seconds, bus)
                back = self._back()
                ended = bus.state()
                self.counters = ended["counters"]
            taken = lost(now)
        periods, calm = Periods.between(begun, ended), Periods.between(first, begun)
        return Figures(periods, calm, stopped, grown_kb, back, taken)

    def locked(self, seconds: float) -> tuple[Periods, Mapping[str, int]]:
        """What becomes of the periods and the counters while Zenoh cleans up behind a local one."""
        with self._peer, self.daemon, Bus(self._plain) as bus, bus.follow("odom"):
            bus.linked()
            begun = bus.state()
            attack = words(HOSTILE, "many", self._plain, "{}", 1.0)
            with Program(attack, self._where) as attacker:
                attacker.says("declared")
                assert attacker.ended(10.0) == 0
            until(lambda: self.daemon.events("bus_stuck"), 10.0, "the log says it")
            time.sleep(seconds)
            # A question waits as long as the lock is held.
            until(lambda: bus.ask("info"), 30.0, "the bus is free again")
            ended = bus.state()
        return Periods.between(begun, ended), ended["counters"]

    def _under(self, form: str, who: Identity, seconds: float, bus: Bus) -> tuple[int, float]:
        memory_kb, most_kb = resident_kb(self.daemon.pid), 0
        settings = json.dumps(self._certificates.settings(self._certificates.own(who)))
        with Program(words(HOSTILE, form, self._tls, settings, seconds), self._where) as attacker:
            attacker.says("begun")
            end, stopped = time.monotonic() + seconds, 0.0
            while attacker.process.poll() is None and time.monotonic() < end + 5.0:
                most_kb = max(most_kb, resident_kb(self.daemon.pid) - memory_kb)
                if most_kb > GROWTH_KB:
                    pytest.fail(f"{most_kb} kB more")
                if not stopped and time.monotonic() > end - seconds / 2:
                    stopped = self._stopped(bus)
                time.sleep(0.02)
        return most_kb, stopped

    def _stopped(self, bus: Bus) -> float:
        """From a stop by one who has just come to this machine to the wire."""
        with Bus(self._plain) as other:
            said = time.monotonic()
            before = wheels(self._peer.lines[-1].line)[0]
            other.put("stop", True)
            slower = until(
                lambda: next(
                    (h for h in self._peer.since(said) if wheels(h.line)[0] < before), None
                ),
                5.0,
                "the stop is on the wire",
            )
        return slower.at - said

    def _back(self) -> float:
        """How long an operator over TLS takes to be answered."""
        begun = time.monotonic()

        def answered() -> bool:
            try:
                config = self._certificates.config("operator", self._plain, self._tls)
                with zenoh.open(config) as session:
                    return any(r.ok for r in session.get("acsard/acsar/state", timeout=1.0))
            except zenoh.ZError:
                return False

        until(answered, 10.0, "an operator is let in again")
        return time.monotonic() - begun


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("certificates"))


def undisturbed(figures: Figures) -> None:
    """The loop, the stop, the daemon's memory and the other users."""
    # A few periods either way are the machine's, which other tests use as well.
    few = 0.01 * figures.periods.elapsed + 4 + 100.0 * figures.taken
    assert figures.periods.missed <= 2 * figures.calm.missed + few
    assert 0.0 < figures.stopped <= STOP_S
    assert figures.grown_kb <= GROWTH_KB
    assert figures.back <= BACK_S


@pytest.mark.parametrize("seconds", [SHORT, LONG])
@pytest.mark.parametrize("who", ["viewer", "unlisted"])
@pytest.mark.parametrize("form", FORMS)
def test_who_is_let_in_disturbs_neither_the_loop_nor_the_stop_nor_the_others(
    tmp_path: Path, certificates: Certificates, form: str, who: Identity, seconds: float
) -> None:
    figures = Robot(tmp_path, certificates).attacked(form, who, seconds)
    print(f"\n{form} by {who}: {figures}")
    undisturbed(figures)


def test_a_bus_that_is_locked_costs_messages_and_no_period(
    tmp_path: Path, certificates: Certificates
) -> None:
    """On the machine anybody may use wildcards: what holds Zenoh's tables holds who puts."""
    periods, counters = Robot(tmp_path, certificates).locked(0.5)
    print(f"\n{periods}, {counters}")
    assert periods.missed <= 0.01 * periods.elapsed + 4
    assert counters["bus_dropped"] > 20
    assert counters["bus_stuck"] >= 1


@pytest.mark.parametrize("form", ["many", "subscribe"])
def test_behind_the_door_not_even_wildcards_disturb(
    tmp_path: Path, certificates: Certificates, form: str
) -> None:
    figures = Robot(tmp_path, certificates, wildcards=True).attacked(form, "viewer", 1.5)
    print(f"\n{form} with wildcards: {figures}")
    undisturbed(figures)


def test_who_takes_all_connections_is_in_the_log_and_in_the_state(
    tmp_path: Path, certificates: Certificates
) -> None:
    robot = Robot(tmp_path, certificates)
    robot.attacked("sessions", "unlisted", 1.5)
    (line,) = robot.daemon.events("door_crowded")
    assert line["text"].startswith("all 255 connections are taken, 255 by unlisted")
    assert robot.counters["door_crowded"] > 0
