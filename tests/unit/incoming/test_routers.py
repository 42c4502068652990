"""Tests of the log lines and counters about routers that connect and disconnect."""

from __future__ import annotations

from collections import Counter

from acsard.incoming.routers import RoutersTold
from acsard.values import Event, RoutersStatus

A, B = "tcp/127.0.0.1:7447", "tcp/robot.local:7447"


class Daemon:
    """The daemon's record of its routers."""

    def __init__(self) -> None:
        self.told, self.counters = RoutersTold(), Counter[str]()

    def hears(self, connected: tuple[str, ...], missing: tuple[str, ...]) -> list[Event]:
        events: list[Event] = []
        self.told.hear(RoutersStatus(connected, missing), self.counters, events)
        return events


def test_a_router_that_is_missing_from_the_start_is_told_and_counted() -> None:
    daemon = Daemon()
    (event,) = daemon.hears((), (A,))
    assert (event.name, event.level) == ("router_missing", "warning")
    assert event.text == f"not connected to {A}; tried again until it answers, driving goes on"
    assert daemon.counters == {"router_missing": 1}


def test_a_router_that_came_is_told_by_its_name() -> None:
    daemon = Daemon()
    daemon.hears((), (A,))
    assert daemon.hears((A,), ()) == [Event("router_found", f"connected to {A}")]
    assert daemon.hears((A,), ()) == []
    assert daemon.told.status == RoutersStatus((A,), ())


def test_of_two_routers_only_the_one_that_went_is_told() -> None:
    daemon = Daemon()
    assert [e.name for e in daemon.hears((A, B), ())] == ["router_found"]
    (event,) = daemon.hears((A,), (B,))
    assert B in event.text
    assert A not in event.text


def test_a_peer_in_a_routers_place_is_told_once_with_what_it_means() -> None:
    told, counters = RoutersTold(), Counter[str]()
    events: list[Event] = []
    told.hear(RoutersStatus((A,)), counters, events)  # the type of this peer is not known yet
    told.hear(RoutersStatus((A,), peers=(A,)), counters, events)
    told.hear(RoutersStatus((A,), peers=(A,)), counters, events)
    found = [(event.name, event.level) for event in events]
    assert found == [("router_found", "info"), ("no_router", "warning")]
    assert events[-1].text.startswith(f"{A} is no router")
    assert "call stop --id '*'" in events[-1].text


def test_one_may_go_as_the_other_comes() -> None:
    daemon = Daemon()
    daemon.hears((A,), (B,))
    assert [e.name for e in daemon.hears((B,), (A,))] == ["router_missing", "router_found"]
    assert daemon.counters == {"router_missing": 2}
