"""A clear releases exactly the causes that its sender was shown.

The clients here read `state`, and each clear names the causes that the client read.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import pytest

from acsard.core.incoming.commands import Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import ServiceReply
from acsard.core.messages.signature import public_name
from acsard.core.motion.latches import after_restart
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.shapes import Trigger
from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import moved
from tests.scenarios.world import World, naming

JOE = public_name("joe")
"""The name that the daemon shows for the client "joe"."""


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def call(
    world: World,
    service: str,
    name: str,
    numbers: Sequence[int] | None = None,
    via: Via = "native",
) -> ServiceReply:
    """Call a service in the name of this client, without delay, and return the answer."""
    payload = naming(numbers)
    attachment = msgspec.json.encode({"sender": name})
    if via == "rmw":
        attachment = Attachment(1, 1_800_000_000 * NS_PER_S, bytes(range(16))).pack()
    if via == "bridge":
        attachment = b""
    ticket = 1000 + world.now_ns
    key = f"srv/{service}"
    world.bus.queries.append(
        Query(ticket, key, key, "", payload, "", world.now_ns, via, attachment)
    )
    world.run(0.02)
    (reply,) = world.bus.replies[ticket]
    if via == "native":
        return msgspec.json.decode(reply.payload, type=ServiceReply)
    trigger = Cdr(Trigger).decode(reply.payload)
    return ServiceReply(trigger.success, trigger.message)


def runaway(world: World) -> None:
    """Latch a fault: a person pushes the robot, so its wheels turn against the commanded zero."""
    with world.mcu.pushed(0.5):
        world.run(2.5)


# a clear and a later stop


def test_a_clear_read_before_a_later_stop_and_delivered_after_it_leaves_that_stop(
    world: World,
) -> None:
    call(world, "stop", "ann")
    shown = world.numbers
    world.run(3.0)
    call(world, "stop", "joe")
    world.run(3.0)
    reply = call(world, "clear", "ann", shown)
    assert (reply.success, reply.data.numbers) == (True, shown)
    assert reply.message.startswith(f"cleared, but the robot is still stopped by {JOE} (native)")
    assert world.state.mode == "stopped"
    assert not call(world, "clear", "ann", shown).success
    assert call(world, "clear", "ann", world.numbers).success
    assert world.state.mode == "ready"


@pytest.mark.parametrize("via", ["native", "rmw", "bridge"])
def test_a_plain_clear_is_refused_until_a_stop_was_published_for_two_seconds(
    world: World, via: Via
) -> None:
    call(world, "stop", "joe")
    world.run(1.0)
    reply = call(world, "clear", "ann", via=via)
    assert (reply.success, world.state.mode) == (False, "stopped")
    world.run(1.05)
    assert call(world, "clear", "ann", via=via).success
    assert world.state.mode == "ready"


@pytest.mark.parametrize("stall_s", [0.05, 0.16, 0.5, 1.0])
def test_a_plain_clear_works_on_a_computer_that_stalls_all_the_time(
    world: World, stall_s: float
) -> None:
    """Without the law of the published age, none of 40 calls succeeded with stalls of 0.16 s."""
    done = 0
    for _ in range(8):
        call(world, "stop", "joe")
        for _ in range(2):
            world.run(1.5 - stall_s)
            world.stall(stall_s)
        world.run(0.05)
        done += call(world, "clear", "ann", via="rmw").success
    assert done == 8


def test_every_stop_has_a_number_of_its_own_and_one_caller_has_one_stop(world: World) -> None:
    latches = []
    for name in ("ann", "joe", "joe"):
        call(world, "stop", name)
        latches.append(world.newest)
        assert f"stopped by {public_name(name)} (native) at 2027-01-15 08:00" in world.state.reason
        world.run(1.0)
    assert latches == sorted(set(latches))
    assert len(world.numbers) == 2
    assert msgspec.json.decode(msgspec.json.encode(float(latches[-1]))) == latches[-1]


def test_the_state_shows_each_cause(world: World) -> None:
    assert world.state.causes == []
    call(world, "stop", "joe")
    (cause,) = world.state.causes
    assert (cause.kind, cause.code, cause.kept) == ("stop", "stopped", False)
    assert (cause.by, cause.text) == (f"{JOE} (native)", f"stopped by {JOE} (native)")
    world.run(1.0)
    with world.mcu.bumpers(), world.mcu.bumper_pressed(1, 0.0, 0.0):
        world.run(0.5)
    call(world, "deactivate", "ann")
    first, second = world.state.causes
    assert (first.number, second.kind, second.code) == (cause.number, "stop", "bumper")
    assert first.age is not None
    assert second.age is not None
    assert first.age == pytest.approx(1.5, abs=0.1)
    assert second.age == pytest.approx(0.3, abs=0.25)


def test_a_flood_of_stops_hides_neither_the_first_client_nor_the_last(world: World) -> None:
    for name in range(60):
        call(world, "stop", f"client{name}")
    first, last = public_name("client0"), public_name("client59")
    names = [cause.by for cause in world.state.causes]
    assert len(names) == 32
    assert (names[0], names[-1]) == (f"{first} (native)", f"{last} (native)")
    shown = world.numbers
    call(world, "stop", "joe")
    call(world, "clear", "ann", shown)
    assert [cause.by for cause in world.state.causes] == [f"{JOE} (native)"]


# an activate and a later deactivate


@pytest.mark.parametrize("via", ["native", "rmw", "bridge"])
def test_a_plain_activate_is_refused_for_two_seconds_after_a_deactivate(
    world: World, via: Via
) -> None:
    call(world, "deactivate", "joe")
    world.run(1.0)
    reply = call(world, "activate", "ann", via=via)
    assert (reply.success, world.state.mode) == (False, "inactive")
    world.run(1.05)
    assert call(world, "activate", "ann", via=via).success
    assert world.state.mode == "ready"


# a stop and a fault


def test_a_plain_clear_releases_the_fault_and_then_the_stop(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    call(world, "stop", "joe")
    runaway(world)
    assert world.state.mode == "fault"
    assert world.state.code == "wheel_runaway"
    world.run(2.0)
    reply = call(world, "clear", "ann", via="rmw")
    assert reply.success
    assert f"still stopped by {JOE} (native)" in reply.message
    assert world.state.mode == "stopped"
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "stopped"
    assert call(world, "clear", "ann", via="rmw").success
    assert world.state.mode == "ready"


# a restart


def test_a_restarted_robot_stays_stopped_until_clear() -> None:
    first = World()
    first.run(0.2)
    first.drive(0.5, seconds=1.0)
    call(first, "stop", "joe")
    assert first.outputs is not None
    latches = after_restart(first.outputs.latches)
    world = World(latches=latches)
    world.run(0.2)
    assert f"was stopped by {JOE} (native) at 2027-01-15 08:00:01 UTC, before the restart" in (
        world.state.reason
    )
    (event,) = [event for event in world.events if event.name == "mode"]
    assert (event.level, event.code) == ("warning", "stopped")
    world.drive(0.5, seconds=3.0)
    assert (moved(world, 0), world.state.mode) == (False, "stopped")
    world.now_ns += 5 * NS_PER_S
    assert call(world, "clear", "ann", world.numbers).success
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"
