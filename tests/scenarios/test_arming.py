"""A sender is armed by a zero of its own, never by the zero of another.

`python -m tests.scenarios.test_arming 1000` plays so many starts and returns of two senders.
"""

from __future__ import annotations

import random
import sys
from typing import get_args

import msgspec
import pytest
from msgspec.structs import replace

from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Query
from acsard.core.values import NS_PER_S
from tests.each import each, more
from tests.scenarios.speakers import FOREIGN, SHARED, STAMPED, Speaker, Way, moved
from tests.scenarios.world import SIGNED, World, naming

OWN: tuple[Way, ...] = ("client", "signed", "rmw")


def quiet() -> World:
    world = World()
    world.run(0.3)
    return world


def long(count: int) -> object:
    return pytest.param(count, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])


def cleared(way: Way, *names: str) -> tuple[World, list[Speaker]]:
    """Return a world after `stop` and `clear`, and senders whose delays the daemon has proved."""
    world = quiet()
    speakers = [Speaker(world, way, name) for name in names]
    for speaker in speakers:
        speaker.open()
        world.run(1.2)
    world.call("stop")
    world.run(2.1)
    assert world.call("clear").success
    world.run(0.1)
    return world, speakers


@pytest.mark.slow
@pytest.mark.variations(4)
@pytest.mark.parametrize("count", [2, more(30), long(100)])
@pytest.mark.parametrize("way", get_args(Way))
def test_the_zeros_of_one_program_never_arm_another(way: Way, count: int) -> None:
    """One client sends only zeros and another one only speeds, and the robot stays at rest.

    Before this rule the robot moved 2.1 m in 5 s.
    """
    for seed in range(count):
        dice = random.Random(seed)
        world = quiet()
        zeros, speeds = Speaker(world, way, "zeros"), Speaker(world, way, "speeds")
        zero_hz, speed_hz = dice.choice((5.0, 10.0, 30.0)), dice.choice((10.0, 20.0, 50.0))
        due = [dice.uniform(0.0, 0.5), dice.uniform(0.0, 0.5)]
        start_ns = world.now_ns
        while min(due) < 5.0:
            number = due.index(min(due))
            at_ns = start_ns + int(due[number] * 1e9)
            world.run(max(0.0, (at_ns - world.now_ns) / 1e9))
            (zeros, speeds)[number].send((0.0, 0.5)[number])
            due[number] += 1 / (zero_hz, speed_hz)[number] * dice.uniform(0.9, 1.1)
        assert not moved(world, start_ns), seed


@pytest.mark.slow
@pytest.mark.parametrize("count", [10, more(40), long(1000)])
def test_programs_whose_stamps_come_from_several_routers_never_arm_each_other(
    count: int,
) -> None:
    """One program sends only zeros and another one only speeds, and the robot stays at rest.

    The Zenoh session that stamps a message changes between two routers and the program itself. Some
    messages have no stamp.
    """
    for seed in range(count):
        dice = random.Random(seed)
        world = quiet()
        start_ns, at_s = world.now_ns, 0.0
        programs = [Speaker(world, "routed", name) for name in ("zeros", "speeds")]
        hz, changes = (dice.choice((5.0, 10.0, 20.0)), 10.0), [0.0, 0.0]
        while at_s < 8.0:
            for number, speaker in enumerate(programs):
                if at_s >= changes[number]:
                    changes[number] = at_s + dice.choice((0.05, 0.3, 1.2, 2.5))
                    ways: tuple[Way, ...] = ("routed", "routed", "zenoh", "plain")
                    speaker.way = dice.choice(ways)
                    names = ("router 1", "router 2")
                    own = f"session of {speaker.name}"
                    speaker.session = dice.choice(names) if speaker.way == "routed" else own
                if dice.random() < hz[number] / 20.0:
                    speaker.send((0.0, 0.5)[number])
                world.run(0.025)
                at_s += 0.025
        assert not moved(world, start_ns), seed


@pytest.mark.slow
def test_a_program_whose_stamping_router_changes_must_send_a_zero_again_and_then_drives() -> None:
    world = quiet()
    speaker = Speaker(world, "routed")
    speaker.open()
    speaker.session = "another router"
    speaker.hold(0.4, 1.5)
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"
    speaker.open()


@pytest.mark.slow
@pytest.mark.parametrize("way", SHARED)
def test_a_shared_sender_that_many_senders_displaced_must_still_return_to_neutral(way: Way) -> None:
    world = quiet()
    zeros, speeds = Speaker(world, way), Speaker(world, way)
    crowd = [Speaker(world, "signed", f"stranger {number}") for number in range(40)]
    start_ns = world.now_ns
    for number in range(100):
        speeds.send(0.5)
        if number % 2:
            zeros.send(0.0)
        crowd[number % 40].send(0.3)
        world.run(0.05)
    assert not moved(world, start_ns)


@pytest.mark.variations(8)
@pytest.mark.parametrize("pauses", [(1.1, 1.1, 5.0), pytest.param((60.0,), marks=pytest.mark.slow)])
@pytest.mark.parametrize("way", get_args(Way))
def test_a_pause_arms_no_sender(way: Way, pauses: tuple[float, ...]) -> None:
    """A sender that pauses after a `clear` and sends speeds again does not move the robot.

    A user repeated `ros2 topic pub -r 10 /cmd_vel` after Ctrl-C, and the robot moved 2.0 m.
    """
    world, (speaker,) = cleared(way, "a")
    since_ns = world.now_ns
    for pause in pauses:
        speaker.hold(0.5, 1.0, 10.0)
        world.run(pause)
    speaker.hold(0.5, 1.0, 10.0)
    assert not moved(world, since_ns)


@pytest.mark.slow
@each("way", get_args(Way))
def test_a_network_that_loses_all_messages_for_a_while_arms_no_sender(way: Way) -> None:
    world, (speaker,) = cleared(way, "a")
    since_ns = world.now_ns
    for _ in range(3):
        speaker.hold(0.5, 1.0)
        for _ in range(30):
            speaker.message(0.5)  # lost
            world.run(0.05)
    assert not moved(world, since_ns)


@pytest.mark.slow
@each("way", OWN)
def test_a_zero_of_an_unshared_identity_arms_immediately_even_right_after_speeds(way: Way) -> None:
    world, (speaker,) = cleared(way, "a")
    speaker.hold(0.4, 1.0)
    assert world.state.mode == "ready"
    speaker.hold(0.0, 0.05)
    speaker.hold(0.4, 0.1)
    assert world.state.mode == "driving"


@pytest.mark.slow
@pytest.mark.parametrize("way", SHARED)
def test_a_zero_of_a_shared_identity_arms_when_no_speed_has_followed_for_a_second(way: Way) -> None:
    world, (speaker,) = cleared(way, "a")
    speaker.hold(0.4, 1.0)
    for quiet_s, mode in ((0.9, "ready"), (1.0, "driving")):
        speaker.send(0.0)
        world.run(quiet_s)
        speaker.hold(0.4, 0.2)
        assert world.state.mode == mode


@each("way", ["zenoh", "routed", "bridge"])
def test_a_flood_of_unsigned_junk_on_a_key_keeps_no_other_sender_disarmed(way: Way) -> None:
    world = quiet()
    joystick = Speaker(world, way)
    flood = [Arrival("cmd/app", True, b"junk", "", 0, None, "")] * 20
    for speed in [0.0] * 24 + [0.4] * 4:
        joystick.send(speed)
        for _ in range(5):
            junk = [replace(arrival, arrived_ns=world.now_ns) for arrival in flood]
            world.bus.arrivals += junk[4:]
            world.bus.displaced += junk[3:4]
            world.run(0.01)
    assert world.state.counters["command_displaced"] == 28 * 5
    assert world.state.mode == "driving"


@pytest.mark.slow
@each("way", SHARED)
@each("hz", [1.5, 5.0, 20.0])
def test_more_zeros_of_a_shared_identity_neither_help_nor_harm(way: Way, hz: float) -> None:
    world, (speaker,) = cleared(way, "a")
    since_ns = world.now_ns
    speaker.hold(0.4, 0.5)
    speaker.hold(0.0, 0.8, hz)
    speaker.hold(0.4, 0.5)
    assert not moved(world, since_ns)
    speaker.hold(0.0, 1.4, hz)
    speaker.hold(0.4, 0.2)
    assert world.state.mode == "driving"


@pytest.mark.variations(8)
@pytest.mark.parametrize(
    "pauses", [(0.3, 1.0, 9.0), pytest.param((9.5, 9.5), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("way", get_args(Way))
def test_an_armed_sender_stays_armed_and_just_drives_again(
    way: Way, pauses: tuple[float, ...]
) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    for pause in pauses:
        world.run(pause)
        speaker.hold(0.4, 0.2)
        assert world.state.mode == "driving", world.state.reason


@pytest.mark.slow
@each("way", get_args(Way))
def test_a_first_command_without_a_zero_gets_a_reason_in_plain_words(way: Way) -> None:
    """A new clock is unproven for one timeout. Then, as without a clock, only the zero is missing.

    Our own client echoes a beat, so it has nothing to prove.
    """
    world = quiet()
    speaker = Speaker(world, way, "b")
    codes: list[str] = []
    for _ in range(20):
        speaker.hold(0.4, 0.05)
        codes.append(world.state.code)
    unproven = codes.count("unproven")
    assert codes == ["unproven"] * unproven + ["neutral"] * (20 - unproven)
    timeout = next(s.timeout for s in world.config.commands.sources if s.name == "app")
    stamped = way in FOREIGN or way == "routed"
    assert abs(unproven * 0.05 - (timeout if stamped else 0.0)) < 0.051 * stamped + 1e-9
    waits = {source.name: source.waits_for for source in world.state.sources}["app"]
    assert "send a zero first" in waits
    assert ("no speed for 1 s" in waits) == (way in SHARED)


@pytest.mark.slow
@each("way", STAMPED)
def test_after_clear_a_held_key_has_no_effect_until_it_is_released(way: Way) -> None:
    world, (speaker,) = cleared(way, "a")
    since_ns = world.now_ns
    speaker.hold(0.4, 5.0)
    assert not moved(world, since_ns)
    assert world.state.code == "neutral"


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, more(60)])
def test_a_proven_zero_of_one_program_never_arms_the_delayed_speeds_of_another(count: int) -> None:
    """One program sends one zero, and another one sends speeds with a header through heavy jitter.

    The robot stays at rest.
    """
    for seed in range(count):
        dice = random.Random(seed)
        world = quiet()
        zeros, speeds = Speaker(world, "plain"), Speaker(world, "header")
        zeros.send(0.0)
        start_ns, arrival = world.now_ns, 0.0
        for number in range(160):
            sent = number / 20 + (2.5 if number > 80 else 0.0)
            previous, arrival = arrival, max(arrival, sent + dice.expovariate(1 / 0.06))
            world.run(max(0.0, sent - (world.now_ns - start_ns) / 1e9))
            message = speeds.message(0.5)
            world.run(max(0.0, arrival - max(sent, previous)))
            speeds.deliver(message)
        assert not moved(world, start_ns), seed


@pytest.mark.slow
@each("stall", [0.02, 0.1])
def test_a_zero_from_before_a_restart_of_the_board_arms_no_sender(stall: float) -> None:
    """A clear, a zero and a restart of the board arrive while the control loop is stalled.

    The next step reads all of them. Afterwards the sender must still send a new zero.
    """
    world = quiet()
    world.drive(0.4, seconds=0.5)
    world.call("stop")
    world.run(3.0)
    payload = naming(world.numbers)
    at_ns, ms = world.now_ns, 1_000_000
    clear = Query(999, "srv/clear", "srv/clear", "", payload, "", at_ns + ms)
    zero = msgspec.json.encode({"linear": {"x": 0.0}, "angular": {"z": 0.0}})
    arrival = Arrival("cmd/app", True, zero, "", at_ns + 2 * ms, None, "", attachment=SIGNED)
    world.bus.queries.append(clear)
    world.bus.arrivals.append(arrival)
    world.stall(stall / 2)
    world.mcu.reset(world.now_ns, deaf_ns=2 * ms)
    world.stall(stall / 2)
    since_ns = world.now_ns
    for _ in range(60):
        world.send(0.4)
        world.run(0.05)
    assert not moved(world, since_ns)
    assert world.state.code == "neutral"


@each("way", ["plain", "bridge"])
def test_a_stall_of_the_daemon_does_not_count_as_a_pause_after_another_sender_s_zero(
    way: Way,
) -> None:
    """Two programs share a sender identity: one sends a zero, the other one speeds.

    The daemon stalls after the zero. Its next step begins before the bus delivers the waiting
    speeds. The robot stays at rest.
    """
    world = World()
    world.run(1.0)
    first, other = Speaker(world, way), Speaker(world, way)
    other.hold(0.4, 1.0)
    first.send(0.0)
    world.run(0.02)
    world.stall(1.0)
    world.run(0.0005)
    other.hold(0.4, 2.0)
    assert world.state.mode == "ready"
    assert world.odom.pose.pose.position.x == 0.0


@each("way", get_args(Way))
def test_a_sender_that_was_silent_for_ten_seconds_must_send_a_zero_again(way: Way) -> None:
    """The first speed after an hour of silence moved the robot by 1.16 m in 3 s."""
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    world.run(10.5)
    since_ns = world.now_ns
    speaker.hold(0.4, 2.0)
    assert not moved(world, since_ns)
    assert world.state.code == "neutral"
    speaker.send(0.0)
    world.run(1.1)
    speaker.hold(0.4, 0.3)
    assert world.state.mode == "driving"


def test_two_programs_with_a_gid_of_zeros_never_arm_each_other() -> None:
    """They drove the robot by 2.18 m."""
    world = quiet()
    one, other = (Speaker(world, "rmw", "\0" * 16) for _ in range(2))
    since_ns = world.now_ns
    for number in range(100):
        other.send(0.4)
        world.run(0.02)
        if number % 10 == 5:
            one.send(0.0)
        world.run(0.03)
    assert not moved(world, since_ns)


# neutral_first = "pause"


def navigating(way: Way, name: str = "nav2") -> tuple[World, Speaker]:
    """Return a world in which a pause counts, and a sender to the source `nav`."""
    world = World()
    world.run(6.5)
    speaker = Speaker(world, way, name)
    speaker.key = "cmd/nav"
    return world, speaker


@each("way", get_args(Way))
def test_where_a_pause_arms_every_goal_drives_without_a_zero(way: Way) -> None:
    world, nav = navigating(way)
    for pause in (1.1, 12.0, 0.0):
        nav.hold(0.4, 1.0)
        assert world.state.mode == "driving", world.state.reason
        nav.hold(0.0, 0.3)
        world.run(pause)


@each("event", ["clear", "deactivate", "link", "reset", "restart", "stall"])
@each("way", ["rmw", "bridge", "client"])
def test_where_a_pause_arms_a_goal_under_way_does_not_drive_after_an_event(
    way: Way, event: str
) -> None:
    world, nav = navigating(way)
    if event == "restart":
        world = World()
        nav.world = world
        world.run(4.5)  # until its Zenoh client tries again
    else:
        nav.hold(0.4, 1.0)
    match event:
        case "clear":
            world.call("stop")
            nav.hold(0.4, 2.2)
            assert world.call("clear").success
        case "deactivate":
            world.call("deactivate")
            nav.hold(0.4, 2.2)
            assert world.call("activate").success
        case "link":
            mcu = world.mcu
            world.port.unplug()
            nav.hold(0.4, 1.5)
            world.port.plug(mcu)
        case "reset":
            world.mcu.reset(world.now_ns)
            nav.hold(0.4, 1.5)
        case "stall":
            # The goal begins in a second that the daemon has not watched.
            nav.hold(0.0, 0.2)
            world.run(12.0)
            world.stall(1.2)
    since_ns = world.now_ns + NS_PER_S // 2 * (event in ("clear", "deactivate"))
    nav.hold(0.4, 3.0)
    assert not moved(world, since_ns)
    assert world.state.code == "neutral", world.state.reason
    world.run(1.1)
    nav.hold(0.4, 0.5)  # the goal was cancelled and sent again
    assert world.state.mode == "driving"


def test_where_a_pause_arms_a_replaced_sender_has_not_paused() -> None:
    world, nav = navigating("signed")
    world.call("stop")
    world.run(2.1)
    world.call("clear")
    since_ns, crowd = world.now_ns, []
    for number in range(20):
        crowd.append(Speaker(world, "signed", f"stranger {number}"))
        crowd[-1].key = "cmd/nav"
    for _ in range(60):
        for speaker in (nav, *crowd):
            speaker.send(0.4)
        world.run(0.05)
    assert not moved(world, since_ns)


# starts and returns

ALONE: tuple[Way, ...] = ("header", "plain", "bridge", "routed")
"""Routes on which all programs of a source have one identity."""


def arrive(dice: random.Random) -> None:
    """Let two senders start, and return after a silence, in random order.

    Check that a speed without a zero moves nothing, and that each speed after a zero moves.
    """
    world = World()
    world.run(dice.uniform(0.3, 3.0))
    senders = [Speaker(world, dice.choice(get_args(Way)), name) for name in "ab"]
    for speaker in senders:
        speaker.ahead = dice.choice([0.0, -40.0, -3600.0])
    same = all(speaker.way not in ALONE for speaker in senders)
    senders[1].key = "cmd/app" if same else "cmd/teleop"
    for silence in (0.0, dice.uniform(10.5, 14.0)):
        world.run(silence)
        dice.shuffle(senders)
        for speaker in senders:
            since_ns, zero = world.now_ns, dice.random() < 0.5
            if zero:
                for _ in range(dice.choice([1, 1, 5])):
                    speaker.send(0.0)
                    world.run(0.05)
                world.run(1.1)
            speaker.hold(0.4, 0.6, dice.choice([10.0, 20.0, 50.0]))
            assert moved(world, since_ns) == zero, (speaker.way, silence, world.state.reason)
            world.run(1.0)


@pytest.mark.parametrize("seed", range(12))
def test_of_two_senders_none_moves_unarmed_and_each_armed_one_moves(seed: int) -> None:
    arrive(random.Random(seed))


if __name__ == "__main__":
    for seed in range(int(sys.argv[1])):
        arrive(random.Random(seed))
