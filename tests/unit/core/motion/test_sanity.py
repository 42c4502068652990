"""The daemon rejects impossible feedback with a reason. Repeated rejection leads to a fault."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import pytest

from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.sanity import Sanity
from acsard.core.values import STILL, WHEELS, Event, Instant, WheelSpeeds

DT = 0.01


AT = Instant(0, 0)


TEN = WheelSpeeds(10.0, 10.0, 10.0, 10.0)


def line(speeds: WheelSpeeds, dt: float = DT, gap: float = 0.0) -> Feedback:
    return Feedback(AT, speeds, dt, gap)


def only(wheel: int, speed: float, others: float = 0.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


class Judge(Sanity):
    """The checks with a `feedback.wheel_speed`."""

    fastest: float = FeedbackConfig().wheel_speed

    def judged(self, line: Feedback) -> str:
        return self.impossible(line, self.fastest)


Bounded = Callable[[float], Judge]


@pytest.fixture
def bounded(monkeypatch: pytest.MonkeyPatch) -> Bounded:
    """Return a function that makes a `Sanity` with another bound of the acceleration, rad/s2."""

    def make(acceleration: float) -> Judge:
        monkeypatch.setattr("acsard.core.motion.sanity.MAX_WHEEL_ACCELERATION", acceleration)
        return Judge()

    return make


# impossible lines


@pytest.mark.parametrize("wheel", range(4))
def test_a_speed_no_wheel_reaches_is_impossible_and_names_the_wheel(wheel: int) -> None:
    sanity = Judge()
    assert WHEELS[wheel] in sanity.judged(line(only(wheel, -80.01)))
    assert sanity.judged(line(only(wheel, 80.0))) == ""


@pytest.mark.parametrize("wheel", range(4))
def test_a_change_no_wheel_makes_is_impossible_and_names_the_wheel(
    wheel: int, bounded: Bounded
) -> None:
    sanity = bounded(100.0)
    assert sanity.judged(line(STILL)) == ""
    assert WHEELS[wheel] in sanity.judged(line(only(wheel, 3.5)))
    assert sanity.judged(line(only(wheel, 2.9))) == ""


def test_the_most_a_wheel_can_do_is_possible(bounded: Bounded) -> None:
    # The limit is 100 rad/s2 x 10 ms and 2 rad/s of slack.
    sanity = bounded(100.0)
    assert sanity.judged(line(STILL)) == ""
    assert sanity.judged(line(only(0, 3.0))) == ""
    assert sanity.judged(line(only(0, 0.0))) == ""
    assert "front_right" in sanity.judged(line(only(0, -3.01)))


def test_a_real_step_is_believed_as_soon_as_it_could_have_happened(
    bounded: Bounded,
) -> None:
    sanity = bounded(400.0)
    sanity.judged(line(STILL))
    verdicts = [sanity.judged(line(TEN)) == "" for _ in range(3)]
    assert verdicts == [False, True, True]


def test_after_a_pause_a_larger_change_is_possible_for_as_long_as_the_pause_lasted(
    bounded: Bounded,
) -> None:
    sanity = bounded(100.0)
    for seconds in (0.01, 0.25, 0.01, 0.01):  # the board repeats the mean of the pause
        assert sanity.judged(line(TEN, dt=seconds)) == ""
    assert sanity.judged(line(STILL)) == ""
    for _ in range(25):
        assert sanity.judged(line(STILL)) == ""
    assert sanity.judged(line(TEN))


def test_the_first_line_and_the_first_after_a_gap_have_no_slew(
    bounded: Bounded,
) -> None:
    sanity = bounded(10.0)
    assert sanity.judged(line(TEN, dt=0.0)) == ""
    assert sanity.judged(line(STILL, dt=0.0, gap=0.5)) == ""


def test_three_impossible_lines_in_a_row_are_doubtful_and_two_are_not() -> None:
    sanity = Judge()
    fast = line(only(0, 99.0))
    flags = []
    for _ in range(2):
        sanity.judged(fast)
        flags.append(sanity.doubtful)
    sanity.judged(line(STILL))
    for _ in range(3):
        sanity.judged(fast)
        flags.append(sanity.doubtful)
    assert flags == [False, False, False, False, True]


def test_forgetting_starts_over(bounded: Bounded) -> None:
    sanity = bounded(10.0)
    sanity.judged(line(STILL))
    for _ in range(3):
        sanity.judged(line(TEN))
    sanity.forget()
    assert not sanity.doubtful
    assert sanity.judged(line(TEN)) == ""


@pytest.mark.parametrize("forget", [False, True])
def test_three_impossible_lines_are_doubtful_at_the_start_and_after_forgetting(
    forget: bool,
) -> None:
    sanity = Judge()
    if forget:
        sanity.forget()
    flags = []
    for _ in range(3):
        sanity.judged(line(only(0, 99.0)))
        flags.append(sanity.doubtful)
    assert flags == [False, False, True]


# trust

SPIKE = only(2, 79.0)


def verdicts(sanity: Judge, *lines: Feedback) -> list[bool]:
    """Return for each line whether it is possible. Check that the lines cause no fault."""
    possible = []
    for each in lines:
        possible.append(sanity.judged(each) == "")
        assert not sanity.doubtful
    return possible


def test_the_line_before_a_lost_link_is_still_compared_after_it() -> None:
    sanity = Judge()
    sanity.judged(line(STILL))
    sanity.forget()
    assert verdicts(sanity, line(SPIKE), line(STILL)) == [False, True]


def test_a_damaged_first_line_is_outvoted_by_the_next_two() -> None:
    sanity = Judge()
    lines = [line(each) for each in (SPIKE, STILL, STILL, STILL)]
    assert verdicts(sanity, *lines) == [True, False, True, True]


@pytest.mark.parametrize("speed", [-79.0, -42.0, -10.0, 10.0, 42.0, 79.0])
@pytest.mark.parametrize("seconds", [0.03, 0.04, 0.06, 0.1, 0.6])
def test_a_damaged_line_that_covers_a_pause_is_no_fault_of_the_true_lines(
    seconds: float, speed: float
) -> None:
    sanity = Judge()
    lines = [line(STILL), line(STILL), line(only(1, speed), dt=seconds)]
    possible = verdicts(sanity, *lines, *[line(STILL)] * 5)
    assert possible[4:] == [True] * 4


def test_a_damaged_line_before_the_encoders_are_known_is_no_fault_of_the_true_lines() -> None:
    sanity, unknown = Judge(), stepping(SPIKE, math.inf)
    assert verdicts(sanity, line(STILL), unknown, *[line(STILL)] * 4)[3:] == [True] * 3


@pytest.mark.parametrize("first", [0, 1])
def test_the_true_lines_are_found_on_a_wire_that_damages_every_second_line(first: int) -> None:
    sanity, wild = Judge(), (79.0, -60.0, 35.0, -79.0, 60.0, -35.0)
    lines = []
    for speed in wild:
        lines += [line(only(2, speed)), line(STILL)]
    assert verdicts(sanity, *lines[first:])[3 - first :: 2] == [True] * 5


def test_a_repeated_speed_that_no_wheel_reaches_stays_impossible() -> None:
    sanity, fast = Judge(), line(only(0, 80.1))
    sanity.judged(line(SPIKE))
    assert [bool(sanity.judged(fast)) for _ in range(3)] == [True] * 3
    assert sanity.doubtful


def test_a_jump_from_a_speed_that_two_lines_agreed_on_is_a_fault_even_if_it_lasts() -> None:
    sanity = Judge()
    sanity.judged(line(STILL))
    sanity.judged(line(STILL))
    assert [bool(sanity.judged(line(SPIKE))) for _ in range(3)] == [True] * 3
    assert sanity.doubtful


def test_lines_that_agree_with_no_other_are_a_fault_from_the_first_on() -> None:
    sanity, flags = Judge(), []
    for speed in (20.0, 79.0, -79.0, -30.0):
        sanity.judged(line(only(3, speed)))
        flags.append(sanity.doubtful)
    assert flags == [False, False, False, True]


def test_a_line_after_a_gap_is_not_compared_with_lines_before_the_gap() -> None:
    sanity = Judge()
    verdicts(sanity, line(STILL), line(STILL), line(SPIKE))
    assert verdicts(sanity, line(STILL, dt=0.0, gap=2.0), line(SPIKE)) == [True, False]


# coarse encoders


def stepping(speeds: WheelSpeeds, step: float, proven: bool = False) -> Feedback:
    counted = (0.0,) * 4 if proven else None
    return Feedback(AT, speeds, DT, steps=(step,) * 4, counted=counted)


def test_a_count_more_or_less_at_each_end_is_no_change_of_speed(
    bounded: Bounded,
) -> None:
    # The limit is 100 rad/s2 x 10 ms, 2 rad/s of slack and twice 31.4 rad/s.
    sanity = bounded(100.0)
    assert sanity.judged(stepping(STILL, 31.4)) == ""
    assert sanity.judged(stepping(only(0, 65.7), 31.4)) == ""
    assert "front_right" in sanity.judged(stepping(only(0, -0.2), 31.4))


def test_one_additional_proven_count_is_not_too_fast() -> None:
    sanity = Judge(fastest=40.0)
    assert sanity.judged(stepping(only(2, 70.0), 31.4, proven=True)) == ""
    assert "wheel_speed" in sanity.judged(stepping(only(2, 71.5), 31.4, proven=True))


def test_a_speed_of_the_limit_and_one_proven_count_is_possible() -> None:
    sanity = Judge(fastest=40.0)
    assert sanity.judged(stepping(only(2, 71.25), 31.25, proven=True)) == ""


@pytest.mark.parametrize("number", [1, 2])
def test_one_count_is_never_too_fast_and_two_in_its_time_are(number: int) -> None:
    """A host that catches up after a stall may ask again after 4 ms.

    One count of 16 in this time is then 98 rad/s.
    """
    sanity, count = Judge(fastest=50.0), math.tau / 16
    speed, angle = number * count / 0.004, number * count
    for sampled in (True, False):
        turned = (angle, 0.0, 0.0, 0.0)
        line = Feedback(
            AT, only(0, speed), DT, count=count,
            turned=turned if sampled else None, counted=None if sampled else turned,
        )  # fmt: skip
        assert ("wheel_speed" in sanity.judged(line)) is (number == 2)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_speed_of_the_limit_and_one_learned_step_is_possible(wheel: int, sign: int) -> None:
    """One count of 96 in 10 ms is 6.54 rad/s, although the wheel turns with less than 4 rad/s."""
    sanity = Judge(fastest=5.0)
    assert sanity.judged(stepping(only(wheel, sign * 11.54), 6.54)) == ""
    assert WHEELS[wheel] in sanity.judged(stepping(only(wheel, sign * 11.55), 6.54))


def test_a_learned_step_excuses_fast_lines_only_as_long_as_their_mean_may_be_possible() -> None:
    """The limit is 5.5 rad/s, and the quantization step is 6.54 rad/s.

    A wheel at 5.4 rad/s reports one step in most lines and 0 in the others. Lines that always
    report a step or more have a mean above the limit.
    """
    sanity = Judge(fastest=5.5)
    steps = [stepping(only(1, speed), 6.54) for speed in (*(6.54,) * 5, 0.0)]
    assert verdicts(sanity, *steps * 20) == [True] * 120
    lasting = [sanity.judged(stepping(only(1, 7.35), 6.54)) for _ in range(10)]
    assert [why == "" for why in lasting] == [True] * 7 + [False] * 3
    assert sanity.doubtful


def test_a_damaged_line_does_not_make_the_fast_lines_after_it_impossible() -> None:
    sanity = Judge(fastest=20.0)
    for _ in range(20):
        assert sanity.judged(stepping(only(1, 70.0), 10.5)) != ""
        steps = [stepping(only(1, speed), 10.5) for speed in (21.0, 21.0, 21.0, 10.5, 10.5)]
        assert verdicts(sanity, *steps) == [True] * 5


def test_the_time_before_a_gap_does_not_count_for_a_lasting_speed() -> None:
    sanity = Judge(fastest=5.5)
    fast = stepping(only(1, 7.35), 6.54)
    lines = [fast] * 7 + [msgspec.structs.replace(fast, dt=0.0, gap=0.5)] + [fast] * 6
    assert verdicts(sanity, *lines) == [True] * 14


def test_the_step_of_one_wheel_excuses_nothing_before_the_steps_of_the_others_are_known() -> None:
    sanity = Judge()
    line = Feedback(AT, only(1, 99.0), DT, steps=(math.inf, 99.0, math.inf, math.inf))
    assert "front_left" in sanity.judged(line)


def test_a_fine_learned_step_does_not_delay_the_fault() -> None:
    sanity, flags = Judge(fastest=5.0), []
    for _ in range(3):
        sanity.judged(stepping(only(2, 5.3), 0.2))
        flags.append(sanity.doubtful)
    assert flags == [False, False, True]


@pytest.mark.parametrize("counts", [16, 40, 96, 200])
@pytest.mark.parametrize("rate", [50, 100, 200])
def test_no_wheel_within_its_limit_is_too_fast_before_its_step_is_known(
    counts: int, rate: int
) -> None:
    count = math.tau / counts
    for limit in (4.0, 10.0):
        sanity, angle, before = Judge(fastest=1.1 * limit), 0.0, 0
        for number in range(400):
            angle += limit * min(1.0, number / 20) / rate
            now = math.floor(angle / count)
            speeds, before = only(3, (now - before) * count * rate), now
            steps = (math.inf,) * 4
            assert sanity.judged(Feedback(AT, speeds, 1 / rate, steps=steps)) == ""


def unknown(*speeds: float, dt: float = DT, count: float = 0.0) -> list[Feedback]:
    """Return lines with these speeds of one wheel, whose quantization step is not known yet."""
    steps = (math.inf,) * 4
    return [Feedback(AT, only(1, v, 4.0), dt, steps=steps, count=count) for v in speeds]


def test_an_unknown_step_excuses_only_one_count_of_a_fast_time() -> None:
    """The step may be one count that the board reports in two lines.

    Of seven lines at 30 rad/s only five then prove a speed: a mean of 21.4 rad/s, below the limit
    of 22. Of eight lines six prove one, with a mean of 22.5 rad/s.
    """
    sanity = Judge(fastest=22.0)
    flags = [bool(sanity.judged(line)) for line in unknown(*[30.0] * 10)]
    assert flags == [False] * 7 + [True] * 3
    assert sanity.doubtful


def test_each_wheel_has_its_own_fast_time() -> None:
    sanity = Judge(fastest=10.0)
    for wheel in (0, 1, 2, 3, 1, 1, 3, 0, 2, 2):
        line = Feedback(AT, only(wheel, 30.0), DT, steps=(math.inf,) * 4)
        assert sanity.judged(line) == ""


def test_a_line_within_the_limit_ends_the_fast_time() -> None:
    sanity = Judge(fastest=10.0)
    assert verdicts(sanity, *unknown(*[30.0, 30.0, 0.0] * 9)) == [True] * 27


def test_a_slow_line_of_one_wheel_ends_only_the_fast_time_of_that_wheel() -> None:
    sanity = Judge(fastest=20.0)
    names = []
    for first in (0.0, 30.0, 30.0, 0.0, 30.0, 30.0, 30.0, 0.0):
        speeds = WheelSpeeds(first, 32.0, 0.0, 0.0)
        line = Feedback(AT, speeds, DT, steps=(math.inf,) * 4)
        names.append(sanity.judged(line).partition(" ")[0])
    # The limit and 2 / 5 of 32 rad/s are 32.8 rad/s, and with 2 / 6 they are 30.7 rad/s.
    assert names == [""] * 5 + ["front_left"] * 3


def test_forgetting_ends_the_fast_time() -> None:
    sanity = Judge(fastest=20.0)
    fast = [32.0] * 5
    assert verdicts(sanity, *unknown(*fast)) == [True] * 5
    sanity.forget()
    assert verdicts(sanity, *unknown(*fast, 32.0)) == [True] * 5 + [False]


def test_no_unknown_step_is_larger_than_one_count_of_sixteen() -> None:
    """A higher speed comes from a damaged digit, and is rejected at once.

    One count of 16 in 10 ms is 39.27 rad/s.
    """
    for speed, possible in ((39.26, True), (39.28, False), (90.0, False)):
        sanity = Judge(fastest=10.0)
        assert verdicts(sanity, *unknown(speed, 4.0)) == [possible, True]


def test_a_learned_step_excuses_no_speed_above_one_count_of_sixteen() -> None:
    """Damaged lines of all wheels could otherwise be taken for coarse encoders."""
    sanity = Judge()
    assert "rear_left" in sanity.judged(stepping(only(2, 95.0), 90.0))


@pytest.mark.parametrize(
    ("dt", "fastest"), [(0.0, 10.0), (1e-6, 78.53), (0.004, 78.53), (0.02, 19.63)]
)
def test_an_unknown_step_is_one_count_in_the_time_of_the_line_or_in_5_ms(
    dt: float, fastest: float
) -> None:
    """In a line without a known time no speed is excused, because this line adds no motion."""
    for speed, possible in ((fastest, True), (fastest + 0.02, False)):
        sanity, steps = Judge(fastest=10.0), (math.inf,) * 4
        line = Feedback(AT, only(1, speed), dt, steps=steps)
        assert verdicts(sanity, line) == [possible]


def test_the_time_of_an_unknown_step_does_not_include_lost_lines() -> None:
    sanity = Judge(fastest=10.0)
    (line,) = unknown(39.0, dt=0.05)
    assert sanity.judged(msgspec.structs.replace(line, bridged=0.04)) == ""


def test_three_impossible_lines_are_doubtful_also_before_the_step_is_known() -> None:
    sanity, flags = Judge(), []
    for line in unknown(99.0, 99.0, 99.0):
        sanity.judged(line)
        flags.append(sanity.doubtful)
    assert flags == [False, False, True]


def test_an_unknown_encoder_makes_any_change_possible_but_no_speed_above_the_limit() -> None:
    sanity = Judge()
    assert sanity.judged(stepping(STILL, math.inf)) == ""
    assert sanity.judged(stepping(only(1, 79.9), math.inf)) == ""
    assert "front_left" in sanity.judged(stepping(only(1, 80.1), math.inf))
    assert "front_left" in sanity.judged(stepping(only(1, 80.1), math.inf, proven=True))


# the limits themselves


def test_a_change_of_the_limit_and_two_counts_is_possible(
    bounded: Bounded,
) -> None:
    # 100 rad/s2 x 10 ms, 2 rad/s of slack and twice 0.5 rad/s
    sanity = bounded(100.0)
    assert sanity.judged(stepping(STILL, 0.5)) == ""
    assert sanity.judged(stepping(only(0, 4.0), 0.5)) == ""


WINDOW, MOST = 1000, 10
"""Lines of a window, and the largest number of impossible ones in it without a warning."""


def warned(sanity: Judge, bad: int, lines: int = WINDOW) -> list[Event]:
    """Return the warnings after a window of lines whose first `bad` lines are impossible."""
    warnings = []
    for i in range(lines):
        sanity.judged(line(WheelSpeeds(*[200.0 if i < bad else 10.0] * 4)))
        warnings.append(sanity.warning)
    return [warning for warning in warnings if warning is not None]


def test_one_impossible_line_in_a_hundred_causes_no_warning() -> None:
    sanity = Judge()
    assert [warned(sanity, MOST) for _ in range(5)] == [[]] * 5


def test_more_impossible_lines_cause_one_warning_in_each_window() -> None:
    sanity = Judge()
    assert [len(warned(sanity, MOST + 1 + more)) for more in (0, 0, 500)] == [1, 1, 1]


def test_the_warning_comes_with_the_first_line_too_many() -> None:
    sanity = Judge()
    assert sanity.warning is None
    assert warned(sanity, MOST, MOST) == []
    assert len(warned(sanity, 1, 1)) == 1


def test_the_warning_names_the_wheel_and_the_setting() -> None:
    (event,) = warned(Judge(), WINDOW)
    assert (event.name, event.level) == ("lines_implausible", "warning")
    assert event.text.startswith(f"{MOST + 1} of {MOST + 1} lines")
    assert "front_right at 200.00 rad/s is over feedback.wheel_speed" in event.text
