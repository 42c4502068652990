"""Tests of the events and counters about the connections of the bus."""

from __future__ import annotations

from collections import Counter

from acsard.core.incoming.bus_interface import GATEWAY_KEY, GatewayFollower, RouterFollower
from acsard.core.incoming.commands import Arrival
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.schema import GatewayState
from acsard.core.values import Event, RoutersStatus
from tests.each import each


def arrival(payload: bytes, encoding: str = "") -> Arrival:
    return Arrival(GATEWAY_KEY, True, payload, encoding, 0, None, "")


class GatewayDaemon:
    """The part of the daemon that records the reports of the TLS gateway."""

    def __init__(self) -> None:
        self.told, self.counters = GatewayFollower(), Counter[str]()

    def hears(self, state: GatewayState) -> int | None:
        sample = arrival(encode(state, "msgpack"), encoding_name("msgpack", "GatewayState"))
        return self.told.receive(sample, self.counters)


def test_each_gateway_start_and_each_check_that_found_it_full_is_counted_once() -> None:
    daemon = GatewayDaemon()
    for opened, crowded in ((7, 0), (7, 3), (7, 3), (7, 4), (9, 0), (9, 2)):
        daemon.hears(GatewayState(opened, 255, crowded))
    assert daemon.counters == {"gateway_opened": 2, "gateway_full": 6}


def test_checks_that_found_the_gateway_full_before_the_daemon_started_are_counted() -> None:
    daemon = GatewayDaemon()
    daemon.hears(GatewayState(7, 255, 40))
    assert daemon.counters == {"gateway_opened": 1, "gateway_full": 40}


def test_the_end_of_the_certificate_is_returned_if_the_gateway_reports_it() -> None:
    daemon = GatewayDaemon()
    assert (
        daemon.hears(GatewayState(7, 0, 0, 1_800_000_000_000_000_000)) == 1_800_000_000_000_000_000
    )
    assert daemon.hears(GatewayState(7, 0, 0)) is None


@each(
    "payload",
    [
        b"",
        b"\xff",
        b"{}",
        b'{"opened": "now"}',
        b"[]",
        b'{"opened": -1, "connections": 0, "full": 0}',
        b'{"opened": 1, "connections": 0, "full": 1' + b"0" * 30 + b"}",
        b'{"opened": 1, "connections": 0, "full": 0, "certificate_ends": 1' + b"0" * 400 + b"}",
    ],
)
def test_an_unreadable_gateway_report_counts_nothing(payload: bytes) -> None:
    counters = Counter[str]()
    assert GatewayFollower().receive(arrival(payload), counters) is None
    assert not counters


A, B = "tcp/127.0.0.1:7447", "tcp/robot.local:7447"


class Daemon:
    """The part of the daemon that records its connections to routers."""

    def __init__(self) -> None:
        self.told, self.counters = RouterFollower(), Counter[str]()

    def hears(self, connected: tuple[str, ...], missing: tuple[str, ...]) -> list[Event]:
        events: list[Event] = []
        self.told.receive(RoutersStatus(connected, missing), self.counters, events)
        return events


def test_a_router_that_is_missing_from_the_start_is_reported_and_counted() -> None:
    daemon = Daemon()
    (event,) = daemon.hears((), (A,))
    assert (event.name, event.level) == ("router_missing", "warning")
    assert event.text == (
        f"not connected to {A}; the daemon tries again until it connects, and the robot can drive "
        "meanwhile"
    )
    assert daemon.counters == {"router_missing": 1}


def test_a_router_that_connects_is_reported_once_with_its_address() -> None:
    daemon = Daemon()
    daemon.hears((), (A,))
    assert daemon.hears((A,), ()) == [Event("router_found", f"connected to {A}")]
    assert daemon.hears((A,), ()) == []
    assert daemon.told.status == RoutersStatus((A,), ())


def test_only_the_missing_router_of_two_is_reported() -> None:
    daemon = Daemon()
    assert [e.name for e in daemon.hears((A, B), ())] == ["router_found"]
    (event,) = daemon.hears((A,), (B,))
    assert B in event.text
    assert A not in event.text


def test_a_peer_in_the_place_of_a_router_is_reported_once_with_its_consequence() -> None:
    follower, counters = RouterFollower(), Counter[str]()
    events: list[Event] = []
    follower.receive(
        RoutersStatus((A,)), counters, events
    )  # the type of this peer is not known yet
    follower.receive(RoutersStatus((A,), peers=(A,)), counters, events)
    follower.receive(RoutersStatus((A,), peers=(A,)), counters, events)
    pairs = [(event.name, event.level) for event in events]
    assert pairs == [("router_found", "info"), ("not_a_router", "warning")]
    assert events[-1].text.startswith(f"these endpoints are peers, not routers: {A}. A peer, ")
    assert "call stop --id '*'" in events[-1].text


def test_one_router_may_go_missing_while_another_connects() -> None:
    daemon = Daemon()
    daemon.hears((A,), (B,))
    assert [e.name for e in daemon.hears((B,), (A,))] == ["router_missing", "router_found"]
    assert daemon.counters == {"router_missing": 2}
