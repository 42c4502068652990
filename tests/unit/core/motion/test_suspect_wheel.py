"""Tests of the evidence that a wheel's encoder is faulty, and of the evidence against it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.suspect_wheel import FAULT_TEXTS, Stuck, Suspect, WheelFault, was_faulty
from acsard.core.motion.wheel_witness import MIN_COMMANDED_SPEED, Expected
from tests.each import each

DT = 0.01
FINE = math.tau / 3200
Known = tuple[Expected, float | None]
"""The expected speed and the gyro's turn, rad or None."""


def known_from_command(speed: float, slow: float | None = None, gyro: float | None = None) -> Known:
    expected = Expected()
    expected.commanded, expected.speed = speed, speed if slow is None else slow
    expected.clear = expected.settled = speed >= MIN_COMMANDED_SPEED
    return expected, gyro


NOTHING = known_from_command(0.0)


def felt(speed: float) -> Known:
    return known_from_command(0.0, gyro=speed * DT)


def judge(
    own: float, other: float, known: Known, lines: int = 4, same: bool = False
) -> tuple[bool, WheelFault | None]:
    """Return whether the wheel is found faulty after these lines, and its kind of fault.

    Speeds are in rad/s.
    """
    suspect = Suspect()
    for _ in range(lines):
        if suspect.looks(own * DT, other * DT, same, DT, FINE):
            suspect.compare(own * DT, other * DT, DT, FINE, *known)
    return suspect.sign is not None and suspect.is_faulty(FINE), suspect.sign


@each("known", [known_from_command(10.0), known_from_command(12.0, slow=8.0), felt(10.0)])
@each(("own", "lie"), [(0.0, "dead"), (0.4, "dead"), (-10.0, "reversed")])
def test_a_wheel_that_the_command_or_the_gyro_contradicts_is_faulty(
    own: float, lie: WheelFault, known: Known
) -> None:
    assert judge(own, 10.0, known) == (True, lie)


@pytest.mark.parametrize("own", [0.0, -10.0])
def test_two_lines_are_too_few_to_find_a_faulty_wheel(own: float) -> None:
    assert not judge(own, 20.0, known_from_command(20.0), lines=2)[0]


@pytest.mark.parametrize("own", [0.0, -10.0])
def test_no_wheel_is_found_faulty_without_a_command_and_a_gyro(own: float) -> None:
    assert not judge(own, 10.0, NOTHING, lines=1000)[0]


def test_a_wheel_that_follows_its_command_is_not_faulty() -> None:
    assert not judge(0.0, 10.0, known_from_command(0.4), lines=100)[0]
    assert not judge(10.0, -10.0, known_from_command(10.0), lines=100)[0]


def test_a_gyro_takes_precedence_over_the_command() -> None:
    spins = known_from_command(10.0, gyro=0.0)
    assert judge(0.0, 10.0, known_from_command(10.0))[0]
    assert not judge(0.0, 10.0, spins, lines=100)[0]


def test_half_the_speed_is_no_sign_of_a_fault() -> None:
    assert judge(5.0, 10.0, known_from_command(10.0), lines=100) == (False, None)


def test_a_constant_wheel_speed_while_the_command_and_the_other_wheel_change_is_stuck() -> None:
    suspect, speed = Suspect(), 10.0
    lines = 0
    while lines < 40:
        lines += 1
        speed -= 0.3
        command = known_from_command(speed - 1.0, speed + 2.0)
        assert suspect.looks(10.0 * DT, speed * DT, True, DT, FINE)
        suspect.compare(10.0 * DT, speed * DT, DT, FINE, *command)
        if suspect.is_faulty(FINE):
            break
    assert suspect.sign == "stuck"
    assert 3 <= lines < 30


@pytest.mark.parametrize(("change", "out"), [(-0.2, False), (0.2, True)])
def test_a_wheel_of_a_slow_robot_may_turn_against_a_new_command_while_it_slows_down(
    change: float, out: bool
) -> None:
    suspect, against = Suspect(), known_from_command(10.0)
    against[0].clear, against[0].settled = True, False
    speed = -5.0
    for _ in range(10):
        speed -= change
        assert suspect.looks(speed * DT, -speed * DT, False, DT, FINE)
        suspect.compare(speed * DT, -speed * DT, DT, FINE, *against)
    assert suspect.is_faulty(FINE) is out


def test_a_wheel_that_turns_more_evenly_than_by_hand_is_stuck() -> None:
    assert not judge(3.0, 0.0, NOTHING, lines=25, same=True)[0]
    assert judge(3.0, 0.0, NOTHING, lines=35, same=True) == (True, "stuck")


@each(
    ("lie", "own", "other", "lied"),
    [
        ("dead", 0.0, 5.0, True), ("dead", 5.0, 5.0, False),
        ("reversed", -5.0, 5.0, True), ("reversed", 0.0, 5.0, True), ("reversed", 5.0, 5.0, False),
        ("stuck", 7.0, 5.0, True), ("stuck", 7.01, 5.0, False),
    ],
)  # fmt: skip
def test_an_earlier_line_belongs_to_the_fault_if_it_has_the_sign_of_the_fault(
    lie: WheelFault, own: float, other: float, lied: bool
) -> None:
    assert was_faulty(lie, own, other, 7.0) is lied


def test_every_wheel_fault_has_a_text() -> None:
    assert set(FAULT_TEXTS) == set(WheelFault.__args__)  # type: ignore[attr-defined]


SLOW_S = 0.25
"""Time in which a slow wheel completes most of a change, s."""


def after(acceleration: float, other: float = 1.0, same: bool = True, count: float = FINE) -> float:
    """Return the time until the check finds a wheel that is stuck at 10 rad/s, s.

    The time starts when the command changes from 10 rad/s. The other wheel follows `other` times
    this change. The result is inf if one second is not enough.
    """
    stuck, slow, command, turned = Stuck(), 10.0, 10.0, 10.0
    for line in range(200):
        command += acceleration * DT if line >= 100 else 0.0
        slow += (command - slow) * DT / (SLOW_S + DT)
        turned = 10.0 + other * (command - 10.0)
        if stuck.add(same, (turned - 10.0) * DT, DT, count, known_from_command(command, slow)[0]):
            return (line - 99) * DT
    return math.inf


@pytest.mark.parametrize("acceleration", [20.0, 32.0, -20.0, -32.0])
def test_a_stuck_wheel_is_found_within_50_ms_after_its_error_reaches_2_rad_s(
    acceleration: float,
) -> None:
    assert after(acceleration) <= 2.0 / abs(acceleration) + 0.05


def test_a_wheel_at_a_constant_command_is_never_stuck() -> None:
    assert after(0.0) == math.inf


def test_a_wheel_that_reports_changing_speeds_is_not_stuck() -> None:
    assert after(20.0, same=False) == math.inf


def test_a_wheel_is_not_stuck_if_the_other_wheel_does_not_follow_the_command_either() -> None:
    assert after(20.0, other=0.0) == math.inf
    assert after(20.0, other=-1.0) == math.inf


@pytest.mark.parametrize("counts", [96, 400])
def test_a_stuck_wheel_with_a_coarser_encoder_is_found_later(counts: int) -> None:
    assert after(20.0) < after(20.0, count=math.tau / counts)


def test_a_changed_speed_in_between_restarts_the_evidence_of_a_stuck_wheel() -> None:
    stuck = Stuck()
    for line in range(1, 100):
        command = 10.0 + 0.2 * line
        result = stuck.add(
            line % 3 != 0, 0.002 * line, DT, FINE, known_from_command(command, command - 1.0)[0]
        )
        assert not result


@given(st.floats(0.0, 1.0), st.floats(0.02, 0.1), st.sampled_from([16, 96, 400, 3200]))
def test_a_sound_wheel_with_an_encoder_of_any_kind_is_not_stuck(
    phase: float, lag: float, counts: int
) -> None:
    stuck, count = Stuck(), math.tau / counts
    slow = command = speed = 10.0
    angles, totals = [phase * count, 0.0], [0, 0]
    last = None
    for line in range(300):
        command += 0.2 if 100 <= line < 160 else 0.0
        slow += (command - slow) * DT / (SLOW_S + DT)
        speed += (command - speed) * DT / (lag + DT)
        angles = [angle + speed * DT for angle in angles]
        own, other = (  # both are whole counts
            math.floor(angle / count) - before for angle, before in zip(angles, totals, strict=True)
        )
        totals = [totals[0] + own, totals[1] + other]
        assert not stuck.add(
            own == last, (other - own) * count, DT, count, known_from_command(command, slow)[0]
        )
        last = own
