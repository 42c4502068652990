"""The log of a day names each caller and the reason of each change, and its length is limited."""

from __future__ import annotations

import msgspec
import pytest

from acsard.core.incoming.commands import Arrival, Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.keys_and_roles import SERVICES, VERBS
from acsard.core.messages.signature import public_name
from acsard.core.motion.event_throttle import BURST
from acsard.core.values import NS_PER_S, Event, EventName
from tests.scenarios.world import World, naming


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    world.events.clear()
    return world


def events_named(world: World, name: EventName) -> list[Event]:
    return [event for event in world.events if event.name == name]


def signed(name: str) -> bytes:
    """Return the attachment by which a client with this name signs its messages."""
    return msgspec.json.encode({"sender": f"{name}/s3cret"})


def logged_name(name: str) -> str:
    """Return the text by which the log names the client of `signed(name)`."""
    return f"{public_name(f'{name}/s3cret')} (native)"


def call(world: World, service: str, name: bytes = b"", via: Via = "native") -> None:
    """Call a service. `name` is the caller's attachment, from `signed`.

    A call of `stop` is preceded by a sample on the key `stop`, as on the real bus.
    """
    key, at_ns = f"srv/{service}", world.now_ns
    if service == "stop":
        world.bus.arrivals.append(
            Arrival("stop", True, b"", "", at_ns, None, "", via=via, attachment=name)
        )
    payload = SERVICES[VERBS[key]].example.encode()
    if service == "clear":
        payload = naming(world.numbers)
    query = Query(1, key, key, "", payload, "", at_ns, via, name)
    world.bus.queries.append(query)
    world.run(0.03)


# the callers


@pytest.mark.parametrize("service", [key.removeprefix("srv/") for key in VERBS])
def test_every_service_call_is_reported_once_with_its_caller(world: World, service: str) -> None:
    if service == "clear":
        call(world, "stop", signed("ann@desk"))
    call(world, service, signed("joe@laptop patrol"))
    (event,) = (event for event in world.events if event.name == service)
    assert event.by == logged_name("joe@laptop patrol")
    assert event.count == 1


def test_the_stop_of_a_second_client_is_reported_without_delay(world: World) -> None:
    call(world, "stop", signed("joe"))
    call(world, "stop", signed("ann"))
    assert [event.by for event in events_named(world, "stop")] == [
        logged_name("joe"),
        logged_name("ann"),
    ]


def test_no_stop_is_reported_after_the_clear_that_released_it(world: World) -> None:
    for _ in range(2 * BURST):
        call(world, "stop", signed("joe"))
        world.run(0.05)
    call(world, "clear", signed("ann"))
    world.run(3.0)
    assert counted(events_named(world, "stop")) == 2 * BURST
    assert [event.name for event in world.events if event.name in ("stop", "clear")] == [
        *["stop"] * (BURST + 1),
        "clear",
    ]


def test_a_put_on_stop_is_reported_with_its_name_or_the_session_that_stamped_it(
    world: World,
) -> None:
    world.put("stop", b"", stamp_ns=1)
    world.run(2.0)
    world.bus.arrivals.append(
        Arrival("stop", True, b"", "", world.now_ns, None, "", attachment=signed("ann"))
    )
    world.run(0.1)
    assert [event.by for event in events_named(world, "stop")] == [
        f"unnamed (native, session {public_name('peer')})",
        logged_name("ann"),
    ]


# never too much


def counted(events: list[Event]) -> int:
    return sum(event.count for event in events)


# at the end


def test_the_totals_are_the_driven_distance_and_the_counted_events(world: World) -> None:
    world.drive(0.5, seconds=2.0)
    world.send(0.0)
    world.run(1.0)
    world.drive(-0.5, seconds=2.0)
    world.send(0.0)
    world.run(1.0)
    totals = world.loop.totals(world.now_ns)
    assert totals["seconds"] == pytest.approx((world.now_ns - 5 * NS_PER_S) / 1e9, abs=0.1)
    assert totals["metres"] == pytest.approx(2.0, rel=0.05)  # there and back
    assert totals["commands"] == 84
    assert totals["lines"] == world.state.counters["lines"]
