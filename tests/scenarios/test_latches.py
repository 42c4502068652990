"""A clear releases exactly the causes that its sender was shown.

The clients here read `state`, and each clear names the causes that the client read.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

import msgspec
import pytest

from acsard.core.incoming.commands import Arrival, Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import RobotState, ServiceReply
from acsard.core.messages.signature import public_name
from acsard.core.motion.latches import after_restart
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.shapes import Trigger
from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Speaker, moved
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
    for _ in range(40):
        call(world, "stop", "joe")
        for _ in range(2):
            world.run(1.5 - stall_s)
            world.stall(stall_s)
        world.run(0.05)
        done += call(world, "clear", "ann", via="rmw").success
    assert done == 40


def test_a_stop_counts_as_shown_only_after_the_step_that_published_it(world: World) -> None:
    world.bus.arrivals.append(Arrival("stop", True, b"", "", world.now_ns, None, ""))
    world.stall_in_step(3.0)
    # This clear arrived after 2.5 s, before the state had been published.
    query = Query(1, "srv/clear", "srv/clear", "", b"", "", world.now_ns - NS_PER_S // 2)
    world.bus.queries.append(query)
    world.run(0.02)
    reply = msgspec.json.decode(world.bus.replies[1][0].payload, type=ServiceReply)
    assert (reply.success, world.state.mode) == (False, "stopped")


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


def test_a_renewed_stop_is_published_at_once() -> None:
    world = World(wanted=("state",))
    world.run(0.2)
    for _ in range(3):
        call(world, "stop", "joe")
        state = world.bus.published["state"][-1]
        assert isinstance(state, RobotState)
        assert [cause.number for cause in state.causes] == world.numbers


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


def test_a_bumper_does_not_hide_the_client_that_stopped_the_robot(world: World) -> None:
    with world.mcu.bumpers():
        world.run(0.2)
        call(world, "stop", "joe")
        shown = world.numbers
        with world.mcu.bumper_pressed(1, 0.0, 0.0):
            world.run(0.2)
        world.run(0.2)
        assert "bumper 1 pressed (latched at 2027" in world.state.reason
        assert f"; also stopped by {JOE} (native) at 2027" in world.state.reason
        assert call(world, "clear", "ann", shown).success
        assert (world.state.mode, world.state.code) == ("stopped", "bumper")
        assert call(world, "clear", "ann", world.numbers).success
        assert world.state.mode == "ready"


def test_the_answer_to_a_stop_has_the_number_of_the_stop_of_its_client(world: World) -> None:
    (first,) = world.call("stop").data.numbers
    assert first == world.newest
    assert call(world, "stop", "joe").data.numbers == [world.newest] != [first]
    (again,) = world.call("stop").data.numbers
    assert again == world.newest > first


def test_a_stop_that_arrives_ahead_of_its_query_is_one_cause(world: World) -> None:
    world.put("stop", b"", attachment=msgspec.json.encode({"sender": "joe"}))
    arrived_ns, ahead = world.now_ns, world.newest
    world.run(0.3)
    key = "srv/stop"
    attachment = msgspec.json.encode({"sender": "joe"})
    world.bus.queries.append(Query(1, key, key, "", b"", "", arrived_ns, "native", attachment))
    world.run(0.02)
    assert world.bus.replies[1]
    assert world.newest == ahead > 0


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


@pytest.mark.slow
@pytest.mark.variations(50)
@pytest.mark.parametrize("seed", range(100))
def test_no_delayed_clear_releases_a_stop_that_its_sender_had_not_seen(seed: int) -> None:
    """Three operators stop and clear the robot over networks that delay messages by up to 5 s."""
    dice, world = random.Random(seed), World()
    world.run(0.2)
    moving = Speaker(world, "signed")
    stops: list[tuple[int, int]] = []
    """When each stop was obeyed, and its number."""
    states: list[tuple[int, list[int]]] = [(world.now_ns, [])]
    """When each state was published, and its numbers."""
    pending: list[tuple[int, int]] = []
    """When each clear is delivered, and the state that its sender had read then."""
    for _ in range(150):
        moving.send(dice.choice((0.0, 0.5)))
        world.run(dice.uniform(0.02, 0.2))
        states.append((world.now_ns, world.numbers))
        roll = dice.random()
        if roll < 0.1:
            assert call(world, "stop", dice.choice(("ann", "joe"))).success
            stops.append((world.now_ns, world.newest))
        elif roll < 0.4:
            read = max(0, len(states) - 1 - dice.randrange(20))
            pending.append((world.now_ns + dice.randrange(5 * NS_PER_S), read))
        for clear in [request for request in pending if request[0] <= world.now_ns]:
            pending.remove(clear)
            read_ns, numbers = states[clear[1]]
            before = set(world.numbers)
            call(world, "clear", "eve", numbers)
            assert before - set(world.numbers) == before & set(numbers)
            assert all(at <= read_ns for at, number in stops if number in numbers)
            later = [number for at, number in stops if at > read_ns]
            assert before & set(later) <= set(world.numbers)
            assert (world.state.mode == "stopped") is bool(world.numbers)
    assert len(stops) > 3
    if world.numbers:
        assert call(world, "clear", "eve", world.numbers).success
    assert world.state.mode in ("ready", "driving")


# an activate and a later deactivate


def test_an_activate_read_before_a_later_deactivate_and_delivered_after_it_is_refused(
    world: World,
) -> None:
    call(world, "deactivate", "ann")
    shown = world.numbers
    world.run(3.0)
    assert call(world, "activate", "ann", shown).success
    call(world, "deactivate", "joe")
    world.run(3.0)
    reply = call(world, "activate", "eve", shown)
    assert (reply.success, world.state.mode) == (False, "inactive")
    assert call(world, "activate", "ann", world.numbers).success
    assert world.state.mode == "ready"


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


def test_a_clear_of_one_fault_does_not_release_another_fault_that_came_after_it(
    world: World,
) -> None:
    """The second fault's cause ends by itself, so a wrongly released fault would be lost."""
    with world.mcu.reversed_motor(0):
        world.drive(0.5, seconds=2.0)
    assert world.state.mode == "fault"
    shown = world.numbers
    with world.mcu.driver_fault(0.0, 0.3):
        world.run(0.25)
        assert world.newest > max(shown)
        world.run(1.0)  # until the board reports that the driver's fault is over
    assert world.state.code == "driver_fault"
    assert call(world, "clear", "ann", shown).success
    assert (world.state.mode, world.state.code) == ("fault", "driver_fault")
    assert call(world, "clear", "ann", world.numbers).success
    assert world.state.mode != "fault"


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
