"""`state` says when the pose may be far off although the link is up, and what helps."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from itertools import count

import pytest

from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.values import Received
from tests.scenarios.world import World
from tests.wheels import FOUR, TWO, four_and_two


def world(
    counts: int, link_check: str = "off", configured: int | None = None, wheels: WheelMap = FOUR
) -> World:
    mcu = McuConfig(
        wheels=wheels,
        link_check="on" if link_check == "on" else "off",
        encoder_counts=counts if configured is None else configured,
    )
    return World(Config(mcu=mcu, sim=SimConfig(encoder_counts=counts)))


def drive(world: World, seconds: float = 12.0) -> None:
    world.run(0.5)
    for speed, turn in ((0.5, 0.0), (0.4, 0.8), (0.6, -0.5)):
        world.drive(speed, turn, seconds / 3)


def sigmas(world: World) -> float:
    """Return how many standard deviations the pose is from the true one, along x and y."""
    state, true, odom = world.state, world.mcu.vehicle.pose, world.odom.pose.covariance
    return max(
        abs(state.x - true.x) / math.sqrt(odom[0]), abs(state.y - true.y) / math.sqrt(odom[7])
    )


@pytest.mark.variations(7)
@pytest.mark.parametrize("wrong", [4.0, 0.25, 1.5, 3000 / 3200, 2800 / 3200, 1.05, 1.2])
@four_and_two
def test_counts_that_contradict_the_speeds_are_a_doubt_and_a_warning_has_both_values(
    wrong: float, wheels: WheelMap
) -> None:
    """Either may be wrong, so the pose goes on with the counts."""
    robot = world(3200, "on", round(3200 * wrong), wheels)
    robot.run(0.5)
    robot.drive(0.5, 0.0, 6.0)
    assert robot.state.pose_doubt == "counts_and_speeds_differ"
    (event,) = [event for event in robot.events if event.code == "counts_and_speeds_differ"]
    assert event.name == "pose_doubtful"
    assert re.search(r"[\d.]+ rad by its counts and [\d.]+ rad by its speeds in 5.\d s", event.text)
    assert "mcu.encoder_counts is wrong, or the firmware" in event.text
    robot.hold(0.4, 0.8, 4.0)
    robot.hold(0.0, 0.0, 1.0)
    assert robot.state.x > 0.0
    assert sigmas(robot) < 2.0


@pytest.mark.slow
@pytest.mark.variations(49)
@pytest.mark.parametrize("forward", [1.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize("back", [3.0, 4.0])
@pytest.mark.parametrize("wrong", [0.7, 0.5, 1.6])
@four_and_two
def test_wrong_counts_of_a_robot_that_goes_to_and_fro_are_not_forgotten(
    wrong: float, back: float, forward: float, wheels: WheelMap
) -> None:
    """The way there and back is the same by counts and by speeds, which refutes nothing."""
    robot = world(3200, "on", round(3200 * wrong), wheels)
    robot.run(0.5)
    robot.drive(0.6, 0.0, 6.0)
    for _ in range(5):
        robot.drive(-0.6, 0.0, back)
        robot.drive(0.6, 0.0, forward)
        assert robot.state.pose_doubt == "counts_and_speeds_differ"
        assert robot.state.mode == "driving", robot.state.reason


@pytest.mark.variations(21)
@pytest.mark.parametrize("turn", [0.0, 0.6])
@pytest.mark.parametrize("seconds", [1.0, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("wrong", [0.5, 1.6])
@four_and_two
def test_wrong_counts_of_a_robot_that_goes_to_and_fro_at_once_are_no_fault_of_a_wheel(
    wrong: float, seconds: float, turn: float, wheels: WheelMap
) -> None:
    robot = world(3200, "on", round(3200 * wrong), wheels)
    robot.run(0.5)
    for _ in range(4):
        for speed in (0.6, -0.6):
            robot.drive(speed, turn, seconds)
            assert robot.state.mode == "driving", robot.state.reason


@pytest.mark.slow
@pytest.mark.variations(55)
@pytest.mark.parametrize("counts", [16, 96, 3200])
@pytest.mark.parametrize("lag", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("speed", [0.05, 0.3, 0.8])
@four_and_two
def test_a_firmware_that_filters_its_speeds_contradicts_no_counts(
    speed: float, lag: float, counts: int, wheels: WheelMap
) -> None:
    robot = world(counts, "on", wheels=wheels)
    measured, filtered = robot.mcu._speeds, [0.0] * 4

    def speeds(now_ns: int) -> list[float]:
        nonlocal filtered
        keep = math.exp(-0.01 / lag) if lag else 0.0
        rows = zip(measured(now_ns), filtered, strict=False)
        filtered = [keep * before + (1 - keep) * now for now, before in rows]
        return filtered

    robot.mcu._speeds = speeds  # type: ignore[method-assign]
    robot.run(0.5)
    for k in range(10):
        robot.drive(speed, 0.3 * (-1) ** k, 2.3)
        robot.drive(-speed / 2, 0.0, 0.7)
    assert robot.state.pose_doubt == ""
    assert sigmas(robot) < 3.0


def test_encoders_that_tremble_at_rest_contradict_no_speeds() -> None:
    robot = world(3200, "on")
    robot.run(0.5)
    robot.drive(0.3, 0.0, 2.0)
    robot.hold(0.0, 0.0, 1.0)
    sample, calls = robot.mcu._sample, count()

    def trembling() -> tuple[int, ...]:
        now, *counts = sample()
        return now, *[n + next(calls) % 2 for n in counts]

    robot.mcu._sample = trembling  # type: ignore[method-assign]
    robot.run(8.0)
    assert robot.state.pose_doubt == ""


@four_and_two
@pytest.mark.parametrize(("counts", "configured"), [(64, 16), (24, 96), (64, 32)])
def test_what_wrong_counts_moved_before_they_were_noticed_is_a_doubt(
    counts: int, configured: int, wheels: WheelMap
) -> None:
    robot = world(counts, "on", configured, wheels)
    robot.run(0.5)
    robot.drive(0.5, 0.0, 1.5)
    robot.hold(0.0, 0.0, 1.0)
    assert sigmas(robot) < 3.0


def test_what_wrong_counts_moved_is_the_same_doubt_with_any_wiring() -> None:
    def covariance(wheels: WheelMap) -> list[float]:
        mcu = McuConfig(link_check="on", encoder_counts=16, wheels=wheels)
        robot = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=64)))
        robot.run(0.5)
        robot.drive(0.5, 0.0, 1.5)
        robot.hold(0.0, 0.0, 1.0)
        return robot.odom.pose.covariance

    swapped = covariance(WheelMap(front_left="-a", front_right="+b"))
    assert swapped == pytest.approx(covariance(WheelMap()))


@pytest.mark.variations(2)
@pytest.mark.parametrize("configured", [100, 400])
def test_lines_are_not_judged_by_counts_that_are_wrong(configured: int) -> None:
    robot = world(20, "on", configured)
    robot.run(0.5)
    robot.drive(0.5, 0.0, 1.0)
    before = robot.state.counters.get("line_implausible", 0)
    robot.hold(0.5, 0.0, 7.0)
    robot.hold(0.0, 0.0, 1.0)
    assert robot.state.pose_doubt == "counts_and_speeds_differ"
    assert robot.state.counters.get("line_implausible", 0) == before
    assert sigmas(robot) < 3.0


def test_right_counts_are_used_from_the_first_second_of_driving() -> None:
    robot = world(3200, "on")
    drive(robot, 3.0)
    assert robot.state.pose_doubt == ""


@pytest.mark.variations(8)
@pytest.mark.parametrize("counts", [16, 96])
@pytest.mark.parametrize("configured", [True, False])
@four_and_two
def test_a_coarse_encoder_on_a_plain_link_that_loses_replies_advises_the_checked_link(
    counts: int, configured: bool, wheels: WheelMap
) -> None:
    robot = world(counts, configured=None if configured else 0, wheels=wheels)
    with robot.mcu.fault("lost_replies", 20):
        drive(robot)
    assert robot.state.pose_doubt == "coarse_encoder"
    (event,) = [event for event in robot.events if event.name == "pose_doubtful"]
    assert 'mcu.link_check = "on"' in event.text


@pytest.mark.variations(2)
@pytest.mark.parametrize("counts", [16, 96])
def test_a_coarse_encoder_behind_an_adapter_of_16_ms_advises_the_checked_link(counts: int) -> None:
    robot = world(counts)
    with robot.mcu.fault("ftdi", 0.016):
        drive(robot)
    assert robot.state.pose_doubt == "coarse_encoder"


@pytest.mark.variations(9)
@pytest.mark.parametrize(("link_check", "wheels"), [("off", FOUR), ("on", FOUR), ("off", TWO)])
@pytest.mark.parametrize(
    ("counts", "code"), [(16, "encoder_counts_missing"), (96, "encoder_counts_missing"), (400, "")]
)
def test_coarse_encoders_whose_counts_are_not_declared_advise_to_declare_them(
    counts: int, code: str, link_check: str, wheels: WheelMap
) -> None:
    robot = world(counts, link_check, 0, wheels)
    drive(robot)
    assert robot.state.pose_doubt == code
    doubts = [event.text for event in robot.events if event.name == "pose_doubtful"]
    assert ["mcu.encoder_counts is not set" in text for text in doubts] == [True] * bool(code)


def lost(robot: World) -> None:
    robot.mcu.switches.lose_reply = 20


def held(robot: World) -> None:
    robot.mcu.switches.latency_ns = 16_000_000


def nothing(robot: World) -> None:
    pass


@pytest.mark.variations(5)
@pytest.mark.parametrize(
    ("counts", "link_check", "fault"),
    [
        (16, "off", nothing), (96, "off", nothing), (3200, "off", lost), (3200, "off", held),
        (16, "on", lost), (16, "on", held),
    ],
)  # fmt: skip
@four_and_two
def test_a_sound_link_or_a_fine_encoder_gets_no_advice(
    counts: int, link_check: str, fault: Callable[[World], None], wheels: WheelMap
) -> None:
    robot = world(counts, link_check, wheels=wheels)
    fault(robot)
    robot.run(0.5)
    for number in range(12):
        robot.hold(0.5, 0.4 * (-1) ** number, 1.0)
        robot.stall(0.15)
    assert robot.state.pose_doubt == ""
    assert not [event for event in robot.events if event.name == "pose_doubtful"]


@pytest.mark.parametrize("late", [False, True])
def test_the_link_comes_up_and_stays_up_if_every_reply_arrives_twice(late: bool) -> None:
    robot = world(3200, "on")
    feed, before = robot.port.feed, b""

    def twice(received: Received) -> None:
        nonlocal before
        copy, before = before if late else received.data, received.data
        feed(Received(received.at, received.data + copy))

    robot.port.feed = twice  # type: ignore[method-assign]
    robot.run(1.0)
    assert robot.state.link == "up"
    drive(robot, 3.0)
    assert "link_lost" not in robot.state.counters
    assert robot.state.counters["line_repeated"] > 300
    assert robot.state.mode == "driving"
