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
    """The daemon's record of the gateway's reports."""

    def __init__(self) -> None:
        self.told, self.counters = GatewayFollower(), Counter[str]()

    def hears(self, state: GatewayState) -> int | None:
        heard = arrival(encode(state, "msgpack"), encoding_name("msgpack", "GatewayState"))
        return self.told.receive(heard, self.counters)


def test_each_opening_and_each_look_at_a_crowd_counts_once() -> None:
    daemon = GatewayDaemon()
    for opened, crowded in ((7, 0), (7, 3), (7, 3), (7, 4), (9, 0), (9, 2)):
        daemon.hears(GatewayState(opened, 255, crowded))
    assert daemon.counters == {"gateway_opened": 2, "gateway_full": 6}


def test_a_crowd_that_was_there_before_the_daemon_counts_whole() -> None:
    daemon = GatewayDaemon()
    daemon.hears(GatewayState(7, 255, 40))
    assert daemon.counters == {"gateway_opened": 1, "gateway_full": 40}


def test_it_tells_when_the_certificate_ends_if_it_knows() -> None:
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
def test_what_cannot_be_read_counts_nothing(payload: bytes) -> None:
    counters = Counter[str]()
    assert GatewayFollower().receive(arrival(payload), counters) is None
    assert not counters


A, B = "tcp/127.0.0.1:7447", "tcp/robot.local:7447"


class Daemon:
    """The daemon's record of its routers."""

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


def test_a_router_that_came_is_told_by_its_name() -> None:
    daemon = Daemon()
    daemon.hears((), (A,))
    assert daemon.hears((A,), ()) == [Event("router_found", f"connected to {A}")]
    assert daemon.hears((A,), ()) == []
    assert daemon.told.status == RoutersStatus((A,), ())


def test_of_two_routers_only_the_one_that_went_is_reported() -> None:
    daemon = Daemon()
    assert [e.name for e in daemon.hears((A, B), ())] == ["router_found"]
    (event,) = daemon.hears((A,), (B,))
    assert B in event.text
    assert A not in event.text


def test_a_peer_in_a_routers_place_is_reported_once_with_what_it_means() -> None:
    told, counters = RouterFollower(), Counter[str]()
    events: list[Event] = []
    told.receive(RoutersStatus((A,)), counters, events)  # the type of this peer is not known yet
    told.receive(RoutersStatus((A,), peers=(A,)), counters, events)
    told.receive(RoutersStatus((A,), peers=(A,)), counters, events)
    found = [(event.name, event.level) for event in events]
    assert found == [("router_found", "info"), ("not_a_router", "warning")]
    assert events[-1].text.startswith(f"{A} is not a router")
    assert "call stop --id '*'" in events[-1].text


def test_one_may_go_as_the_other_comes() -> None:
    daemon = Daemon()
    daemon.hears((A,), (B,))
    assert [e.name for e in daemon.hears((B,), (A,))] == ["router_missing", "router_found"]
    assert daemon.counters == {"router_missing": 2}
