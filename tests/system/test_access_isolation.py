"""A client that is admitted over TLS cannot disturb the loop, the stop or the other users.

Each attack is tried with a viewer's certificate and with an unlisted one, while a local client
drives. It goes to the robot's own TLS gateway, and to the router of a fleet with this robot.
"""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.fleet_router import (
    ITS_NAME,
    acsard_router,
    certified,
    tls_settings,
)
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

CALM_S = 5.0

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
    "may_ask",
]

HALT = ("may_stop", "may_call")
"""Attacks that stop the robot.

Any client that sees the robot may stop it; it then stands and no client drives on.
"""

LARGE = ("many@1500", "many@3000", "many_chunks@3000", *HALT)
"""Attacks of the long runs only."""

LONG_S = 10.0
"""A run of at least this length is a long one."""

AGAIN_S = 5.0
"""In a long run, the robot is cleared, driven and stopped again once per this time."""


class Stop(NamedTuple):
    """The reaction to a local `stop`."""

    took: float
    """Time to the first slower line, s."""
    lost: float
    """The time that the machine took meanwhile from a bare process, s."""


class Figures(NamedTuple):
    """The measured effects of an attack."""

    periods: Periods
    calm: Periods
    """The same robot's periods, driven for a while before the attack."""
    stops: tuple[Stop, ...]
    grown_kb: int
    back: float
    """Time until an operator gets an answer after the attacker has gone, s."""
    taken: float
    """The time that the machine took meanwhile from a bare process, s."""


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

    def _joined(self) -> Bus:
        """Run a client on the robot's machine."""
        return Bus(self._plain, self._network.robot)

    def attacked(
        self, form: str, identity: Identity, seconds: float, reported: str = ""
    ) -> Figures:
        """Run an attack and return its effects.

        If `reported` is given, the attack ends when the daemon logs this event.
        """
        with self._peer, self.daemon, self._joined() as bus:
            bus.linked()
            with ExitStack() as driven:
                driven.enter_context(self._driven(bus))
                first = bus.state()
                time.sleep(min(seconds, CALM_S))
                begun, now = bus.state(), time.monotonic()
                grown_kb, stops = self._under(form, identity, seconds, reported, bus, driven)
                back = self._back()
                ended = bus.state()
                self.counters = ended["counters"]
            lost_s = lost(now)
            if form in HALT:
                assert ended["mode"] == "stopped"
                until(lambda: self._cleared(bus), 5.0, "none of those stops waits to come")
        periods, calm = Periods.between(begun, ended), Periods.between(first, begun)
        return Figures(periods, calm, stops, grown_kb, back, lost_s)

    @staticmethod
    def _cleared(bus: Bus) -> bool:
        return bool(bus.get("srv/clear")["success"] and bus.state()["mode"] == "ready")

    @staticmethod
    @contextmanager
    def _driven(bus: Bus) -> Iterator[None]:
        """Let a local client drive the robot while the body runs."""
        with bus.commanding(0.3):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.25, 5.0, "it drives")
            yield

    def locked(self, seconds: float, silent: bool) -> tuple[Periods, Mapping[str, int], float]:
        """Return the effects while Zenoh cleans up after a local attacker.

        These are the control periods, the counters, and the time lost to other programs, in s. A
        `silent` board stops and goes on when the lock is held, so that the first message of its
        feedback meets the lock.
        """
        with self._peer, self.daemon, self._joined() as bus, bus.follow("odom"):
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
            time.sleep(seconds)
            # A query waits as long as the lock is held.
            until(lambda: bus.ask("info"), 30.0, "the bus is free again")
            ended, lost_s = bus.state(), lost(now)
        return Periods.between(begun, ended), ended["counters"], lost_s

    def _under(
        self,
        form: str,
        identity: Identity,
        seconds: float,
        reported: str,
        bus: Bus,
        driven: ExitStack,
    ) -> tuple[int, tuple[Stop, ...]]:
        """Run an attack with stops in it. Return the daemon's memory growth in kB, and the stops.

        In a long run the robot drives again after each stop.
        """
        memory_kb, most_kb = resident_kb(self.daemon.pid), 0
        network, text = self._network, HOSTILE.replace("acsard/acsar", self._root)
        attack = command_line(text, form, network.tls, json.dumps(network.shown(identity)), seconds)
        with Program(attack, self._where) as attacker:
            attacker.says("begun")
            end = time.monotonic() + seconds
            due, stops = end - max(seconds - AGAIN_S / 2, seconds / 2), list[Stop]()
            while attacker.process.poll() is None and time.monotonic() < end + 5.0:
                if reported and self.daemon.events(reported):
                    break
                most_kb = max(most_kb, resident_kb(self.daemon.pid) - memory_kb)
                if most_kb > GROWTH_KB:
                    pytest.fail(f"{most_kb} kB more")
                if form not in HALT and due < min(end, time.monotonic()):
                    stops.append(self._stopped())
                    due += AGAIN_S
                    if due < end:
                        self._again(bus, driven)
                time.sleep(0.02)
        return most_kb, tuple(stops)

    def _again(self, bus: Bus, driven: ExitStack) -> None:
        """Clear the robot, send zeros, and drive."""
        driven.close()
        assert bus.get("srv/clear")["success"]
        driven.enter_context(self._driven(bus))

    def _stopped(self) -> Stop:
        """Let a new local client stop the robot. Return the time until a slower line, s."""
        with self._joined() as other:
            start = time.monotonic()
            before = wheels(self._peer.lines[-1].line)[0]
            other.put("stop", True)
            slower = until(
                lambda: next(
                    (h for h in self._peer.since(start) if wheels(h.line)[0] < before), None
                ),
                5.0,
                "the stop is on the wire",
            )
        return Stop(slower.at - start, lost(start, slower.at))

    def _back(self) -> float:
        """Return the time until an operator over TLS gets an answer."""
        begun = time.monotonic()

        def answered() -> bool:
            try:
                config = client_config(self._network.tls)
                settings = json.dumps(self._network.shown("operator"))
                config.insert_json5("transport/link/tls", settings)
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


def undisturbed(figures: Figures, *, long: bool = False, back_s: float = BACK_S) -> None:
    """Check the loop, the stop, the daemon's memory and the other users."""
    elapsed = figures.periods.elapsed
    calm = figures.calm.missed * elapsed / figures.calm.elapsed
    allowed = calm + 100.0 * figures.taken
    if not long:  # too short to measure either well
        allowed += calm + 0.01 * elapsed + 4
    assert figures.periods.missed <= allowed
    assert all(0.0 < stop.took <= STOP_S + stop.lost for stop in figures.stops)
    assert figures.grown_kb <= GROWTH_KB
    assert figures.back <= back_s


Forms = Mapping[Identity, Sequence[str]]


def attacks(half_a_minute: Forms, a_moment: Forms) -> list[Any]:
    """Return the parameter sets of the attacks.

    Long runs try each attack of the first argument for half a minute. The attacks of the second
    argument run briefly: one in four in each run, and the others in the nightly job.
    """
    brief = [(form, identity) for identity in a_moment for form in a_moment[identity]]
    nightly, soak = pytest.mark.nightly, pytest.mark.soak
    return [
        *(
            pytest.param(*attack, 1.5, marks=nightly if n % 4 else ())
            for n, attack in enumerate(brief)
        ),
        *(
            pytest.param(form, identity, 30.0, marks=soak)
            for identity in half_a_minute
            for form in half_a_minute[identity]
        ),
    ]


@pytest.mark.parametrize(
    ("form", "identity", "seconds"),
    attacks(
        {"viewer": (*FORMS, *LARGE), "unlisted": (*FORMS, *LARGE[:3])},
        {
            "viewer": (
                "subscribe", "ask", "many", "publish", "querier", "come_and_go", "as_router",
                "as_peer", "may_stop", "may_call", "may_ask",
            ),
            "unlisted": ("publish", "sessions", "flood"),
        },
    ),
)  # fmt: skip
def test_an_admitted_attacker_disturbs_neither_the_loop_nor_a_stop_nor_other_clients(
    tmp_path: Path, gateway: Gateway, form: str, identity: Identity, seconds: float
) -> None:
    figures = Robot(tmp_path, gateway.network()).attacked(form, identity, seconds)
    print(f"\n{form} by {identity}: {figures}")
    assert len(figures.stops) >= (0 if form in HALT else 1 if seconds < LONG_S else 3)
    undisturbed(figures, long=seconds >= LONG_S)


HOLD_UP = ("publish", "querier", "as_peer")
"""Attacks that the rules do not cover: they block the router, and a person must restart it."""


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(form, marks=pytest.mark.nightly if n % 2 else ())
        for n, form in enumerate(form for form in FORMS if form not in HOLD_UP)
    ],
)
def test_an_attack_on_the_fleets_router_does_not_disturb_the_robot_behind_it(
    tmp_path: Path, form: str
) -> None:
    with fleet(tmp_path) as network:
        figures = Robot(tmp_path, network).attacked(form, "viewer", 1.5)
    print(f"\n{form} by viewer: {figures}")
    undisturbed(figures)


@pytest.mark.parametrize("silent", [False, True], ids=["during puts", "before the first put"])
def test_a_bus_that_is_locked_costs_messages_and_no_period(
    tmp_path: Path, gateway: Gateway, silent: bool
) -> None:
    """With `access.wildcards` a client can hold the lock on Zenoh's tables for a while.

    The lock blocks every program that puts. The daemon loses messages then, but no period: it never
    puts in the thread of the control loop.
    """
    robot = Robot(tmp_path, gateway.network(wildcards=True))
    periods, counters, lost_s = robot.locked(0.5, silent)
    print(f"\n{periods}, {counters}, {lost_s:.3f} s taken")
    assert periods.missed <= 0.01 * periods.elapsed + 4 + 100.0 * lost_s
    assert counters["bus_dropped"] > 20
    assert counters["bus_stuck"] >= 1


@pytest.mark.parametrize("form", ["many", pytest.param("subscribe", marks=pytest.mark.nightly)])
def test_wildcards_of_a_client_do_not_disturb_a_robot_behind_the_gateway(
    tmp_path: Path, gateway: Gateway, form: str
) -> None:
    figures = Robot(tmp_path, gateway.network(wildcards=True)).attacked(form, "viewer", 1.5)
    print(f"\n{form} with wildcards: {figures}")
    # The gateway's tables are cleaned at the machine's speed, 1.7 s on a fast one; newcomers wait.
    undisturbed(figures, back_s=3 * BACK_S)


def test_a_client_that_takes_all_connections_is_named_in_the_log_and_counted(
    tmp_path: Path, gateway: Gateway
) -> None:
    robot = Robot(tmp_path, gateway.network())
    # A quiet machine makes the 255 handshakes in less than 5 s, a busy one in more.
    robot.attacked("sessions", "unlisted", 40.0, "gateway_full")
    (line,) = robot.daemon.events("gateway_full")
    assert line["text"].startswith("all 255 connections are in use, 255 by unlisted")
    assert robot.counters["gateway_full"] > 0
