"""A wheel that contradicts its command soon causes a fault. A pushed wheel never does."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.codes import Reason
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.wheel_faults import LEFT, RIGHT, WheelFaults
from acsard.core.motion.wheel_witness import Witness
from acsard.core.values import STILL, WHEELS, WheelSpeeds
from tests.each import each

DT = 0.01
TEN = WheelSpeeds(10.0, 10.0, 10.0, 10.0)


def watching(settings: FeedbackConfig | None = None) -> WheelFaults:
    return WheelFaults(Kinematics(DriveConfig()), 3200, settings or FeedbackConfig())


def only(wheel: int, speed: float, others: float = 0.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


def both(wheel: int, speed: float) -> WheelSpeeds:
    """Return the speeds of a robot on which only the side of this wheel turns, rad/s."""
    side = LEFT if wheel in LEFT else RIGHT
    return WheelSpeeds(*(speed if i in side else 0.0 for i in range(4)))


def noisy(speeds: WheelSpeeds, step: int) -> WheelSpeeds:
    """Return encoder speeds that differ from line to line, as real encoders do."""
    return WheelSpeeds(*(speed + 0.1 * (step % 2) for speed in speeds.as_tuple()))


def named(fault: Reason | None) -> str:
    """Return the wheel and the code of a fault; "" for None."""
    return "" if fault is None else f"{fault.part} {fault.code}"


def first(faults: Iterable[Reason | None]) -> str:
    """Return the wheel and the code of the first fault; "" if there is none."""
    return named(next(filter(None, faults), None))


def watched(
    sent: WheelSpeeds, feedback: WheelSpeeds, seconds: float = 3.0, jitter: float = 0.0
) -> tuple[float, str]:
    """Return the time and text of the fault, or (inf, "") if there is none."""
    robot = watching()
    for step in range(round(seconds / DT)):
        noisy = WheelSpeeds(*(s + jitter * (step % 2) for s in feedback.as_tuple()))
        fault = robot.watch(sent, noisy, DT)
        if fault:
            return (step + 1) * DT, named(fault)
    return math.inf, ""


def watched_after_driving(wheel: int, sent: float, speed: float, jitter: float = 0.0) -> str:
    """Return the fault within two seconds, after three seconds of correct driving."""
    robot = watching()
    target = WheelSpeeds(*[sent] * 4)
    assert not any(robot.watch(target, noisy(target, step), DT) for step in range(300))
    faults = (
        robot.watch(target, only(wheel, speed + jitter * (step % 2), sent), DT)
        for step in range(200)
    )
    return first(faults)


def driven(speed: float, settings: FeedbackConfig | None = None) -> WheelFaults:
    """Return a check that has watched a robot follow its commands for three seconds."""
    robot, target = watching(settings or FeedbackConfig()), WheelSpeeds(speed, speed, speed, speed)
    assert not any(robot.watch(target, noisy(target, step), DT) for step in range(300))
    return robot


def test_forgetting_drops_the_evidence_against_every_wheel() -> None:
    robot = watching()
    for _ in range(3):
        assert not any(robot.watch(TEN, STILL, DT) for _ in range(45))
        robot.forget()


@each("wheel", range(4))
@each(
    ("sent", "speed", "word"),
    [
        (10.0, 0.0, "wheel_dead"),
        (-10.0, 0.0, "wheel_dead"),
        (10.0, -9.0, "wheel_reversed"),
        (-10.0, 9.0, "wheel_reversed"),
        (10.0, 18.0, "wheel_runaway"),
        (10.0, 3.0, "wheel_stuck"),
    ],
)
def test_a_contradiction_is_a_fault_within_a_second_and_names_the_wheel(
    wheel: int, sent: float, speed: float, word: str
) -> None:
    jitter = 0.0 if word == "wheel_stuck" else 0.05
    after, fault = watched(WheelSpeeds(*[sent] * 4), only(wheel, speed, sent), jitter=jitter)
    assert 0.49 < after < 1.0
    assert fault.startswith(f"{WHEELS[wheel]} ")
    assert word in fault


@each("sign", [1.0, -1.0])
@each(
    ("sent", "speed", "word"),
    [
        # A tenth of 10 rad/s does not count as turning.
        (10.0, 0.9, "wheel_dead"),
        (10.0, 1.05, ""),
        # Three tenths of 10 rad/s backward count as a reversal.
        (10.0, -3.1, "wheel_reversed"),
        (10.0, -2.9, ""),
        # One and a half times 10 rad/s plus 2 rad/s counts as a runaway.
        (10.0, 17.1, "wheel_runaway"),
        (10.0, 16.9, ""),
    ],
)
def test_the_limits_of_the_difference_from_the_command_are_those_worked_by_hand(
    sent: float, speed: float, word: str, sign: float
) -> None:
    # A jitter of 0.04 rad/s keeps the wheel from looking stuck.
    fault = watched_after_driving(1, sign * sent, sign * speed, jitter=0.04)
    assert word in fault if word else fault == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("speed", "stuck"), [(3.9, True), (4.1, False), (15.9, False), (16.1, True)]
)
def test_a_constant_speed_more_than_two_and_four_tenths_away_is_stuck(
    speed: float, stuck: bool, sign: float
) -> None:
    # The band is 10 rad/s -+ (2 + 0.4 x 10) rad/s.
    fault = watched_after_driving(2, sign * 10.0, sign * speed)
    assert ("wheel_stuck" in fault) is stuck


def test_a_wheel_that_reports_one_rad_s_and_no_other_speed_is_stuck() -> None:
    assert "wheel_stuck" in watched_after_driving(2, 10.0, 1.0)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("speed", "word"), [(10.0, "wheel_runaway"), (2.1, "wheel_runaway"), (1.9, "")]
)
def test_a_wheel_that_does_not_come_to_rest_on_command_is_running_away(
    wheel: int, sign: float, speed: float, word: str
) -> None:
    robot = driven(sign * 10.0)
    moves = (only(wheel, sign * (speed - 0.04 * (step % 2))) for step in range(200))
    fault = first(robot.watch(STILL, move, DT) for move in moves)
    assert word in fault
    assert fault.startswith(f"{WHEELS[wheel]} ") if word else fault == ""


def test_a_wheel_that_turns_while_only_other_wheels_are_commanded_is_running_away() -> None:
    pivot, robot = WheelSpeeds(10.0, 0.0, 0.0, 10.0), watching()
    assert not any(robot.watch(pivot, noisy(pivot, step), DT) for step in range(300))
    turning = WheelSpeeds(10.0, 5.0, 0.0, 10.0)
    faults = [robot.watch(pivot, noisy(turning, step), DT) for step in range(52)]
    assert "front_left wheel_runaway" in first(faults)


def test_a_dead_wheel_is_found_half_a_second_after_a_healthy_one_would_have_turned() -> None:
    # A healthy wheel passes 2 rad/s on its way to 10 in step 5: 10 (1 - (0.2 / 0.21)^5) = 2.16.
    after, _ = watched(TEN, STILL)
    assert after == pytest.approx(0.04 + 0.5, abs=0.011)


def test_a_contradiction_that_does_not_last_is_no_fault() -> None:
    robot = watching()
    for _ in range(20):
        assert not any(robot.watch(TEN, STILL, DT) for _ in range(45))
        assert not robot.watch(TEN, WheelSpeeds(9.9, 10.1, 9.8, 10.2), DT)


def test_a_robot_pushed_gently_by_hand_is_no_fault() -> None:
    assert watched(STILL, WheelSpeeds(1.9, 1.9, 1.9, 1.9))[1] == ""


def pushed(
    robot: WheelFaults, speed: float, seconds: float
) -> tuple[list[Reason | None], list[float]]:
    """Return the faults while a person pushes the robot, and the times of reported pushes, s."""
    speeds = WheelSpeeds(speed, speed, speed, speed)
    faults, times = [], []
    for step in range(round(seconds / DT)):
        faults.append(robot.watch(STILL, noisy(speeds, step), DT))
        if robot.pushed:
            times.append((step + 1) * DT)
    return list(filter(None, faults)), times


@pytest.mark.parametrize("speed", [2.4, -2.4, 20.0, -20.0])
def test_wheels_turned_by_hand_are_reported_once_a_second_and_never_a_fault(speed: float) -> None:
    for robot in (watching(), driven(10.0), driven(-10.0)):
        robot.watch(STILL, STILL, DT)
        faults, times = pushed(robot, speed, 3.5)
        assert faults == []
        assert times == pytest.approx([0.21, 1.21, 2.21, 3.21], abs=0.011)


def test_a_push_is_reported_again_after_exactly_one_second() -> None:
    robot, times = watching(), []
    for step in range(1, 12):
        robot.watch(STILL, noisy(TEN, step), 0.125)
        if robot.pushed:
            times.append(step * 0.125)
    assert times == [0.25, 1.25]


def test_one_wheel_turned_by_hand_is_reported_too() -> None:
    robot = driven(10.0)
    assert robot.watch(STILL, STILL, DT) is None
    texts = []
    for step in range(30):
        assert not robot.watch(STILL, only(2, -5.0 + step % 2), DT)
        texts.append(robot.pushed)
    assert any(texts)


def test_a_constant_speed_by_hand_is_not_a_stuck_encoder() -> None:
    after, fault = watched(STILL, WheelSpeeds(5.0, 5.0, 5.0, 5.0))
    assert (after, fault) == (math.inf, "")


def test_a_push_within_the_slack_or_as_short_as_rocking_to_rest_is_not_reported() -> None:
    robot = watching()
    assert pushed(robot, 1.85, 3.0) == ([], [])
    for _ in range(10):
        assert pushed(robot, 5.0, 0.19) == ([], [])
        assert pushed(robot, 0.0, 0.02) == ([], [])


def test_a_push_during_an_almost_zero_command_is_no_fault_either() -> None:
    robot, hardly = watching(), WheelSpeeds(0.004, -0.004, 0.0, 0.0)
    moves = [noisy(TEN, step) for step in range(200)]
    assert not any(robot.watch(hardly, move, DT) for move in moves)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_slows_down_slowly_is_no_fault_and_one_that_has_stopped_slowing_is(
    sign: float,
) -> None:
    # At 5 rad/s2 the speed falls by 2 rad/s in less than half a second, like that of a coasting
    # robot.
    robot, speed = driven(sign * 20.0), sign * 20.0
    while abs(speed) > 8.0:
        speed -= sign * 5.0 * DT
        assert robot.watch(STILL, WheelSpeeds(speed, speed, speed, speed), DT) is None
        assert robot.pushed == ""
    stays = [robot.watch(STILL, noisy(only(2, speed), step), DT) for step in range(52)]
    assert "rear_left wheel_runaway" in first(stays)


def test_a_wheel_that_slows_down_slowly_a_second_time_is_no_fault() -> None:
    robot = watching()
    for _ in range(2):
        target = both(1, 20.0)
        assert not any(robot.watch(target, noisy(target, step), DT) for step in range(300))
        speed = 20.0
        while speed > 0.0:
            speed -= 5.0 * DT
            assert robot.watch(STILL, only(1, speed), DT) is None


def test_a_slow_wheel_that_sped_up_during_a_stall_and_now_slows_down_is_no_fault() -> None:
    """The line after the stall is the first one with a speed above the command.

    This speed is much higher than the speed before the stall.
    """
    robot = watching()
    lines = [(9.29, 0.23, 0.1), (17.52, 1.41, 0.1), (17.95, 4.47, 0.1), (17.95, 7.86, 0.1)]
    lines += [(0.0, 11.83, 0.25), (1.21, 13.48, 0.02), (4.18, 12.63, 0.03)]
    lines += [(0.0, speed, 0.1) for speed in (11.1, 8.77, 6.55, 4.85, 3.6, 2.7, 2.0)]
    for target, speed, dt in lines:
        assert robot.watch(both(1, target), both(1, speed), dt) is None


def test_a_runaway_seen_by_a_coarse_encoder_does_not_look_like_slowing_down() -> None:
    robot = driven(10.0)
    faults = [robot.watch(STILL, only(1, 10.0 + 2.5 * (step % 2)), DT) for step in range(100)]
    assert "wheel_runaway" in first(faults)


def test_forgetting_does_not_make_a_runaway_a_push() -> None:
    robot = driven(10.0)
    robot.forget()
    assert "wheel_runaway" in first(pushed(robot, 10.0, 1.0)[0])
    robot.forget()
    assert "wheel_runaway" in first(pushed(robot, 10.0, 1.0)[0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_still_slows_down_after_forgetting_is_no_fault(sign: float) -> None:
    robot, speed = driven(sign * 20.0), sign * 20.0
    faults: list[Reason | None] = []
    robot.forget()
    while abs(speed) > 0.5:
        speed *= 1.0 - DT / 0.4
        faults.append(robot.watch(STILL, noisy(only(1, speed), len(faults)), DT))
    assert not any(faults)


def test_a_runaway_is_found_soon_after_forgetting() -> None:
    # Half a second after a wheel that coasts from 10 rad/s would have slowed to 5.3 rad/s.
    robot = driven(10.0)
    robot.forget()
    lines = (robot.watch(STILL, noisy(only(1, 10.0), step), DT) for step in range(66))
    assert "wheel_runaway" in first(lines)


def test_a_push_is_reported_even_without_a_fault_time() -> None:
    robot = watching(FeedbackConfig(fault_time=0.0))
    faults, times = pushed(robot, 5.0, 0.5)
    assert faults == []
    assert times == pytest.approx([0.21], abs=0.011)


def test_a_robot_pushed_back_gently_after_it_drove_is_no_fault() -> None:
    robot = watching()
    for target, speed in ((10.0, 10.0), (0.0, -1.5)):
        for step in range(300):
            moved = both(0, speed + step % 2 / 10)
            assert robot.watch(both(0, target), moved, DT) is None


def test_a_wheel_slowed_by_half_under_load_is_no_fault() -> None:
    robot = watching()
    dice = random.Random(1)
    for _ in range(500):
        speeds = WheelSpeeds(*(5.0 + dice.uniform(-0.2, 0.2) for _ in range(4)))
        assert robot.watch(TEN, speeds, DT) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slow_wheel_that_brakes_by_its_configured_response_time_is_no_fault(sign: float) -> None:
    robot, speed = watching(FeedbackConfig(response_time=2.0)), 0.0
    for target in (sign * 20.0, 0.0):
        for _ in range(1000):
            speed += (target - speed) * (DT / (2.0 + DT))
            assert robot.watch(both(3, target), both(3, speed), DT) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_faster_than_its_configured_response_time_is_no_fault(sign: float) -> None:
    robot = watching(FeedbackConfig(response_time=2.0))
    for target in (sign * 20.0, 0.0):
        for step in range(1000):
            speeds = WheelSpeeds(*(target and target + step % 2 / 10 for _ in WHEELS))
            assert robot.watch(WheelSpeeds(*[target] * 4), speeds, DT) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_slows_to_a_creep_before_its_response_time_is_not_dead(sign: float) -> None:
    """A coarse encoder reports 0 if the wheel turns by less than one count per line."""
    robot = watching(FeedbackConfig(response_time=2.0))
    for target, reported in ((sign * 20.0, sign * 20.0), (sign * 0.6, 0.0)):
        for step in range(1000):
            speeds = WheelSpeeds(*(reported and reported + step % 2 / 10 for _ in WHEELS))
            assert robot.watch(WheelSpeeds(*[target] * 4), speeds, DT) is None


def test_a_wheel_that_reaches_its_command_before_its_response_time_is_not_stuck() -> None:
    """A coarse encoder reports the same speed in several lines."""
    robot = watching(FeedbackConfig(response_time=2.0))
    for _ in range(1000):
        assert robot.watch(WheelSpeeds(*[13.7] * 4), WheelSpeeds(*[13.7] * 4), DT) is None


def test_a_healthy_wheel_is_expected_to_follow_by_its_response_time() -> None:
    # Each step covers a sixth of the way. After the second step the model has 10 (1 - (5/6)^2) =
    # 3.06 rad/s, over 2 rad/s. Eight more steps of 1/16 s then exceed half a second.
    robot = watching(FeedbackConfig(response_time=0.3125, fault_time=0.5))
    flags = [bool(robot.watch(TEN, STILL, 0.0625)) for _ in range(10)]
    assert flags == [False] * 9 + [True]


def test_a_model_that_has_just_reached_the_slack_is_not_yet_moving() -> None:
    # A quarter of the way to 8 rad/s is 2 rad/s, so step 2 is the first of nine that count.
    robot = watching(FeedbackConfig(response_time=0.1875, fault_time=0.5))
    eight = WheelSpeeds(8.0, 8.0, 8.0, 8.0)
    flags = [bool(robot.watch(eight, STILL, 0.0625)) for _ in range(10)]
    assert flags == [False] * 9 + [True]


def test_a_line_without_time_moves_no_model_and_is_no_evidence() -> None:
    robot = watching(FeedbackConfig(response_time=0.3125, fault_time=0.5))
    for _ in range(10):
        assert not robot.watch(TEN, STILL, 0.0)
    flags = [bool(robot.watch(TEN, STILL, 0.0625)) for _ in range(10)]
    assert flags == [False] * 9 + [True]


def test_evidence_must_last_longer_than_the_fault_time() -> None:
    robot = watching(FeedbackConfig(fault_time=0.5))
    # The first line tells nothing, because the wheel may be nearing its command.
    flags = [bool(robot.watch(TEN, STILL, 0.125)) for _ in range(6)]
    assert flags == [False, False, False, False, False, True]


def test_one_line_that_stands_for_a_whole_stall_is_not_enough_evidence() -> None:
    robot = watching(FeedbackConfig(fault_time=0.3))
    for _ in range(10):
        assert robot.watch(TEN, TEN, 0.1) is None
    assert [bool(robot.watch(STILL, TEN, 0.311)) for _ in range(3)] == [False, False, True]


def test_a_fault_time_of_zero_switches_the_check_off() -> None:
    robot = watching(FeedbackConfig(fault_time=0.0))
    assert not any(robot.watch(TEN, STILL, DT) for _ in range(1000))


@given(
    st.lists(st.tuples(st.floats(-20, 20), st.integers(1, 150)), min_size=1, max_size=12),
    st.floats(0.0, 0.15),
    st.floats(0.8, 1.1),
)
def test_a_healthy_wheel_is_never_a_fault_whatever_its_command(
    wishes: list[tuple[float, int]], lag: float, gain: float
) -> None:
    robot, speed, dice = watching(), 0.0, random.Random(2)
    for target, steps in wishes:
        for _ in range(steps):
            speed += (target * gain - speed) * (DT / (lag + DT))
            feedback = speed + dice.uniform(-0.2, 0.2)
            assert robot.watch(both(0, target), both(0, feedback), DT) is None


@pytest.mark.parametrize(("sent", "pushed"), [(0.0045, True), (0.005, False), (0.006, False)])
def test_a_wheel_speed_of_5_mrad_a_second_counts_as_a_command(sent: float, pushed: bool) -> None:
    robot = watching(FeedbackConfig(fault_time=0.0))
    flags = [bool(robot.watch(both(0, sent), TEN, 0.1) or robot.pushed) for _ in range(5)]
    assert any(flags) is pushed


@pytest.mark.parametrize(("speed", "lines"), [(2.0, 0), (2.5, 3)])
def test_wheels_are_turned_by_hand_above_2_rad_a_second_for_over_a_fifth_of_a_second(
    speed: float, lines: int
) -> None:
    robot, flags = watching(), list[bool]()
    for _ in range(10):
        robot.watch(STILL, only(0, speed), 0.1)
        flags.append(bool(robot.pushed))
    assert (flags.index(True) + 1 if lines else any(flags)) == lines


def test_a_wheel_that_has_slowed_to_2_rad_a_second_has_come_to_rest() -> None:
    robot, flags = driven(10.0), list[bool]()
    robot.watch(STILL, only(0, 1.8), 0.1)  # smoothed 1.96
    for _ in range(4):
        assert robot.watch(STILL, only(0, 3.0), 0.1) is None
        flags.append(bool(robot.pushed))
    assert any(flags)


def test_a_wheel_at_one_and_a_half_times_its_command_and_2_rad_a_second_is_no_runaway() -> None:
    robot = watching()
    for step in range(1, 81):
        target, speed = 0.5 * step, 0.75 * step + 2.0
        assert robot.watch(both(0, target), both(0, speed), DT) is None


def test_a_wheel_that_is_slower_by_1_rad_a_second_is_not_slowing_down() -> None:
    robot = watching()
    faults = [robot.watch(both(0, 1.0), both(0, speed), 0.125) for speed in (50.0, *[49.0] * 5)]
    assert not any(faults[:-1])
    assert "front_right wheel_runaway" in named(faults[-1])


def test_a_wheel_that_turns_back_while_it_should_slow_to_a_creep_is_reversed() -> None:
    settings = FeedbackConfig(response_time=5.0)
    robot, speed = watching(settings), 0.0
    fault: Reason | None = None
    for step in range(600):
        speed += (30.0 - speed) * 0.01
        assert robot.watch(both(0, 30.0), both(0, speed + step % 2 / 10), 0.05) is None
    for step in range(12):
        fault = fault or robot.watch(both(0, 0.03), both(0, -15.0 - step % 2 / 10), 0.05)
    assert "front_right wheel_reversed" in named(fault)


# slow robots, and coarse encoders


@pytest.mark.parametrize("counts", [96, 3200])
def test_wheels_that_coast_after_a_lost_link_are_no_fault(counts: int) -> None:
    robot = WheelFaults(Kinematics(DriveConfig()), counts, FeedbackConfig(fault_time=0.3))
    step, speed, angle, whole = math.tau / counts, 20.0, 0.0, 0
    for line in range(500):
        if line == 200:
            robot.forget()
        target = WheelSpeeds(*[20.0 if line < 200 else 0.0] * 4)
        speed += 0.0 if line < 200 else -speed * DT / 0.6
        angle += speed * DT
        before, whole = whole, math.floor(angle / step)
        speeds = WheelSpeeds(*[round((whole - before) * step / DT, 2)] * 4)
        assert robot.watch(target, speeds, DT if line != 200 else 0.0) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_slows_down_before_it_turns_round_is_not_reversed(sign: float) -> None:
    robot, speed = driven(sign * 20.0), sign * 20.0
    while abs(speed) < 20.1:
        speed -= sign * 5.0 * DT
        assert robot.watch(WheelSpeeds(*[-sign * 20.0] * 4), WheelSpeeds(*[speed] * 4), DT) is None


def slow(robot: WheelFaults, share: float, seconds: float, wheel: int = 0) -> list[str]:
    """Return the logged events while this wheel turns at `share` times the commanded 10 rad/s."""
    events = []
    for step in range(round(seconds / DT)):
        speeds = noisy(only(wheel, 10.0 * share, 10.0), step)
        assert robot.watch(TEN, speeds, DT) is None
        robot.check_line((0.1, 0.1, 0.1, 0.1), TEN, DT)
        events += [f"{event.level} {event.kind}: {event.text}" for event in robot.events]
    return events


@pytest.mark.parametrize("wheel", range(4))
def test_a_wheel_that_turns_the_right_way_too_slowly_is_a_warning_with_its_ratio(
    wheel: int,
) -> None:
    robot = watching()
    assert slow(robot, 1.0, 5.0) == []
    (warning,) = slow(robot, 0.6, 5.0, wheel)
    assert warning.startswith("warning slow")
    assert robot.status.slow in ((f"{WHEELS[wheel]} 60%",), (f"{WHEELS[wheel]} 61%",))
    assert robot.status.text == ""
    (again,) = slow(robot, 1.0, 5.0)
    assert again.startswith("info again")
    assert not robot.status.slow


@pytest.mark.parametrize(("share", "warned"), [(0.69, True), (0.71, False)])
def test_a_wheel_below_seven_tenths_of_its_speed_is_slow(share: float, warned: bool) -> None:
    assert bool(slow(watching(), share, 6.0)) is warned


def test_a_reversed_encoder_that_is_left_out_is_a_fault_at_a_creep_too() -> None:
    robot, fault_s, out = watching(), math.inf, math.inf
    target = WheelSpeeds(1.5, 1.5, 1.5, 1.5)
    for step in range(400):
        right = 1.5 + 0.1 * (step % 2)
        speeds = only(2, right if step < 200 else -right, right)
        fault = robot.watch(target, speeds, DT)
        front_right, front_left, rear_left, rear_right = (DT * s for s in speeds.as_tuple())
        robot.check_line((front_right, front_left, rear_left, rear_right), speeds, DT)
        if robot.status.left_out and out == math.inf:
            out = step * DT
        if fault:
            fault_s = step * DT
            break
    assert "rear_left wheel_reversed" in named(fault)
    assert 0.49 < fault_s - out < 0.53
    assert out < 2.1


def test_motors_without_power_contradict_no_command() -> None:
    robot = driven(10.0)
    assert not any(robot.watch(None, STILL, DT) for _ in range(200))


@each(("counts", "rests_s"), [(3200, 0.01), (96, 0.04), (16, 0.2)])
def test_a_wheel_without_power_rests_when_it_has_not_turned_for_the_time_of_a_slow_count(
    counts: int, rests_s: float
) -> None:
    witness, count, time_s = Witness(), math.tau / counts, 0.0
    witness.driven = True
    witness.coast(20.0, 0.01, count)
    while witness.driven:
        witness.coast(0.0, 0.01, count)
        time_s += 0.01
    assert time_s == pytest.approx(rests_s)
