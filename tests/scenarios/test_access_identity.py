"""No published value allows another program to impersonate the sender that drives."""

from __future__ import annotations

import re
from collections.abc import Iterator

import msgspec
import pytest

from acsard.core.messages.encodings import encode
from acsard.core.messages.keys_and_roles import TOPICS
from acsard.core.values import NS_PER_S
from acsard.recording.state import freeze
from tests.scenarios.speakers import Speaker
from tests.scenarios.taped import Tape, recorded_world
from tests.scenarios.world import EVERY_KEY, World

SECRET = "5f0c9d31a7e24b68b1d2c3e4"
VICTIM = f"here/{SECRET}"
AHEAD_NS = NS_PER_S // 50
"""How much later than the victim the attacker stamps, so that its command is the newest."""


def turn_rate(world: World) -> float:
    """The measured turn rate, rad/s, which is known while the link is up."""
    angular = world.state.angular
    assert angular is not None
    return angular


def published(world: World, tape: Tape) -> Iterator[bytes]:
    """Yield all bytes that the daemon makes public.

    These are its messages, its answers, its log and its recording.
    """
    for messages in world.bus.published.values():
        yield from {encode(message, "json") for message in messages}
    for replies in world.bus.replies.values():
        yield from (reply.payload for reply in replies)
    for event in world.events:
        yield msgspec.json.encode(event)
    for step in tape.steps():
        yield repr(step).encode()
    yield freeze(world.loop.robot, world.loop._guard.memory)


def asked_everything(world: World) -> None:
    """Query every key of the daemon, partly with the sender id of the victim."""
    victim = msgspec.msgpack.encode({"sender": VICTIM})
    for topic in TOPICS:
        if topic.direction in ("out", "query") and "<" not in topic.key and topic.key != "alive":
            world.ask(topic.key, fmt="json")
    world.ask("whoami/<role>", "whoami/viewer", attachment=victim)
    world.ask("schema/<Type>", "schema/RobotState")
    world.ask("srv/reset_odometry", attachment=victim)


def driven() -> tuple[World, Speaker, list[bytes]]:
    """Return a robot that a sender (the victim) drives, that sender, and all published bytes."""
    tape, world = recorded_world(wanted=EVERY_KEY)
    victim = Speaker(world, "signed", VICTIM)
    victim.open(0.4)
    asked_everything(world)
    victim.open(0.4)
    return world, victim, list(published(world, tape))


@pytest.mark.slow
def test_the_secret_of_a_sender_is_published_nowhere() -> None:
    world, _, texts = driven()
    assert re.fullmatch(r"here/[0-9a-f]{16}", world.state.sender)
    assert not [text for text in texts if SECRET.encode() in text]


def test_the_session_that_stamps_a_command_is_not_published() -> None:
    tape, world = recorded_world(wanted=EVERY_KEY)
    speaker = Speaker(world, "zenoh", SECRET)
    speaker.open(0.4)
    sender = world.state.sender
    world.put("stop", b"", stamp_ns=1, session=speaker.session)
    world.run(0.1)
    assert not [text for text in published(world, tape) if SECRET.encode() in text]
    (stop,) = (event for event in world.events if event.name == "stop")
    assert re.fullmatch(r"unnamed \(native, session ([0-9a-f]{16})\)", stop.by)
    assert sender in stop.by


@pytest.mark.parametrize("certificate", ["", "anna"])
def test_a_stolen_secret_is_useless_under_another_certificate(certificate: str) -> None:
    world = World()
    victim = Speaker(world, "signed", VICTIM)
    thief = Speaker(world, "signed", VICTIM, ahead=AHEAD_NS / NS_PER_S)
    victim.key += f"/{certificate}" if certificate else ""
    thief.key += "/mallory"
    victim.open(0.4)
    sender = world.state.sender
    assert sender.endswith(" [anna]") == bool(certificate)
    for _ in range(50):
        victim.send(0.4)
        thief.deliver(thief.message(0.0), angular=1.0)
        world.run(0.02)
        assert abs(turn_rate(world)) < 0.01
    assert (world.state.mode, world.state.sender) == ("driving", sender)
    assert world.state.counters["command_other_certificate"] == 50
    assert "this sender id is already in use" in world.state.refused
    world.run(1.0)
    refused = [event for event in world.events if event.name == "command_refused"]
    assert {event.by for event in refused} == {f"{sender.partition(' [')[0]} [mallory]"}


@pytest.mark.slow
def test_a_stolen_secret_is_useless_on_ros_keys() -> None:
    world = World()
    victim = Speaker(world, "signed", VICTIM)
    thief = Speaker(world, "signed", VICTIM, ahead=AHEAD_NS / NS_PER_S)
    thief.via = "bridge"
    victim.open(0.4)
    for _ in range(50):
        victim.send(0.4)
        thief.deliver(thief.message(0.0), angular=1.0)
        world.run(0.02)
        assert abs(turn_rate(world)) < 0.01
