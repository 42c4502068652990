"""A delayed clear never releases a stop or fault that its sender had not seen.

The clients here read `state`, and each clear names the latch that the client read.
"""

from __future__ import annotations

import random

import msgspec
import pytest

from acsard.core.incoming.commands import Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import ServiceReply
from acsard.core.messages.signature import public_name
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.shapes import Trigger
from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Speaker, moved
from tests.scenarios.world import World

JOE = public_name("joe")
"""The name that the daemon shows for the client "joe"."""


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def call(
    world: World, service: str, name: str, latch: int | None = None, via: Via = "native"
) -> ServiceReply:
    """Call a service in the name of this client, without delay, and return the answer."""
    payload = b"" if latch is None else msgspec.json.encode({"latch": latch})
    attachment = msgspec.json.encode({"sender": name})
    if via == "rmw":
        attachment = Attachment(1, 1_800_000_000 * NS_PER_S, bytes(range(16))).pack()
    if via == "bridge":
        attachment = b""
    ticket = 1000 + world.now_ns % 1_000_000_000
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


def test_a_clear_read_before_a_later_stop_and_delivered_after_it_is_refused(world: World) -> None:
    call(world, "stop", "ann")
    latch = world.state.latch
    world.run(3.0)
    call(world, "stop", "joe")
    world.run(3.0)
    reply = call(world, "clear", "ann", latch)
    assert (reply.success, world.state.mode) == (False, "stopped")
    assert call(world, "clear", "ann", world.state.latch).success
    assert world.state.mode == "ready"


@pytest.mark.parametrize("via", ["native", "rmw", "bridge"])
def test_a_plain_clear_is_refused_for_two_seconds_after_a_stop(world: World, via: Via) -> None:
    call(world, "stop", "joe")
    world.run(1.0)
    reply = call(world, "clear", "ann", via=via)
    assert (reply.success, world.state.mode) == (False, "stopped")
    world.run(1.0)
    assert call(world, "clear", "ann", via=via).success
    assert world.state.mode == "ready"


def test_every_stop_is_a_new_latch_also_while_one_holds(world: World) -> None:
    latches = []
    for name in ("ann", "joe", "joe"):
        call(world, "stop", name)
        latches.append(world.state.latch)
        assert f"stopped by {public_name(name)} (native) at 2027-01-15 08:00" in world.state.reason
        world.run(1.0)
    assert latches == sorted(set(latches))
    assert msgspec.json.decode(msgspec.json.encode(float(latches[-1]))) == latches[-1]


def test_a_bumper_does_not_hide_the_client_that_stopped_the_robot(world: World) -> None:
    with world.mcu.bumpers():
        world.run(0.2)
        call(world, "stop", "joe")
        latch = world.state.latch
        with world.mcu.bumper_pressed(1, 0.0, 0.0):
            world.run(0.2)
        world.run(0.2)
        assert world.state.latch > latch
        assert "bumper 1 pressed (latched at 2027" in world.state.reason
        assert f"; also stopped by {JOE} (native) at 2027" in world.state.reason
        assert not call(world, "clear", "ann", latch).success
        assert call(world, "clear", "ann", world.state.latch).success
        assert world.state.mode == "ready"


def test_the_answer_to_a_stop_has_the_number_of_the_stop_of_its_client(world: World) -> None:
    first = world.call("stop").data.latch
    assert first == world.state.latch
    assert call(world, "stop", "joe").data.latch == world.state.latch != first
    again = world.call("stop").data.latch
    assert again == world.state.latch > first


def test_a_stop_that_arrives_ahead_of_its_query_is_one_latch(world: World) -> None:
    world.put("stop", b"", attachment=msgspec.json.encode({"sender": "joe"}))
    arrived_ns, ahead = world.now_ns, world.state.latch
    world.run(0.3)
    key = "srv/stop"
    attachment = msgspec.json.encode({"sender": "joe"})
    world.bus.queries.append(Query(1, key, key, "", b"", "", arrived_ns, "native", attachment))
    world.run(0.02)
    assert world.bus.replies[1]
    assert world.state.latch == ahead > 0


@pytest.mark.slow
@pytest.mark.variations(50)
@pytest.mark.parametrize("seed", range(100))
def test_no_delayed_clear_releases_a_stop_that_its_sender_had_not_seen(seed: int) -> None:
    """Three operators stop and clear the robot over networks that delay messages by up to 5 s."""
    dice, world = random.Random(seed), World()
    world.run(0.2)
    moving = Speaker(world, "signed")
    stops: list[tuple[int, int]] = []
    """When each stop was obeyed, and its latch."""
    states: list[tuple[int, int]] = [(world.now_ns, 0)]
    """When each state was published, and its latch."""
    pending: list[tuple[int, int]] = []
    """When each clear is delivered, and the state that its sender had read then."""
    for _ in range(150):
        moving.send(dice.choice((0.0, 0.5)))
        world.run(dice.uniform(0.02, 0.2))
        states.append((world.now_ns, world.state.latch))
        roll = dice.random()
        if roll < 0.1:
            assert call(world, "stop", dice.choice(("ann", "joe"))).success
            stops.append((world.now_ns, world.state.latch))
        elif roll < 0.4:
            read = max(0, len(states) - 1 - dice.randrange(20))
            pending.append((world.now_ns + dice.randrange(5 * NS_PER_S), read))
        for clear in [request for request in pending if request[0] <= world.now_ns]:
            pending.remove(clear)
            read_ns, latch = states[clear[1]]
            was = world.state.mode
            done = call(world, "clear", "eve", latch).success
            if was == "stopped" and done:
                assert stops[-1][0] <= read_ns
                assert stops[-1][1] == latch
            elif was == "stopped":
                assert world.state.mode == "stopped"
    assert len(stops) > 3
    assert call(world, "clear", "eve", world.state.latch).success
    assert world.state.mode in ("ready", "driving")


# an activate and a later deactivate


def test_an_activate_read_before_a_later_deactivate_and_delivered_after_it_is_refused(
    world: World,
) -> None:
    call(world, "deactivate", "ann")
    latch = world.state.latch
    world.run(3.0)
    assert call(world, "activate", "ann", latch).success
    call(world, "deactivate", "joe")
    world.run(3.0)
    reply = call(world, "activate", "eve", latch)
    assert (reply.success, world.state.mode) == (False, "inactive")
    assert call(world, "activate", "ann", world.state.latch).success
    assert world.state.mode == "ready"


@pytest.mark.parametrize("via", ["native", "rmw", "bridge"])
def test_a_plain_activate_is_refused_for_two_seconds_after_a_deactivate(
    world: World, via: Via
) -> None:
    call(world, "deactivate", "joe")
    world.run(1.0)
    reply = call(world, "activate", "ann", via=via)
    assert (reply.success, world.state.mode) == (False, "inactive")
    world.run(1.0)
    assert call(world, "activate", "ann", via=via).success
    assert world.state.mode == "ready"


# a stop and a fault


def test_a_fault_does_not_overwrite_a_stop(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    call(world, "stop", "joe")
    runaway(world)
    assert world.state.mode == "fault"
    assert world.state.code == "wheel_runaway"
    assert call(world, "clear", "ann", world.state.latch).success
    assert world.state.mode == "stopped"
    world.drive(0.5, seconds=1.0)
    assert world.state.mode == "stopped"
    assert call(world, "clear", "ann", world.state.latch).success
    assert world.state.mode == "ready"


def test_a_clear_of_one_fault_does_not_release_another_fault_that_came_after_it(
    world: World,
) -> None:
    """The second fault's cause ends by itself, so a wrongly released fault would be lost."""
    with world.mcu.dead_motor(0):
        world.drive(0.5, seconds=1.2)
    assert world.state.mode == "fault"
    latch = world.state.latch
    with world.mcu.driver_fault(0.0, 0.3):
        world.run(0.25)
        assert world.state.latch > latch
        world.run(1.0)  # until the board reports that the driver's fault is over
    assert world.state.code == "driver_fault"
    reply = world.call("clear", msgspec.json.encode({"latch": latch}))
    assert not reply.success
    assert world.state.mode == "fault"
    assert world.call("clear", msgspec.json.encode({"latch": world.state.latch})).success


# a restart


def test_a_restarted_robot_stays_stopped_until_clear() -> None:
    first = World()
    first.run(0.2)
    first.drive(0.5, seconds=1.0)
    call(first, "stop", "joe")
    assert first.outputs is not None
    latches = first.outputs.latches.after_restart()
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
    assert call(world, "clear", "ann", world.state.latch).success
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"
