"""A stop latches, and a clear releases exactly the causes that its sender was shown."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import pytest

from acsard.core.config.settings import Config, McuConfig, SafetyConfig
from acsard.core.incoming.commands import Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import ServiceReply
from acsard.core.messages.signature import public_name
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.shapes import Trigger
from acsard.core.values import NS_PER_S
from tests.each import each
from tests.scenarios.world import World, naming


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_a_stop_latches_until_clear_and_then_requires_neutral(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("stop").success
    world.hold(0.5, seconds=1.0)
    assert (world.state.mode, world.state.code) == ("stopped", "stopped")
    assert world.state.linear == 0.0
    assert world.call("clear").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "ready"
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"


def test_a_delete_on_stop_is_not_a_stop(world: World) -> None:
    world.put("stop", b"", put=False)
    world.run(0.02)
    assert world.state.mode == "ready"


def test_a_deactivated_robot_ramps_down_and_ignores_commands(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("deactivate").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "inactive"
    assert world.state.linear == 0.0


RELEASE = b'{"release_port": true}'


def test_the_port_is_released_at_rest_until_the_next_activate() -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0")))
    world.drive(0.5, seconds=0.5)
    refused = world.call("deactivate", RELEASE)
    assert (refused.success, world.port.released) == (False, False)
    assert "while the robot rests" in refused.message
    world.hold(0.0, seconds=2.0)
    assert world.call("deactivate", RELEASE).success
    assert (world.state.mode, world.port.released) == ("inactive", True)
    world.run(1.0)
    assert world.state.link == "down"
    assert "link_lost" not in world.state.counters  # lent, not lost
    assert world.call("activate").success
    world.run(1.0)
    assert (world.state.mode, world.port.released) == ("ready", False)


@each("required", [False, True])
def test_a_lent_port_is_silent_on_purpose_so_no_input_counts_as_pressed(required: bool) -> None:
    safety = SafetyConfig(estop="required", bumpers=("front",)) if required else SafetyConfig()
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0"), safety=safety))
    with world.mcu.fault("estop"), world.mcu.fault("bumpers"):
        world.run(1.5)
        assert world.call("deactivate", RELEASE).success
        world.run(5.0)
        assert [cause.code for cause in world.state.causes] == ["switched_off"]
        assert world.call("activate").success
        world.run(2.0)
        assert (world.state.mode, world.state.emergency_stop) == ("ready", "released")
    # The board that came back reports its inputs no more.
    world.run(0.6)
    codes = {cause.code for cause in world.state.causes}
    assert codes == {"emergency_stop_silent", "bumpers_silent"}


def test_an_input_that_is_not_reported_after_a_loan_counts_as_pressed_once_the_link_is_up() -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0")))
    with world.mcu.fault("estop"):
        world.run(1.5)
        assert world.call("deactivate", RELEASE).success
        world.run(5.0)
    world.call("activate")
    world.run(1.5)
    assert [cause.code for cause in world.state.causes] == ["emergency_stop_silent"]


@each("ask", ["stop", "deactivate"])
def test_the_reason_of_each_mode_says_how_to_open_a_released_port(ask: str) -> None:
    world = World(Config(mcu=McuConfig(port="/dev/ttyACM0")))
    world.hold(0.0, seconds=1.0)
    assert world.call(ask).success
    assert world.call("deactivate", RELEASE).success
    world.run(1.0)
    assert "type `acsard call activate` to open it again" in world.state.reason
    if ask == "stop":
        assert world.state.mode == "stopped"
        world.call("clear")
        world.run(1.0)
        assert (world.state.mode, world.state.code) == ("waiting", "port_released")


def test_shutting_down_ramps_to_rest_and_obeys_no_client(world: World) -> None:
    world.drive(0.9, seconds=2.0)
    world.loop.shutting_down = True
    world.hold(0.9, seconds=0.35)
    assert world.loop.at_rest
    assert world.state.mode == "shutdown"
    assert not world.call("activate").success


# A clear releases exactly the causes that its sender was shown


JOE = public_name("joe")
"""The name that the daemon shows for the client "joe"."""


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
    with world.mcu.fault("pushed", 0.5):
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


@pytest.mark.variations(4)
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


def test_the_state_shows_each_cause(world: World) -> None:
    assert world.state.causes == []
    call(world, "stop", "joe")
    (cause,) = world.state.causes
    assert (cause.kind, cause.code, cause.kept) == ("stop", "stopped", False)
    assert (cause.by, cause.text) == (f"{JOE} (native)", f"stopped by {JOE} (native)")
    world.run(1.0)
    with world.mcu.fault("bumpers"), world.mcu.fault("bumper_pressed", 1, 0.0, 0.0):
        world.run(0.5)
    call(world, "deactivate", "ann")
    first, second = world.state.causes
    assert (first.number, second.kind, second.code) == (cause.number, "stop", "bumper")
    assert first.age is not None
    assert second.age is not None
    assert first.age == pytest.approx(1.5, abs=0.1)
    assert second.age == pytest.approx(0.3, abs=0.25)


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
