"""Each kind of message that the daemon must refuse is refused with its code, and moves nothing."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from acsard.core.config.settings import CommandsConfig, Config, OdometryConfig, Source
from acsard.core.incoming.commands import Arrival, Via
from acsard.core.messages.signature import Signature
from tests.each import each
from tests.scenarios.speakers import Speaker
from tests.scenarios.world import World

FAST = b'{"linear": {"x": 0.5}, "angular": {"z": 0.0}}'


def codes(world: World) -> set[str]:
    """Return the codes of the events, and what the sources wait for."""
    return {event.code for event in world.events} | {s.wait for s in world.state.sources}


def arrive(
    world: World, key: str, payload: bytes, attachment: bytes = b"", via: Via = "native"
) -> None:
    world.bus.arrivals.append(
        Arrival(key, True, payload, "", world.now_ns, None, "", via, attachment)
    )


@each(
    ("code", "key", "payload", "attachment", "via"),
    [
        ("wildcard", "cmd/*", FAST, b"", "native"),
        ("too_big", "cmd/app", FAST.ljust(5000), b"", "native"),
        ("unknown_encoding", "cmd/app", b"\x05\x06", b"", "native"),
        ("bad_echo", "cmd/app", FAST, b'{"sender": "a", "echo": 5}', "native"),
        ("wrong_wheels", "wheel_cmd/app", b'{"name": ["x"], "velocity": [1.0]}', b"", "native"),
        ("out_of_range", "speed_limit", b'{"speed_limit": 200, "percentage": true}', b"", "native"),
        ("no_attachment", "cmd/app", FAST, b"", "rmw"),
        ("bad_attachment", "cmd/app", FAST, b"short", "rmw"),
    ],
)
def test_a_message_of_a_wrong_form_has_its_code(
    code: str, key: str, payload: bytes, attachment: bytes, via: Via
) -> None:
    world = World()
    world.run(0.5)
    arrive(world, key, payload, attachment, via)
    world.run(0.5)
    assert code in codes(world)
    assert world.odom.twist.twist.linear.x == 0.0


def test_a_displaced_command_has_its_code() -> None:
    world = World()
    world.run(0.5)
    world.bus.displaced.append(Arrival("cmd/app", True, FAST, "", world.now_ns, None, ""))
    arrive(world, "cmd/app", FAST)
    world.run(0.1)
    assert "displaced" in codes(world)


@each("code", ["other_run", "from_future", "no_echo"])
def test_a_wrong_echo_has_its_code(code: str) -> None:
    world = World()
    speaker = Speaker(world, "client")
    speaker.open()
    message = speaker.message(0.4)
    if code == "from_future":
        message = message._replace(beat_us=message.beat_us + 10_000_000)
    speaker.way = "signed" if code == "no_echo" else "client"
    speaker.deliver(message)
    if code == "other_run":
        last = world.bus.arrivals.pop()
        signature = msgspec.msgpack.decode(last.attachment)
        signature["echo"]["run"] = 1
        world.bus.arrivals.append(replace(last, attachment=msgspec.msgpack.encode(signature)))
    world.run(0.1)
    assert code in codes(world)


def test_two_programs_with_one_sender_id_and_stamps_that_stand_still_have_their_codes() -> None:
    world = World()
    one, other = Speaker(world, "client"), Speaker(world, "client")
    other._sent = 500
    one.hold(0.0, 1.0)
    for _ in range(60):
        one.send(0.2)
        other.send(0.2)
        world.run(0.05)
    assert "copied" in codes(world)
    world = World()
    still = Speaker(world, "header")
    first = still.message(0.0)
    for _ in range(60):
        still.deliver(first._replace(number=still.message(0.0).number))
        world.run(0.05)
    assert "stamps" in codes(world)


@each(
    ("code", "first", "rate"),
    [("no_rate", -1.0, 0.0), ("out_of_range", 0.0, 1e9), ("second_sender", 0.0, 0.1)],
)
def test_a_gyro_sample_without_a_usable_rate_has_its_code(
    code: str, first: float, rate: float
) -> None:
    world = World(Config(odometry=OdometryConfig(gyro=True)))
    world.run(1.0)
    turn = {"x": 0.0, "y": 0.0, "z": rate}
    sample = {"angular_velocity": turn, "angular_velocity_covariance": [first, *[0.0] * 8]}
    arrive(world, "imu", msgspec.json.encode(sample), Signature("other").pack())
    world.run(0.1)
    assert code in codes(world)


def test_sources_of_one_priority_and_too_many_senders_of_one_have_their_codes() -> None:
    sources = Source(name="a", priority=50), Source(name="b", priority=50)
    world = World(Config(commands=CommandsConfig(sources=sources)))
    world.drive(0.2, source="a")
    for _ in range(20):
        world.send(0.2, source="a")
        world.send(0.0, source="b")
        world.run(0.05)
    assert "equal" in codes(world)
    world = World()
    for n in range(100):
        arrive(world, "cmd/app", FAST.replace(b"0.5", b"0.0"), Signature(f"sender {n}").pack())
        world.run(0.001)
    world.run(0.1)
    assert "too_many_senders" in codes(world)
