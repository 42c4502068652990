"""The robot ignores outdated commands on networks with growing or constant delays."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from acsard.core.values import NS_PER_S
from tests.each import each
from tests.scenarios.speakers import FOREIGN, STAMPED, Message, Speaker, Way, moved, over
from tests.scenarios.world import World

BASE_S = 0.005
TIMEOUT_S = 0.25
BOUND_S = BASE_S + TIMEOUT_S + 0.1  # age of the oldest command that may be obeyed


def quiet() -> World:
    world = World()
    world.run(0.3)
    return world


def driven_over(way: Way, delay: Callable[[float], float], seconds: float) -> tuple[float, int]:
    """Drive first without delays and then over this network.

    The sender sends zeros for 0.5 s in every 5 s. Returns the largest age of an obeyed speed in s,
    and the number of obeyed speeds.
    """
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    return over(
        world,
        speaker,
        lambda t: BASE_S + delay(t),
        lambda t: 0.0 if t % 5.0 > 4.5 else 0.4,
        seconds,
    )


def waits_for(world: World, source: str = "app") -> str:
    return {entry.name: entry.wait for entry in world.state.sources}[source]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "seconds"),
    [(lambda t: 0.095 * t, 30.0), (lambda t: 0.5 * (t > 3.0), 12.0), (lambda t: 8 * (t > 3), 12.0)],
    ids=["grows", "0.5 s", "8 s"],
)
@pytest.mark.parametrize("way", STAMPED)
def test_no_delay_that_grows_or_jumps_is_mistaken_for_a_clock_adjustment(
    way: Way, delay: Callable[[float], float], seconds: float
) -> None:
    oldest, obeyed = driven_over(way, delay, seconds)
    assert obeyed > 20
    assert oldest <= BOUND_S


def rested(world: World, speaker: Speaker, queue_s: float, seconds: float) -> None:
    """Press the dead-man button of a joystick behind a queue again and again.

    A press: 0.5 s of zeros, 3 s of speed and 0.5 s of zeros, and then 2.5 s of silence.
    """
    queue: list[tuple[int, Message]] = []
    for step in range(round(seconds * 20)):
        at = step * 0.05 % 6.5
        if at < 4.0:
            due_ns = world.now_ns + int(queue_s * NS_PER_S)
            queue.append((due_ns, speaker.message(0.4 if 0.5 <= at < 3.5 else 0.0)))
        while queue and queue[0][0] <= world.now_ns:
            speaker.deliver(queue.pop(0)[1])
        world.run(0.05)


@pytest.mark.variations(5)
@pytest.mark.parametrize("way", STAMPED)
def test_a_joystick_behind_a_queue_that_began_in_a_pause_moves_nothing(way: Way) -> None:
    """A former defect moved the robot by 10.9 m in 60 s while the stick rested."""
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    world.run(2.5)
    since_ns = world.now_ns
    rested(world, speaker, 3.0, 20.0)
    assert not moved(world, since_ns)
    assert waits_for(world) in ("set_back", "too_old", "round_trip", "command")


def test_of_a_queue_that_exists_before_the_first_command_none_with_an_echo_is_obeyed() -> None:
    """A former defect obeyed 330 commands that were 8 s old."""
    world = quiet()
    speed = lambda t: 0.0 if t < 1.0 else 0.4  # noqa: E731
    oldest, obeyed = over(world, Speaker(world, "client"), lambda t: 8.0, speed, 20.0)
    assert (oldest, obeyed) == (0.0, 0)
    assert world.state.counters["command_round_trip"] > 300


@pytest.mark.variations(4)
@pytest.mark.parametrize("way", FOREIGN)
def test_without_an_echo_a_constant_queue_from_the_first_command_on_cannot_be_seen(
    way: Way,
) -> None:
    """The pages say so: a stamp shows only the rise of a delay."""
    world = quiet()
    speed = lambda t: 0.0 if t < 1.5 else 0.4  # noqa: E731
    oldest, obeyed = over(world, Speaker(world, way), lambda t: 8.0, speed, 10.0)
    assert oldest == pytest.approx(8.0)
    assert obeyed > 150


def test_too_long_a_round_trip_is_named_with_its_length_and_the_setting() -> None:
    world = quiet()
    speaker = Speaker(world, "client")
    over(world, speaker, lambda t: 0.41, lambda t: 0.0, 4.0)
    assert waits_for(world) == "command"
    messages = []
    for _ in range(8):
        messages.append(speaker.message(0.4))
        world.run(0.05)
    for _ in range(60):
        speaker.deliver(messages.pop(0))
        messages.append(speaker.message(0.4))
        world.run(0.05)
    assert waits_for(world) == "round_trip"
    (text,) = [entry.waits_for for entry in world.state.sources if entry.name == "app"]
    assert text == (
        "the round trip to app takes 0.4 s, but its timeout allows at most 0.3 s; echo the newest "
        "beat, not an old one; if the network is as slow, raise the timeout of the source in "
        "commands.sources"
    )


@each("way", STAMPED)
def test_a_sender_drives_on_as_soon_as_it_is_prompt_again(way: Way) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    messages = [speaker.message(0.4) for _ in range(3)]
    world.run(8.0)
    for message in messages:
        speaker.deliver(message)
    world.run(0.02)
    assert world.state.mode == "ready"
    assert waits_for(world) == ("too_old" if way == "client" else "stale")
    speaker.hold(0.4, 1.0)
    assert world.state.mode == "driving"


# clocks that are set


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("way", "end"),
    [*((way, "activate") for way in FOREIGN), ("signed", "new sender"), ("rmw", "new sender")],
)
def test_a_clock_that_was_set_back_is_named_until_activate_or_a_new_sender(
    way: Way, end: str
) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    speaker.ahead -= 5.0
    speaker.hold(0.4, 0.3)
    since_ns = world.now_ns + NS_PER_S // 2
    speaker.hold(0.4, 4.0)
    assert waits_for(world) == "set_back"
    speaker.hold(0.0, 2.0)
    speaker.hold(0.4, 1.0)
    assert not moved(world, since_ns)
    if end == "activate":
        world.call("activate")
    else:
        speaker.name = "b"
    speaker.open()


@pytest.mark.parametrize("way", FOREIGN)
def test_a_clock_that_was_set_forwards_drives_again_after_one_timeout(way: Way) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    speaker.ahead += 0.3
    speaker.hold(0.4, 0.2)
    speaker.hold(0.4, 0.3)
    assert world.state.mode == "driving", world.state.reason


STAMPS: dict[str, Callable[[float], float]] = {
    "frozen": lambda t: 13.347,
    "half speed": lambda t: 100 + 0.5 * t,
    "seconds": lambda t: 100.0 + int(t),
    "double speed": lambda t: 100 + 2.0 * t,
    "a bag in a loop": lambda t: 100 + t % 1.5,
}


@pytest.mark.variations(3)
@each("kind", list(STAMPS))
@pytest.mark.parametrize("way", ["rmw", "header", "signed"])
def test_stamps_that_are_no_times_are_named_and_never_drive_for_long(way: Way, kind: str) -> None:
    """Without a word about stamps, `state` asked for a zero for ever, or called the sender new."""
    world = quiet()
    speaker, codes = Speaker(world, way), []
    for step in range(200):
        at = step * 0.05
        message = speaker.message(0.0 if at < 1.5 else 0.3)
        speaker.deliver(message._replace(stamp_ns=int(STAMPS[kind](at) * NS_PER_S)))
        world.run(0.05)
        if at > 4.5:
            codes.append(waits_for(world))
            assert world.state.mode == "ready"
    assert set(codes) == {"stamps"} if kind != "a bag in a loop" else set(codes) <= {
        "stamps", "set_back", "stale", "not_newer",
    }  # fmt: skip
    (text,) = [entry.waits_for for entry in world.state.sources if entry.name == "app"]
    assert "use_sim_time" in text or kind == "a bag in a loop"


# order


@pytest.mark.parametrize("way", STAMPED)
def test_a_command_that_comes_again_and_again_is_obeyed_once(way: Way) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    again = speaker.message(0.4)
    for _ in range(40):
        speaker.deliver(again)
        world.run(0.05)
    assert world.state.mode == "ready"
