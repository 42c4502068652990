"""Tests of gap filling, which computes the wheel angles since the last accepted line."""

from __future__ import annotations

import math
from typing import Any

import pytest

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gap_filling import (
    ACCELERATION_SPAN_S,
    ASSUMED_ACCELERATION,
    AT_REST,
    MAX_LOST_S,
    Confirmation,
    Gaps,
    Rolled,
    Rolling,
    Rounding,
)
from acsard.core.values import REST, STILL, Instant, Twist, WheelSpeeds

AT = Instant(0, 0)
FOUR = WheelSpeeds(4.0, 4.0, 4.0, 4.0)
TWO = WheelSpeeds(2.0, 2.0, 2.0, 2.0)


def all_four(angle: float) -> Any:
    return (pytest.approx(angle),) * 4


def near(*values: float) -> Any:
    return pytest.approx(values)


TO_REST = 4.0 * 0.98 / math.log(50.0)
"""Mean speed of a wheel that slows down from 4 rad/s to a fiftieth of that, rad/s."""


def total(rolled: Rolled) -> float:
    """Return the angle that the first wheel has turned in the line and its gap, rad."""
    return rolled.turned[0] + sum(piece[0] for piece in rolled.pieces)


def test_a_line_turns_the_wheels_by_its_speed_times_its_duration() -> None:
    rolled = Rolling().take(Feedback(AT, FOUR, 0.01), TWO)
    assert rolled.pieces == (all_four(0.04),)
    assert rolled.seen == all_four(0.04)
    assert (rolled.seconds, rolled.known, rolled.unknown) == (0.01, 0.01, 0.0)


def test_wheels_at_rest_roll_no_angle() -> None:
    rolled = Rolling().take(Feedback(AT, WheelSpeeds(), 0.01), WheelSpeeds())
    assert rolled.pieces == ()
    assert rolled.turned == AT_REST


def test_a_bridged_time_has_the_mean_of_the_speeds_around_it() -> None:
    rolled = Rolling().take(Feedback(AT, FOUR, 0.03, bridged=0.02), TWO)
    assert rolled.pieces == (all_four(0.06), all_four(0.04))
    assert rolled.seen == all_four(0.1)
    assert (rolled.seconds, rolled.bridged) == near(0.03, 0.02)


def test_a_silence_continues_the_speed_before_it_until_rest_is_commanded() -> None:
    rolling = Rolling(quiet=0.1)
    stood = rolling.take(Feedback(AT, WheelSpeeds(), 0.6, bridged=0.5), FOUR)
    assert total(stood) == pytest.approx(0.4)
    short = rolling.take(Feedback(AT, WheelSpeeds(), 0.2, bridged=0.1), FOUR)
    assert total(short) == pytest.approx(0.2), "until rest is commanded"


@pytest.mark.parametrize(
    ("driven", "rolled", "missed"),
    [
        (-0.5, 4.0 * 0.1, 4.0 * 0.2),
        (0.05, 4.0 * 0.1, 4.0 * 0.2),
        (0.2, 4.0 * 0.2 + TO_REST * 0.6, (4.0 - TO_REST) * 0.1),
        (0.6, 4.0 * 0.6 + TO_REST * 0.2, 0.0),
        (0.75, 4.0 * 0.7, 0.0),
        (0.9, 4.0 * 0.35, 0.0),
    ],
)
def test_a_late_command_to_rest_is_used_and_an_early_one_leaves_time_to_slow_down(
    driven: float, rolled: float, missed: float
) -> None:
    """The wheels slow down from the command to rest until the end of the line, at 0.8 s.

    If no command to rest was sent before that end, they go on for half of the gap. `missed` is the
    further angle, rad, if the command to rest was lost.
    """
    line = Feedback(AT, STILL, 0.8, bridged=0.7, driven=driven)
    stood = Rolling(quiet=0.1).take(line, FOUR)
    assert total(stood) == pytest.approx(rolled)
    assert stood.missed == all_four(missed)


@pytest.mark.parametrize(
    ("after", "angle"),
    [
        (1.5, 1.05),
        (1.0, 0.8 + (4.0 - 1.0) / math.log(4.0) * 0.5),
        (-0.5, 0.8 + TO_REST * 0.5),
        (4.0, 2.8),
    ],
)
def test_speeds_that_are_large_enough_are_means_over_the_gap(after: float, angle: float) -> None:
    """The line's speed is the mean over the gap if it is at least 1.14 rad/s.

    The wheels rolled 0.8 rad at 4 rad/s before the command to rest, and 0.8 rad give this mean.
    """
    line = Feedback(AT, WheelSpeeds(after, after, after, after), 0.7, bridged=0.7, driven=0.2)
    assert total(Rolling(quiet=0.1).take(line, FOUR)) == pytest.approx(angle)
    mirrored = Feedback(AT, WheelSpeeds(*(-after,) * 4), 0.7, bridged=0.7, driven=0.2)
    back = Rolling(quiet=0.1).take(mirrored, WheelSpeeds(-4.0, -4.0, -4.0, -4.0))
    assert total(back) == pytest.approx(-angle)


def test_a_mean_may_also_cover_the_time_after_the_gap() -> None:
    """A board that was silent for 0.2 s reports the mean of this time, of which 0.1 s is a gap."""
    line = Feedback(AT, WheelSpeeds(2.5, 2.5, 2.5, 2.5), 0.2, bridged=0.1, driven=0.105)
    assert total(Rolling(quiet=0.1).take(line, FOUR)) == pytest.approx(2.5 * 0.2)


@pytest.mark.parametrize(("after", "angle"), [(6.0, 0.5 + 0.06), (3.0, 0.4 + 0.03)])
def test_a_wheel_that_became_faster_before_the_command_to_rest_has_the_mean_speed(
    after: float, angle: float
) -> None:
    """The command to rest came between the gap and the end of the line."""
    line = Feedback(AT, WheelSpeeds(after, after, after, after), 0.11, bridged=0.1, driven=0.105)
    assert total(Rolling(quiet=0.1).take(line, FOUR)) == pytest.approx(angle)


def test_in_a_short_gap_no_command_to_rest_is_doubtful() -> None:
    line = Feedback(AT, TWO, 0.1, bridged=0.09, driven=0.05)
    assert Rolling(quiet=0.1).take(line, FOUR).missed == AT_REST


@pytest.mark.parametrize(
    ("late", "rolled"), [(0.15, 4.0 * 0.25 + TO_REST * 0.56), (-0.05, 4.0 * 0.1)]
)
def test_the_command_to_rest_may_come_in_the_gap_behind_an_implausible_line(
    late: float, rolled: float
) -> None:
    """`late` is the time from the implausible line to the command to rest, s.

    Another gap of 0.1 s comes before the implausible line.
    """
    rolling = Rolling(quiet=0.1)
    rolling.skip(Feedback(AT, FOUR, 0.11, bridged=0.1, driven=0.4))
    stood = rolling.take(Feedback(AT, STILL, 0.7, bridged=0.6, driven=late), FOUR)
    assert total(stood) == pytest.approx(rolled)


def test_the_command_to_rest_in_a_gap_before_an_implausible_line_is_used() -> None:
    rolling = Rolling(quiet=0.1)
    rolling.skip(Feedback(AT, FOUR, 0.61, bridged=0.6, driven=0.2))
    stood = rolling.take(Feedback(AT, STILL, 0.01, driven=-0.4), FOUR)
    assert total(stood) == pytest.approx(4.0 * 0.2 + TO_REST * 0.42)


def test_counts_take_precedence_over_the_speed() -> None:
    counted = (0.05, 0.05, 0.05, 0.05)
    rolled = Rolling().take(Feedback(AT, FOUR, 0.01, counted=counted), TWO)
    assert rolled.pieces == (counted,)
    assert rolled.seen == all_four(0.04)  # a corrected count is not a motion of this line
    turned = (0.06, 0.06, 0.06, 0.06)
    rolled = Rolling().take(Feedback(AT, FOUR, 0.01, turned=turned), TWO)
    assert (rolled.turned, rolled.pieces, rolled.seen) == (turned, (), turned)


def test_counts_of_a_skipped_line_after_a_long_silence_are_added_once() -> None:
    """The skipped line covers no time, because the silence before it covers all of it."""
    rolling, turned = Rolling(), (0.06, 0.06, 0.06, 0.06)
    rolling.skip(Feedback(AT, FOUR, 0.0, gap=0.5, turned=turned))
    first = rolling.take(Feedback(AT, FOUR, 0.01, turned=turned), TWO)
    second = rolling.take(Feedback(AT, FOUR, 0.01, turned=turned), FOUR)
    assert (first.turned, second.turned) == (all_four(0.12), turned)


@pytest.mark.parametrize("lines", [1, 4])
def test_a_short_time_of_skipped_lines_has_the_speed_of_the_next_line(lines: int) -> None:
    rolling = Rolling()
    for _ in range(lines):
        rolling.skip(Feedback(AT, TWO, 0.01))
    rolled = rolling.take(Feedback(AT, FOUR, 0.01), TWO)
    assert total(rolled) == pytest.approx(0.04 * (lines + 1))
    assert (rolled.known, rolled.unknown) == near(0.01 * (lines + 1), 0.0)
    assert total(rolling.take(Feedback(AT, FOUR, 0.01), FOUR)) == pytest.approx(0.04)


def test_motion_is_unknown_after_too_many_implausible_lines() -> None:
    rolling = Rolling()
    rolling.skip(Feedback(AT, TWO, MAX_LOST_S))
    rolling.skip(Feedback(AT, TWO, 0.01))
    rolled = rolling.take(Feedback(AT, FOUR, 0.01), TWO)
    assert total(rolled) == pytest.approx(0.04)
    assert (rolled.known, rolled.unknown) == near(0.0, MAX_LOST_S + 0.01)


def test_neither_the_counts_nor_the_time_of_a_skipped_line_are_lost() -> None:
    rolling, turned = Rolling(), (0.06, 0.06, 0.06, 0.06)
    rolling.skip(Feedback(AT, TWO, 0.01, turned=turned))
    rolled = rolling.take(Feedback(AT, FOUR, 0.01, turned=turned), TWO)
    assert rolled.turned == all_four(0.12)
    assert rolled.seen == turned
    assert (rolled.seconds, rolled.known) == near(0.01, 0.02)


def test_gaps_before_skipped_lines_stay_unknown_motion() -> None:
    rolling = Rolling()
    rolling.skip(Feedback(AT, TWO, 0.0, gap=0.5))
    rolled = rolling.take(Feedback(AT, FOUR, 0.0, gap=0.3), TWO)
    assert (rolled.known, rolled.unknown) == near(0.0, 0.8)


def test_one_skipped_line_of_a_slow_link_is_bridged_too() -> None:
    rolling = Rolling()
    rolling.skip(Feedback(AT, TWO, 0.1))
    rolled = rolling.take(Feedback(AT, FOUR, 0.1), TWO)
    assert total(rolled) == pytest.approx(0.8)
    assert (rolled.known, rolled.unknown) == near(0.2, 0.0)


def test_counts_of_a_skipped_line_after_a_short_silence_are_added_once() -> None:
    rolling, turned = Rolling(), (0.06, 0.06, 0.06, 0.06)
    rolling.skip(Feedback(AT, TWO, 0.0, gap=0.15, turned=turned))
    first, second = (rolling.take(Feedback(AT, FOUR, 0.01, turned=turned), TWO) for _ in range(2))
    assert first.turned == all_four(0.12)
    assert second.turned == turned


def test_a_gap_before_a_skipped_line_has_the_mean_of_the_speeds_around_it() -> None:
    rolling = Rolling()
    rolling.skip(Feedback(AT, TWO, 0.51, bridged=0.5))
    rolled = rolling.take(Feedback(AT, FOUR, 0.01), TWO)
    assert total(rolled) == pytest.approx(0.5 * 3.0 + 0.02 * 4.0)
    assert (rolled.seconds, rolled.bridged) == near(0.52, 0.5)
    assert (rolled.known, rolled.unknown) == near(0.52, 0.0)
    assert total(rolling.take(Feedback(AT, FOUR, 0.01), FOUR)) == pytest.approx(0.04)


def test_a_gap_before_a_skipped_line_has_the_next_lines_speed_if_that_line_has_counts() -> None:
    rolling, turned = Rolling(), (0.06, 0.06, 0.06, 0.06)
    rolling.skip(Feedback(AT, TWO, 0.51, bridged=0.5))
    rolled = rolling.take(Feedback(AT, FOUR, 0.01, turned=turned), TWO)
    assert total(rolled) == pytest.approx(0.06 + 0.51 * 4.0)
    assert (rolled.known, rolled.bridged) == near(0.52, 0.0)


# doubtful lines


def one_wheel_at(index: int, speed: float, others: float = 4.0) -> WheelSpeeds:
    return WheelSpeeds(*[speed if i == index else others for i in range(4)])


class Doubtful:
    """A `Confirmation` that has received one line at 100 Hz, and a count of its lines."""

    def __init__(self, before: WheelSpeeds = FOUR) -> None:
        self.confirmation, self.before, self.lines = Confirmation(), before, 0
        self.receive(before, 0.01)

    def receive(self, speeds: WheelSpeeds, dt: float, **more: Any) -> tuple[list[int], list[int]]:
        """Receive a further line, and return the numbers of the lines to use and to drop."""
        self.lines += 1
        line = Feedback(Instant(self.lines, 0), speeds, dt, **more)
        used, dropped = self.confirmation.confirm(line, self.skipped, self.before, self.believed)
        if used:
            self.before = used[-1].speeds
        return [each.at.mono_ns for each in used], [each.at.mono_ns for each in dropped]

    skipped = 0.0

    @staticmethod
    def believed(wheels: Motors) -> Motors:
        return wheels


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("gap", [{"dt": 0.51, "bridged": 0.5}, {"dt": 0.0, "gap": 1.5}])
def test_a_wheel_that_changes_alone_in_a_gap_is_refuted_by_the_next_line(
    wheel: int, gap: dict[str, float]
) -> None:
    doubtful = Doubtful()
    assert doubtful.receive(one_wheel_at(wheel, 14.0), **gap) == ([], [])
    assert doubtful.receive(FOUR, 0.01) == ([3], [2])
    assert doubtful.receive(one_wheel_at(wheel, 14.0), 0.01) == ([4], []), (
        "a usual line is used at once"
    )


def test_a_wheel_that_changes_alone_in_a_gap_is_confirmed_by_the_next_line() -> None:
    doubtful = Doubtful()
    assert doubtful.receive(one_wheel_at(1, 14.0), 0.51, bridged=0.5) == ([], [])
    assert doubtful.receive(one_wheel_at(1, 14.1), 0.01) == ([2, 3], [])


def test_wheels_of_a_side_that_change_alike_in_a_gap_need_no_other_line() -> None:
    doubtful = Doubtful()
    assert doubtful.receive(WheelSpeeds(40.0, -9.0, -9.2, 40.1), 0.51, bridged=0.5) == ([2], [])


def test_a_doubtful_angle_no_larger_than_that_of_a_usual_line_is_used_immediately() -> None:
    # (1500 rad/s2 x 10 ms + 2 rad/s) x 10 ms / 0.51 s is 0.333 rad/s.
    assert Doubtful().receive(one_wheel_at(2, 4.33), 0.51, bridged=0.5) == ([2], [])
    assert Doubtful().receive(one_wheel_at(2, 4.34), 0.51, bridged=0.5) == ([], [])


def test_known_quantization_steps_make_no_line_doubtful() -> None:
    for steps, used in (((9.8,) * 4, [2]), ((9.6,) * 4, []), ((math.inf,) * 4, [])):
        assert Doubtful().receive(one_wheel_at(2, 14.0), 0.51, bridged=0.5, steps=steps) == (
            used,
            [],
        )


def test_a_pause_without_lost_lines_is_judged_like_a_gap() -> None:
    doubtful = Doubtful()
    assert doubtful.receive(one_wheel_at(0, 14.0), 0.3) == ([], [])
    assert doubtful.receive(FOUR, 0.01) == ([3], [2])


def test_a_line_after_skipped_lines_is_doubtful_like_a_line_after_a_gap() -> None:
    doubtful = Doubtful()
    doubtful.skipped = 0.5
    assert doubtful.receive(one_wheel_at(0, 14.0), 0.01) == ([], [])


def test_a_line_with_counts_is_used_immediately() -> None:
    assert Doubtful().receive(one_wheel_at(0, 14.0), 0.51, turned=(0.0,) * 4) == ([2], [])


@pytest.mark.parametrize(
    ("speeds", "used", "dropped"),
    [
        ((9.0, 8.0, 7.0), [2, 3, 4], []),
        ((40.0, 8.0, 7.8), [3, 4], [2]),
        ((9.0, 40.0, 8.8), [2, 4], [3]),
        ((9.0, 8.5, 40.0), [2, 3], [4]),
    ],
    ids=["none", "first", "second", "third"],
)
def test_the_line_that_differs_much_from_two_others_is_dropped(
    speeds: tuple[float, ...], used: list[int], dropped: list[int]
) -> None:
    """Only one wheel of the side changes, because the encoder of the other wheel is dead."""
    doubtful = Doubtful(STILL)
    results = [doubtful.receive(one_wheel_at(3, speed, 0.0), 0.01 + gap, bridged=gap)
            for speed, gap in zip(speeds, (0.5, 0.0, 0.0), strict=True)]  # fmt: skip
    assert results == [([], []), ([], []), (used, dropped)]


def test_a_wheel_that_is_known_to_be_faulty_makes_no_line_doubtful() -> None:
    doubtful = Doubtful()
    doubtful.believed = lambda wheels: (wheels[3], *wheels[1:])  # type: ignore[method-assign]
    assert doubtful.receive(one_wheel_at(0, 0.0, 14.0), 0.51, bridged=0.5) == ([2], [])


def test_a_slower_board_makes_the_usual_time_longer() -> None:
    doubtful = Doubtful()
    for _ in range(300):
        doubtful.receive(STILL, 0.05)
    wild = one_wheel_at(0, 0.0, 14.0)
    assert doubtful.receive(wild, 0.05) == ([302], [])


def test_on_a_slow_link_the_usual_time_is_longer() -> None:
    slow = Doubtful()
    slow.confirmation = Confirmation()
    for _ in range(3):
        assert slow.receive(FOUR, 0.1) == ([slow.lines], [])
    assert slow.receive(one_wheel_at(1, 70.0), 0.1) == ([5], [])
    assert slow.receive(one_wheel_at(1, 4.0), 0.1) == ([6], [])
    assert slow.receive(one_wheel_at(1, 70.0), 0.6, bridged=0.5) == ([], [])


CRUISE = Twist(0.5, 0.5)


def test_the_acceleration_is_guessed_until_it_is_measured() -> None:
    along, yaw = Gaps().unseen(ACCELERATION_SPAN_S, CRUISE, CRUISE, REST)
    assert along == pytest.approx((ASSUMED_ACCELERATION.linear * ACCELERATION_SPAN_S**2 / 2) ** 2)
    assert yaw == pytest.approx((ASSUMED_ACCELERATION.angular * ACCELERATION_SPAN_S**2 / 2) ** 2)


def test_a_steady_drive_makes_gaps_certain() -> None:
    gaps = Gaps()
    gaps.interrupt(CRUISE)
    guessed = gaps.unseen(0.3, CRUISE, CRUISE, REST)
    for _ in range(6000):
        gaps.follow(CRUISE, 0.01)
    measured = gaps.unseen(0.3, CRUISE, CRUISE, REST)
    assert measured[0] < 0.02 * guessed[0]
    assert measured[1] < 0.02 * guessed[1]


def test_the_uncertainty_of_a_gap_follows_the_measured_accelerations_of_a_jerky_drive() -> None:
    # The speed alternates between 0.4 and 0.6 m/s every 0.1 s. A span begins and ends at one of
    # them.
    gaps = Gaps()
    for i in range(30_000):
        gaps.follow(Twist(0.4 if i // 10 % 2 else 0.6, 0.0), 0.01)
    along, yaw = gaps.unseen(ACCELERATION_SPAN_S, CRUISE, CRUISE, REST)
    assert 0.004**2 < along < 0.02**2
    assert yaw < 1e-5


def test_time_at_rest_does_not_change_the_uncertainty_of_gaps() -> None:
    gaps = Gaps()
    before = gaps.unseen(0.3, CRUISE, CRUISE, REST)
    for _ in range(6000):
        gaps.follow(REST, 0.01)
    assert gaps.unseen(0.3, CRUISE, CRUISE, REST) == before


def test_a_gap_between_two_rests_has_no_uncertainty() -> None:
    assert Gaps().unseen(5.0, REST, REST, REST) == (0.0, 0.0)


def test_the_uncertainty_of_a_gap_is_bounded_by_its_fastest_speed() -> None:
    before, after = Twist(0.1, -0.2), Twist(-0.5, 0.1)
    assert Gaps().unseen(30.0, before, after, REST) == pytest.approx((15.0**2, 6.0**2))
    faster = Gaps().unseen(30.0, before, after, Twist(0.6, 0.3))
    assert faster == pytest.approx((15.0**2, 6.0**2))
    assert Gaps().unseen(30.0, REST, REST, Twist(0.6, 0.3)) == pytest.approx((0.6**2, 0.3**2))
    assert Gaps().unseen(0.5, REST, REST, Twist(0.0001, 0.0)) == pytest.approx((0.00005**2, 0.0))


def test_a_line_between_two_gaps_makes_their_errors_independent() -> None:
    gaps = Gaps()
    first = gaps.fill(0.3, CRUISE, CRUISE, REST)
    gaps.follow(CRUISE, 0.01)
    assert gaps.fill(0.3, CRUISE, CRUISE, REST) == first
    assert gaps.fill(0.3, CRUISE, CRUISE, REST)[0] > 20 * first[0]


def rounding(
    *speeds: float,
    own: float = 0.01,
    gaps: tuple[int, ...] = (),
    largest: float = math.inf,
) -> float:
    """Return the quantization step that applies to a gap after lines with these speeds, rad/s.

    All wheels have the same speed. The lines with the indices `gaps` follow a gap that is not
    filled.
    """
    rounded, still = Rounding(), 0.0
    for number, speed in enumerate(speeds):
        covered = 0.0 if number in gaps else own
        still = 0.0 if speed else still + covered
        rounded.add((speed,) * 4, covered, still, number in gaps, largest)
    return math.sqrt(rounded.square / 2)


def test_a_speed_that_jumps_by_single_counts_is_rounded_to_them() -> None:
    assert rounding(*[0.0, 6.5, 0.0, 0.0, 6.5] * 20, 6.5) == pytest.approx(6.5, rel=0.15)
    assert rounding(*[6.5, 13.0, 6.5] * 20) == pytest.approx(6.5, rel=0.1)


def test_a_jump_beyond_the_known_step_is_not_taken_for_rounding() -> None:
    jumps = [10.0] * 5 + [1.0] + [10.0] * 5
    assert rounding(*jumps, largest=0.05) == pytest.approx(0.05, rel=0.3)


def test_a_single_jump_is_forgotten() -> None:
    after = [rounding(*[10.0] * 5, 1.0, *[10.0] * lines) for lines in (2, 20, 100)]
    assert after[0] > 2 * after[1] > 20 * after[2]


def test_a_line_of_unknown_duration_that_reports_rest_may_hide_a_count() -> None:
    assert rounding(*[0.0, 6.5] * 10, 0.0, 0.0, gaps=(21,)) > 4.0


def test_an_even_acceleration_is_not_taken_for_rounding() -> None:
    assert rounding(*[0.2 * number for number in range(100)], own=0.1) == pytest.approx(0.0)


def test_a_change_of_the_speed_over_a_gap_is_not_taken_for_rounding() -> None:
    assert rounding(*[0.0] * 5, *[10.0] * 5, gaps=(5,)) == 0.0
    assert rounding(*[0.0] * 5, *[10.0] * 5) > 1.0


def test_the_longer_the_wheels_stand_the_less_a_count_means() -> None:
    jumps = [0.0, 6.5] * 10
    steps = [rounding(*jumps, *[0.0] * lines) for lines in (1, 2, 4, 8, 16, 24)]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > 6.0
    assert 0.0 < steps[-2] < 0.5
    assert steps[-1] == 0.0
