"""What the daemon counts and reports about its TLS gateway and its routers."""

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


def test_each_gateway_start_and_each_check_that_found_it_full_is_counted_once() -> None:
    """Also the 40 checks before the daemon started."""
    follower, counters = GatewayFollower(), Counter[str]()
    states = [(7, 40), (7, 43), (7, 43), (7, 44), (9, 0), (9, 2)]
    for opened, crowded in states:
        state = GatewayState(opened, 255, crowded, 1_800_000_000_000_000_000 if crowded else 0)
        sample = arrival(encode(state, "msgpack"), encoding_name("msgpack", "GatewayState"))
        assert follower.receive(sample, counters) == (state.certificate_ends or None)
    assert counters == {"gateway_opened": 2, "gateway_full": 46}


@each(
    "payload",
    [
        b"", b"\xff", b"{}", b'{"opened": "now"}', b"[]",
        b'{"opened": -1, "connections": 0, "full": 0}',
        b'{"opened": 1, "connections": 0, "full": 1' + b"0" * 30 + b"}",
        b'{"opened": 1, "connections": 0, "full": 0, "certificate_ends": 1' + b"0" * 400 + b"}",
    ],
)  # fmt: skip
def test_an_unreadable_gateway_report_counts_nothing(payload: bytes) -> None:
    counters = Counter[str]()
    assert GatewayFollower().receive(arrival(payload), counters) is None
    assert not counters


A, B = "tcp/127.0.0.1:7447", "tcp/robot.local:7447"


def told(*looks: RoutersStatus) -> tuple[list[list[Event]], Counter[str]]:
    """Return the events of each look at the routers, and the counters after the last one."""
    follower, counters, events = RouterFollower(), Counter[str](), list[list[Event]]()
    for look in looks:
        events.append([])
        follower.receive(look, counters, events[-1])
        assert follower.status == look
    return events, counters


def test_a_router_that_is_missing_or_connects_is_reported_once() -> None:
    ((lost,), (found,), nothing), counters = told(
        RoutersStatus((), (A,)), RoutersStatus((A,)), RoutersStatus((A,))
    )
    assert (lost.name, lost.level) == ("router_missing", "warning")
    assert lost.text.startswith(f"not connected to {A}; the daemon tries again until it connects.")
    assert "in mode `client` the robot ramps to zero" in lost.text
    assert (found, nothing) == (Event("router_found", f"connected to {A}"), [])
    assert counters == {"router_missing": 1}


def test_a_peer_in_the_place_of_a_router_is_reported_once_with_its_consequence() -> None:
    # At first, the type of this peer is not known yet.
    peer = RoutersStatus((A,), peers=(A,))
    ((found,), (event,), nothing), _ = told(RoutersStatus((A,)), peer, peer)
    assert (found.name, event.name, event.level) == ("router_found", "not_a_router", "warning")
    assert event.text.startswith(f"these endpoints are peers, not routers: {A}. A peer, ")
    assert "call stop --id '*'" in event.text
    assert nothing == []
