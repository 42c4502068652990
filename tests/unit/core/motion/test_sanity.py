"""Impossible feedback is named, and a wheel that contradicts its command soon becomes a fault."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.sanity import Sanity
from acsard.core.values import STILL, WHEELS, Event, Instant, WheelSpeeds
from tests.each import each

DT = 0.01
AT = Instant(0, 0)
TEN = WheelSpeeds(10.0, 10.0, 10.0, 10.0)


def line(speeds: WheelSpeeds, dt: float = DT, gap: float = 0.0) -> Feedback:
    return Feedback(AT, speeds, dt, gap)


def only(wheel: int, speed: float, others: float = 0.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


def watched(
    sent: WheelSpeeds, seen: WheelSpeeds, seconds: float = 3.0, jitter: float = 0.0
) -> tuple[float, str]:
    """Return the time and text of the fault, or (inf, "") if there is none."""
    sanity = Sanity(FeedbackConfig())
    for step in range(round(seconds / DT)):
        noisy = WheelSpeeds(*(s + jitter * (step % 2) for s in seen.as_tuple()))
        fault = sanity.watch(sent, noisy, DT)
        if fault:
            return (step + 1) * DT, fault
    return math.inf, ""


def watched_after_driving(wheel: int, sent: float, seen: float, jitter: float = 0.0) -> str:
    """Return the fault within two seconds, after three seconds of correct driving."""
    sanity = Sanity(FeedbackConfig())
    told = only(wheel, sent)
    assert not any(sanity.watch(told, only(wheel, sent + step % 2 / 10), DT) for step in range(300))
    found = (sanity.watch(told, only(wheel, seen + jitter * (step % 2)), DT) for step in range(200))
    return next(filter(None, found), "")


def noisy(speeds: WheelSpeeds, step: int) -> WheelSpeeds:
    """Return encoder speeds that differ from line to line, as real encoders do."""
    return WheelSpeeds(*(speed + 0.1 * (step % 2) for speed in speeds.as_tuple()))


def driven(speed: float, settings: FeedbackConfig | None = None) -> Sanity:
    """Return a check that has watched a robot follow its commands for three seconds."""
    sanity, told = Sanity(settings or FeedbackConfig()), WheelSpeeds(speed, speed, speed, speed)
    assert not any(sanity.watch(told, noisy(told, step), DT) for step in range(300))
    return sanity


# impossible lines


@pytest.mark.parametrize("wheel", range(4))
def test_a_speed_no_wheel_reaches_is_impossible_and_names_the_wheel(wheel: int) -> None:
    sanity = Sanity(FeedbackConfig())
    assert WHEELS[wheel] in sanity.impossible(line(only(wheel, -80.01)))
    assert sanity.impossible(line(only(wheel, 80.0))) == ""


@pytest.mark.parametrize("wheel", range(4))
def test_a_change_no_wheel_makes_is_impossible_and_names_the_wheel(wheel: int) -> None:
    sanity = Sanity(FeedbackConfig(wheel_acceleration=100.0))
    assert sanity.impossible(line(STILL)) == ""
    assert WHEELS[wheel] in sanity.impossible(line(only(wheel, 3.5)))
    assert sanity.impossible(line(only(wheel, 2.9))) == ""


def test_the_most_a_wheel_can_do_is_possible() -> None:
    # The limit is 100 rad/s2 x 10 ms and 2 rad/s of slack.
    sanity = Sanity(FeedbackConfig(wheel_acceleration=100.0))
    assert sanity.impossible(line(STILL)) == ""
    assert sanity.impossible(line(only(0, 3.0))) == ""
    assert sanity.impossible(line(only(0, 0.0))) == ""
    assert "front_right" in sanity.impossible(line(only(0, -3.01)))


def test_a_real_step_is_believed_as_soon_as_it_could_have_happened() -> None:
    sanity = Sanity(FeedbackConfig(wheel_acceleration=400.0))
    sanity.impossible(line(STILL))
    verdicts = [sanity.impossible(line(TEN)) == "" for _ in range(3)]
    assert verdicts == [False, True, True]


def test_the_first_line_and_the_first_after_a_gap_have_no_slew() -> None:
    sanity = Sanity(FeedbackConfig(wheel_acceleration=10.0))
    assert sanity.impossible(line(TEN, dt=0.0)) == ""
    assert sanity.impossible(line(STILL, dt=0.0, gap=0.5)) == ""


def test_three_impossible_lines_in_a_row_are_doubtful_and_two_are_not() -> None:
    sanity = Sanity(FeedbackConfig())
    fast = line(only(0, 99.0))
    found = []
    for _ in range(2):
        sanity.impossible(fast)
        found.append(sanity.doubtful)
    sanity.impossible(line(STILL))
    for _ in range(3):
        sanity.impossible(fast)
        found.append(sanity.doubtful)
    assert found == [False, False, False, False, True]


def test_forgetting_starts_over() -> None:
    sanity = Sanity(FeedbackConfig(wheel_acceleration=10.0))
    sanity.impossible(line(STILL))
    for _ in range(3):
        sanity.impossible(line(TEN))
    sanity.forget()
    assert not sanity.doubtful
    assert sanity.impossible(line(TEN)) == ""


@pytest.mark.parametrize("forget", [False, True])
def test_new_or_after_forgetting_it_takes_three_impossible_lines(forget: bool) -> None:
    sanity = Sanity(FeedbackConfig())
    if forget:
        sanity.forget()
    found = []
    for _ in range(3):
        sanity.impossible(line(only(0, 99.0)))
        found.append(sanity.doubtful)
    assert found == [False, False, True]


def test_forgetting_drops_the_evidence_against_every_wheel() -> None:
    sanity = Sanity(FeedbackConfig())
    for _ in range(3):
        assert not any(sanity.watch(TEN, STILL, DT) for _ in range(45))
        sanity.forget()


# coarse encoders


def stepping(speeds: WheelSpeeds, step: float, proven: bool = False) -> Feedback:
    counted = (0.0,) * 4 if proven else None
    return Feedback(AT, speeds, DT, steps=(step,) * 4, counted=counted)


def test_a_count_more_or_less_at_each_end_is_no_change_of_speed() -> None:
    # The limit is 100 rad/s2 x 10 ms, 2 rad/s of slack and twice 31.4 rad/s.
    sanity = Sanity(FeedbackConfig(wheel_acceleration=100.0))
    assert sanity.impossible(stepping(STILL, 31.4)) == ""
    assert sanity.impossible(stepping(only(0, 65.7), 31.4)) == ""
    assert "front_right" in sanity.impossible(stepping(only(0, -0.2), 31.4))


def test_a_proven_count_more_is_not_too_fast() -> None:
    sanity = Sanity(FeedbackConfig(wheel_speed=50.0))
    assert sanity.impossible(stepping(only(2, 80.0), 31.4, proven=True)) == ""
    assert "wheel_speed" in sanity.impossible(stepping(only(2, 81.5), 31.4, proven=True))


def test_a_speed_of_the_limit_and_one_proven_count_is_possible() -> None:
    sanity = Sanity(FeedbackConfig(wheel_speed=50.0))
    assert sanity.impossible(stepping(only(2, 81.25), 31.25, proven=True)) == ""


@pytest.mark.parametrize("number", [1, 2])
def test_one_count_is_never_too_fast_and_two_in_its_time_are(number: int) -> None:
    """A host that catches up asks again after 4 ms: one count of 16 is then 98 rad/s."""
    sanity, count = Sanity(FeedbackConfig(wheel_speed=50.0)), math.tau / 16
    speed, angle = number * count / 0.004, number * count
    for sampled in (True, False):
        turned = (angle, 0.0, 0.0, 0.0)
        line = Feedback(
            AT, only(0, speed), DT, count=count,
            turned=turned if sampled else None, counted=None if sampled else turned,
        )  # fmt: skip
        assert ("wheel_speed" in sanity.impossible(line)) is (number == 2)


def test_a_step_that_may_be_a_lie_leaves_no_speed_too_fast_unsaid() -> None:
    sanity = Sanity(FeedbackConfig(wheel_speed=50.0))
    assert "feedback.wheel_speed" in sanity.impossible(stepping(only(2, 50.1), 31.4))


def test_while_an_encoder_is_unknown_any_change_may_be_a_count_but_no_speed_too_fast() -> None:
    sanity = Sanity(FeedbackConfig())
    assert sanity.impossible(stepping(STILL, math.inf)) == ""
    assert sanity.impossible(stepping(only(1, 79.9), math.inf)) == ""
    assert "front_left" in sanity.impossible(stepping(only(1, 80.1), math.inf))
    assert "front_left" in sanity.impossible(stepping(only(1, 80.1), math.inf, proven=True))


# contradictions


@each("wheel", range(4))
@each(
    ("sent", "seen", "word"),
    [
        (10.0, 0.0, "does not turn"),
        (-10.0, 0.0, "does not turn"),
        (10.0, -9.0, "against its command"),
        (-10.0, 9.0, "against its command"),
        (10.0, 18.0, "faster than commanded"),
        (10.0, 3.0, "one and the same speed"),
    ],
)
def test_a_contradiction_is_a_fault_within_a_second_and_names_the_wheel(
    wheel: int, sent: float, seen: float, word: str
) -> None:
    jitter = 0.0 if "one and the same" in word else 0.05
    after, fault = watched(only(wheel, sent), only(wheel, seen), jitter=jitter)
    assert 0.49 < after < 1.0
    assert fault.startswith(f"{WHEELS[wheel]} wheel")
    assert word in fault


@each("sign", [1.0, -1.0])
@each(
    ("sent", "seen", "word"),
    [
        # A tenth of 10 rad/s does not count as turning.
        (10.0, 0.9, "does not turn"),
        (10.0, 1.05, ""),
        # Three tenths of 10 rad/s backward count as a reversal.
        (10.0, -3.1, "against its command"),
        (10.0, -2.9, ""),
        # One and a half times 10 rad/s plus 2 rad/s counts as a runaway.
        (10.0, 17.1, "faster than commanded"),
        (10.0, 16.9, ""),
    ],
)
def test_what_is_too_far_from_the_command_is_worked_by_hand(
    sent: float, seen: float, word: str, sign: float
) -> None:
    # A jitter of 0.04 rad/s keeps the wheel from looking stuck.
    fault = watched_after_driving(1, sign * sent, sign * seen, jitter=0.04)
    assert word in fault if word else fault == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("seen", "stuck"), [(4.9, True), (5.1, False), (14.9, False), (15.1, True)]
)
def test_a_constant_speed_more_than_two_and_three_tenths_away_is_stuck(
    seen: float, stuck: bool, sign: float
) -> None:
    # The band is 10 rad/s -+ (2 + 0.3 x 10) rad/s.
    fault = watched_after_driving(2, sign * 10.0, sign * seen)
    assert ("one and the same speed" in fault) is stuck


def test_a_wheel_that_reports_one_rad_s_and_no_other_speed_is_stuck() -> None:
    assert "one and the same speed" in watched_after_driving(2, 10.0, 1.0)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("seen", "word"), [(10.0, "faster than"), (2.1, "faster than"), (1.9, "")])
def test_a_wheel_that_does_not_come_to_rest_when_it_is_told_to_is_running_away(
    wheel: int, sign: float, seen: float, word: str
) -> None:
    sanity = driven(sign * 10.0)
    moves = (only(wheel, sign * (seen - 0.04 * (step % 2))) for step in range(200))
    fault = next(filter(None, (sanity.watch(STILL, move, DT) for move in moves)), "")
    assert word in fault
    assert fault.startswith(f"{WHEELS[wheel]} wheel") if word else fault == ""


def test_a_wheel_that_turns_while_only_the_others_are_told_to_is_running_away() -> None:
    pivot, sanity = WheelSpeeds(10.0, 0.0, 0.0, 10.0), Sanity(FeedbackConfig())
    assert not any(sanity.watch(pivot, noisy(pivot, step), DT) for step in range(300))
    turning = WheelSpeeds(10.0, 5.0, 0.0, 10.0)
    found = [sanity.watch(pivot, noisy(turning, step), DT) for step in range(52)]
    assert "front_left wheel turns faster" in next(filter(None, found))


def test_a_dead_wheel_is_found_half_a_second_after_a_healthy_one_would_have_turned() -> None:
    # A healthy wheel passes 2 rad/s on its way to 10 in step 5: 10 (1 - (0.2 / 0.21)^5) = 2.16.
    after, _ = watched(TEN, STILL)
    assert after == pytest.approx(0.04 + 0.5, abs=0.011)


def test_a_contradiction_that_does_not_last_is_none() -> None:
    sanity = Sanity(FeedbackConfig())
    for _ in range(20):
        assert not any(sanity.watch(TEN, STILL, DT) for _ in range(45))
        assert not sanity.watch(TEN, WheelSpeeds(9.9, 10.1, 9.8, 10.2), DT)


def test_a_robot_pushed_gently_by_hand_is_no_fault() -> None:
    assert watched(STILL, WheelSpeeds(1.9, 1.9, 1.9, 1.9))[1] == ""


# a person pushes the robot


def pushed(sanity: Sanity, speed: float, seconds: float) -> tuple[list[str], list[float]]:
    """Return the faults while a person pushes the robot, and the times of reported pushes, s."""
    seen = WheelSpeeds(speed, speed, speed, speed)
    faults, told = [], []
    for step in range(round(seconds / DT)):
        faults.append(sanity.watch(STILL, noisy(seen, step), DT))
        if sanity.turned:
            told.append((step + 1) * DT)
    return list(filter(None, faults)), told


@pytest.mark.parametrize("speed", [2.4, -2.4, 20.0, -20.0])
def test_wheels_turned_by_hand_are_reported_once_a_second_and_never_a_fault(speed: float) -> None:
    for sanity in (Sanity(FeedbackConfig()), driven(10.0), driven(-10.0)):
        sanity.watch(STILL, STILL, DT)
        faults, told = pushed(sanity, speed, 3.5)
        assert faults == []
        assert told == pytest.approx([0.21, 1.21, 2.21, 3.21], abs=0.011)


def test_nothing_is_told_before_the_first_line() -> None:
    assert Sanity(FeedbackConfig()).turned == ""


def test_a_push_is_reported_again_after_exactly_one_second() -> None:
    sanity, told = Sanity(FeedbackConfig()), []
    for step in range(1, 12):
        sanity.watch(STILL, noisy(TEN, step), 0.125)
        if sanity.turned:
            told.append(step * 0.125)
    assert told == [0.25, 1.25]


def test_one_wheel_turned_by_hand_is_reported_too() -> None:
    sanity = driven(10.0)
    told = [sanity.watch(STILL, STILL, DT)]
    for step in range(30):
        assert not sanity.watch(STILL, only(2, -5.0 + step % 2), DT)
        told.append(sanity.turned)
    assert "rad/s without a command" in next(filter(None, told))


def test_one_and_the_same_speed_by_hand_is_not_a_stuck_encoder() -> None:
    after, fault = watched(STILL, WheelSpeeds(5.0, 5.0, 5.0, 5.0))
    assert (after, fault) == (math.inf, "")


def test_a_push_no_faster_than_the_slack_or_as_short_as_rocking_to_rest_is_not_told() -> None:
    sanity = Sanity(FeedbackConfig())
    assert pushed(sanity, 1.85, 3.0) == ([], [])
    for _ in range(10):
        assert pushed(sanity, 5.0, 0.19) == ([], [])
        assert pushed(sanity, 0.0, 0.02) == ([], [])


def test_a_push_while_a_commander_holds_almost_zero_is_none_either() -> None:
    sanity, hardly = Sanity(FeedbackConfig()), WheelSpeeds(0.004, -0.004, 0.0, 0.0)
    moves = [noisy(TEN, step) for step in range(200)]
    assert not any(sanity.watch(hardly, move, DT) for move in moves)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_slows_down_slowly_is_no_fault_and_one_that_has_stopped_slowing_is(
    sign: float,
) -> None:
    # At 5 rad/s2 the speed falls by 2 rad/s in less than half a second, like that of a coasting
    # robot.
    sanity, speed, faults = driven(sign * 20.0), sign * 20.0, []
    while abs(speed) > 8.0:
        speed -= sign * 5.0 * DT
        faults.append(sanity.watch(STILL, WheelSpeeds(speed, speed, speed, speed), DT))
        faults.append(sanity.turned)
    assert not any(faults)
    stays = [sanity.watch(STILL, noisy(only(2, speed), step), DT) for step in range(52)]
    assert "rear_left wheel turns faster" in next(filter(None, stays))


def test_a_wheel_that_slows_down_slowly_a_second_time_is_no_fault() -> None:
    sanity = Sanity(FeedbackConfig())
    for _ in range(2):
        told = only(1, 20.0)
        assert not any(sanity.watch(told, noisy(told, step), DT) for step in range(300))
        speed = 20.0
        while speed > 0.0:
            speed -= 5.0 * DT
            assert sanity.watch(STILL, only(1, speed), DT) == ""


def test_a_slow_wheel_that_sped_up_during_a_stall_and_now_slows_down_is_no_fault() -> None:
    """The line behind the stall is the first that is too fast, and shows a much higher speed."""
    sanity = Sanity(FeedbackConfig())
    lines = [(9.29, 0.23, 0.1), (17.52, 1.41, 0.1), (17.95, 4.47, 0.1), (17.95, 7.86, 0.1)]
    lines += [(0.0, 11.83, 0.25), (1.21, 13.48, 0.02), (4.18, 12.63, 0.03)]
    lines += [(0.0, speed, 0.1) for speed in (11.1, 8.77, 6.55, 4.85, 3.6, 2.7, 2.0)]
    for told, speed, dt in lines:
        assert sanity.watch(only(1, told), only(1, speed), dt) == ""


def test_a_runaway_seen_by_a_coarse_encoder_does_not_look_like_slowing_down() -> None:
    sanity = driven(10.0)
    found = [sanity.watch(STILL, only(1, 10.0 + 2.5 * (step % 2)), DT) for step in range(100)]
    assert "faster than" in next(filter(None, found))


def test_forgetting_does_not_make_a_runaway_a_push() -> None:
    sanity = driven(10.0)
    sanity.forget()
    assert "faster than" in pushed(sanity, 10.0, 1.0)[0][0]
    sanity.forget()
    assert "faster than" in pushed(sanity, 10.0, 1.0)[0][0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_still_slows_down_after_forgetting_is_no_fault(sign: float) -> None:
    sanity, speed = driven(sign * 20.0), sign * 20.0
    faults: list[str] = []
    sanity.forget()
    while abs(speed) > 0.5:
        speed *= 1.0 - DT / 0.4
        faults.append(sanity.watch(STILL, noisy(only(1, speed), len(faults)), DT))
    assert not any(faults)


def test_a_runaway_is_found_in_half_a_second_after_forgetting() -> None:
    sanity = driven(10.0)
    sanity.forget()
    lines = (sanity.watch(STILL, noisy(only(1, 10.0), step), DT) for step in range(52))
    assert "faster than" in next(filter(None, lines))


def test_without_a_fault_time_a_push_is_still_told() -> None:
    sanity = Sanity(FeedbackConfig(fault_time=0.0))
    faults, told = pushed(sanity, 5.0, 0.5)
    assert faults == []
    assert told == pytest.approx([0.21], abs=0.011)


def test_a_robot_pushed_back_gently_after_it_drove_is_no_fault() -> None:
    sanity = Sanity(FeedbackConfig())
    for told, seen in ((10.0, 10.0), (0.0, -1.5)):
        for step in range(300):
            moved = only(0, seen + step % 2 / 10)
            assert sanity.watch(only(0, told), moved, DT) == ""


def test_a_wheel_slowed_by_half_under_load_is_no_fault() -> None:
    sanity = Sanity(FeedbackConfig())
    dice = random.Random(1)
    for _ in range(500):
        seen = WheelSpeeds(*(5.0 + dice.uniform(-0.2, 0.2) for _ in range(4)))
        assert sanity.watch(TEN, seen, DT) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slow_wheel_that_brakes_as_it_was_said_to_is_no_fault(sign: float) -> None:
    sanity, speed = Sanity(FeedbackConfig(response_time=2.0)), 0.0
    for told in (sign * 20.0, 0.0):
        for _ in range(1000):
            speed += (told - speed) * (DT / (2.0 + DT))
            assert sanity.watch(only(3, told), only(3, speed), DT) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_is_sooner_than_it_was_said_to_be_is_no_fault(sign: float) -> None:
    sanity = Sanity(FeedbackConfig(response_time=2.0))
    for told in (sign * 20.0, 0.0):
        for step in range(1000):
            seen = WheelSpeeds(*(told and told + step % 2 / 10 for _ in WHEELS))
            assert sanity.watch(WheelSpeeds(*[told] * 4), seen, DT) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_that_slows_to_a_creep_sooner_than_it_was_said_to_is_not_dead(sign: float) -> None:
    """A coarse encoder reports a speed below one count per line as zero."""
    sanity = Sanity(FeedbackConfig(response_time=2.0))
    for told, reported in ((sign * 20.0, sign * 20.0), (sign * 0.6, 0.0)):
        for step in range(1000):
            seen = WheelSpeeds(*(reported and reported + step % 2 / 10 for _ in WHEELS))
            assert sanity.watch(WheelSpeeds(*[told] * 4), seen, DT) == ""


def test_a_wheel_at_its_command_sooner_than_it_was_said_to_is_not_stuck() -> None:
    """A coarse encoder reports one and the same speed for several lines."""
    sanity = Sanity(FeedbackConfig(response_time=2.0))
    for _ in range(1000):
        assert sanity.watch(WheelSpeeds(*[13.7] * 4), WheelSpeeds(*[13.7] * 4), DT) == ""


def test_a_healthy_wheel_is_expected_to_follow_by_its_response_time() -> None:
    # Each step covers a sixth of the way. After the second step the model has 10 (1 - (5/6)^2) =
    # 3.06 rad/s, over 2 rad/s. Eight more steps of 1/16 s then exceed half a second.
    sanity = Sanity(FeedbackConfig(response_time=0.3125, fault_time=0.5))
    found = [bool(sanity.watch(TEN, STILL, 0.0625)) for _ in range(10)]
    assert found == [False] * 9 + [True]


def test_a_model_that_has_just_reached_the_slack_is_not_yet_moving() -> None:
    # A quarter of the way to 8 rad/s is 2 rad/s, so step 2 is the first of nine that count.
    sanity = Sanity(FeedbackConfig(response_time=0.1875, fault_time=0.5))
    eight = WheelSpeeds(8.0, 8.0, 8.0, 8.0)
    found = [bool(sanity.watch(eight, STILL, 0.0625)) for _ in range(10)]
    assert found == [False] * 9 + [True]


def test_a_line_without_time_moves_no_model_and_is_no_evidence() -> None:
    sanity = Sanity(FeedbackConfig(response_time=0.3125, fault_time=0.5))
    for _ in range(10):
        assert not sanity.watch(TEN, STILL, 0.0)
    found = [bool(sanity.watch(TEN, STILL, 0.0625)) for _ in range(10)]
    assert found == [False] * 9 + [True]


def test_evidence_must_last_longer_than_the_fault_time() -> None:
    sanity = Sanity(FeedbackConfig(fault_time=0.5))
    found = [bool(sanity.watch(TEN, STILL, 0.125)) for _ in range(5)]
    assert found == [False, False, False, False, True]


def test_one_line_that_stands_for_a_whole_stall_is_not_enough_evidence() -> None:
    sanity = Sanity(FeedbackConfig(fault_time=0.3))
    for _ in range(10):
        assert sanity.watch(TEN, TEN, 0.1) == ""
    assert [bool(sanity.watch(STILL, TEN, 0.311)) for _ in range(3)] == [False, False, True]


def test_fault_time_zero_switches_it_off() -> None:
    sanity = Sanity(FeedbackConfig(fault_time=0.0))
    assert not any(sanity.watch(TEN, STILL, DT) for _ in range(1000))


@given(
    st.lists(st.tuples(st.floats(-20, 20), st.integers(1, 150)), min_size=1, max_size=12),
    st.floats(0.0, 0.15),
    st.floats(0.8, 1.1),
)
def test_a_healthy_wheel_is_never_a_fault_whatever_it_is_told(
    wishes: list[tuple[float, int]], lag: float, gain: float
) -> None:
    sanity, speed, dice = Sanity(FeedbackConfig()), 0.0, random.Random(2)
    for told, steps in wishes:
        for _ in range(steps):
            speed += (told * gain - speed) * (DT / (lag + DT))
            seen = speed + dice.uniform(-0.2, 0.2)
            assert sanity.watch(only(0, told), only(0, seen), DT) == ""


# the limits themselves


def test_a_change_of_the_limit_and_two_counts_is_possible() -> None:
    # 100 rad/s2 x 10 ms, 2 rad/s of slack and twice 0.5 rad/s
    sanity = Sanity(FeedbackConfig(wheel_acceleration=100.0))
    assert sanity.impossible(stepping(STILL, 0.5)) == ""
    assert sanity.impossible(stepping(only(0, 4.0), 0.5)) == ""


@pytest.mark.parametrize(("sent", "pushed"), [(0.0045, True), (0.005, False), (0.006, False)])
def test_a_command_of_5_mrad_a_second_is_one(sent: float, pushed: bool) -> None:
    sanity = Sanity(FeedbackConfig(fault_time=0.0))
    told = [bool(sanity.watch(only(0, sent), TEN, 0.1) or sanity.turned) for _ in range(5)]
    assert any(told) is pushed


@pytest.mark.parametrize(("speed", "lines"), [(2.0, 0), (2.5, 3)])
def test_wheels_are_turned_by_hand_above_2_rad_a_second_for_over_a_fifth_of_a_second(
    speed: float, lines: int
) -> None:
    sanity, told = Sanity(FeedbackConfig()), list[bool]()
    for _ in range(10):
        sanity.watch(STILL, only(0, speed), 0.1)
        told.append(bool(sanity.turned))
    assert (told.index(True) + 1 if lines else any(told)) == lines


def test_a_wheel_that_has_slowed_to_2_rad_a_second_has_come_to_rest() -> None:
    sanity, told = driven(10.0), list[bool]()
    sanity.watch(STILL, only(0, 2.0), 0.1)
    for _ in range(4):
        assert sanity.watch(STILL, only(0, 3.0), 0.1) == ""
        told.append(bool(sanity.turned))
    assert any(told)


def test_a_wheel_at_one_and_a_half_times_its_command_and_2_rad_a_second_is_no_runaway() -> None:
    sanity = Sanity(FeedbackConfig())
    for step in range(1, 81):
        told, seen = 0.5 * step, 0.75 * step + 2.0
        assert sanity.watch(only(0, told), only(0, seen), DT) == ""


def test_a_wheel_that_is_slower_by_2_rad_a_second_is_not_slowing_down() -> None:
    sanity = Sanity(FeedbackConfig())
    faults = [sanity.watch(only(0, 1.0), only(0, speed), 0.125) for speed in (50.0, *[48.0] * 5)]
    assert not any(faults[:-1])
    assert "front_right wheel turns faster" in faults[-1]


def test_a_wheel_that_turns_back_while_it_should_slow_to_a_creep_is_reversed() -> None:
    settings = FeedbackConfig(response_time=5.0)
    sanity, fault, speed = Sanity(settings), "", 0.0
    for step in range(600):
        speed += (30.0 - speed) * 0.01
        assert sanity.watch(only(0, 30.0), only(0, speed + step % 2 / 10), 0.05) == ""
    for step in range(12):
        fault = fault or sanity.watch(only(0, 0.03), only(0, -15.0 - step % 2 / 10), 0.05)
    assert "front_right wheel turns against its command" in fault


WINDOW, MOST = 1000, 10
"""Lines of a window, and the largest number of impossible ones in it without a warning."""


def warned(sanity: Sanity, bad: int, lines: int = WINDOW) -> list[Event]:
    """Return the warnings of a window whose first `bad` lines are impossible."""
    warnings = []
    for i in range(lines):
        sanity.impossible(line(WheelSpeeds(*[200.0 if i < bad else 10.0] * 4)))
        warnings.append(sanity.warning)
    return [warning for warning in warnings if warning is not None]


def test_one_impossible_line_in_a_hundred_causes_no_warning() -> None:
    sanity = Sanity(FeedbackConfig())
    assert [warned(sanity, MOST) for _ in range(5)] == [[]] * 5


def test_more_impossible_lines_cause_one_warning_in_each_window() -> None:
    sanity = Sanity(FeedbackConfig())
    assert [len(warned(sanity, MOST + 1 + more)) for more in (0, 0, 500)] == [1, 1, 1]


def test_the_warning_comes_with_the_first_line_too_many() -> None:
    sanity = Sanity(FeedbackConfig())
    assert sanity.warning is None
    assert warned(sanity, MOST, MOST) == []
    assert len(warned(sanity, 1, 1)) == 1


def test_the_warning_says_what_was_dropped_and_what_to_do() -> None:
    (event,) = warned(Sanity(FeedbackConfig()), WINDOW)
    assert (event.name, event.level) == ("lines_implausible", "warning")
    assert event.text.startswith(f"{MOST + 1} of {MOST + 1} lines were dropped")
    assert "front_right 200.00 rad/s is over feedback.wheel_speed" in event.text
    assert "mcu.link_check" in event.text
