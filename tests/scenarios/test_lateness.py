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


@pytest.mark.slow
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


@pytest.mark.parametrize("way", FOREIGN)
def test_a_clock_that_was_set_forwards_drives_again_after_one_timeout(way: Way) -> None:
    world = quiet()
    speaker = Speaker(world, way)
    speaker.open()
    speaker.ahead += 0.3
    speaker.hold(0.4, 0.2)
    speaker.hold(0.4, 0.3)
    assert world.state.mode == "driving", world.state.reason


@pytest.mark.parametrize("mends", ["activate", "a restart"])
def test_a_slewed_clock_is_named_beside_the_queue_that_looks_like_it(mends: str) -> None:
    world = quiet()
    speaker = Speaker(world, "rmw")
    speaker.open()
    for _ in range(200):
        speaker.ahead = max(-0.6, speaker.ahead - 0.00415)
        speaker.hold(0.4, 0.05)
    assert (world.state.mode, waits_for(world)) == ("ready", "set_back")
    assert "arrive 0.6 s later than its earliest ones" in world.state.reason
    assert "slewed or set back by as much, or they wait in a queue" in world.state.reason
    if mends == "activate":
        assert world.call("activate").success
    else:
        speaker = Speaker(world, "rmw", "restarted", speaker.ahead)
    speaker.open()


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
