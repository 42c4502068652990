"""The first turn proves that a gyro works, or shows which fault it has."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.gyro_trial import Trial, Verdict
from tests.each import each

DT = 0.01


def turned(trial: Trial, rate: float, share: float, seconds: float, late_s: float = 0.0) -> Verdict:
    """Return the verdict on the gyro after a turn.

    The wheels report `rate`, rad/s, and the gyro reports `share` times this rate.
    """
    for line in range(round(seconds / DT)):
        gyro_rate = rate * share if line * DT >= late_s else 0.0
        trial.add(rate * DT, gyro_rate * DT, DT)
    return trial.verdict


@each("rate", [0.3, -2.0])
@each(
    ("share", "verdict"),
    [
        (1.0, "good"), (0.5, "good"), (-1.0, "reversed"), (-0.6, "reversed"),
        (57.3, "in degrees"), (35.8, "in degrees"), (-57.3, "in degrees"),
        (0.0, "dead"), (0.05, "dead"), (5.0, "not believed"), (-9.0, "not believed"),
    ],
)  # fmt: skip
def test_the_verdict_on_a_gyro_depends_on_its_share_of_the_wheels_turn(
    rate: float, share: float, verdict: Verdict
) -> None:
    assert turned(Trial(), rate, share, 2.0) == verdict


@given(st.floats(0.15, 4.0), st.floats(0.3, 2.4), st.floats(0.0, 0.25))
def test_a_good_gyro_is_never_refuted_however_late_it_reports(
    rate: float, share: float, late_s: float
) -> None:
    trial, verdicts = Trial(), set()
    for line in range(round(8.0 / rate / DT)):
        gyro_rate = rate * share if line * DT >= late_s else 0.0
        trial.add(rate * DT, gyro_rate * DT, DT)
        verdicts.add(trial.verdict)
    assert verdicts - {"none yet", "dead"} == {"good"}


def test_a_turn_of_a_tenth_of_a_radian_proves_a_gyro() -> None:
    assert turned(Trial(), 1.0, 0.6, 0.11) == "good"
    assert turned(Trial(), 1.0, 0.6, 0.09) == "none yet"


def test_a_refuted_gyro_may_still_prove_itself() -> None:
    trial = Trial()
    assert turned(trial, 1.0, 0.0, 1.0) == "dead"
    assert trial.open
    assert turned(trial, -1.0, 0.6, 1.0) == "good"
    assert not trial.open


def test_very_slow_turns_and_short_turns_to_and_fro_give_no_verdict() -> None:
    trial = Trial()
    assert turned(trial, 0.04, -1.0, 60.0) == "none yet"
    for _ in range(10):
        turned(trial, 1.0, 0.0, 0.09)
        turned(trial, -1.0, 0.0, 0.09)
    assert trial.verdict == "none yet"


@pytest.mark.parametrize(
    ("rate", "share", "verdict"),
    [(0.08, 0.6, "good"), (0.08, -0.6, "reversed"), (0.12, 0.0, "dead"), (0.08, 0.0, "none yet")],
)
def test_slow_lines_add_up_to_a_verdict(rate: float, share: float, verdict: Verdict) -> None:
    """A silent gyro during a turn at 0.08 rad/s gives no verdict.

    Wheels with unequal tyres also report 0.08 rad/s on a straight drive, where a good gyro is
    silent.
    """
    assert turned(Trial(), rate, share, 6.0) == verdict


@pytest.mark.parametrize("seconds", [6.0, 60.0])
def test_a_turn_after_a_straight_on_unequal_tyres_proves_a_gyro(seconds: float) -> None:
    trial = Trial()
    turned(trial, 0.08, 0.0, seconds)
    verdicts = [turned(trial, 0.5, 1.0, DT) for _ in range(1000)]
    assert set(verdicts) == {"none yet", "good"}


def test_alternating_slow_rates_do_not_add_up_to_a_verdict() -> None:
    trial = Trial()
    for _ in range(1000):
        trial.add(0.04 * DT, 0.0, DT)
        trial.add(0.08 * DT, 0.0, DT)
    assert trial.verdict == "none yet"


def test_a_straight_between_two_turns_restarts_the_trial() -> None:
    trial = Trial()
    for _ in range(20):
        turned(trial, 1.0, 0.0, 0.09)
        turned(trial, 0.01, 0.0, 1.1)
    assert trial.verdict == "none yet"


def test_time_at_rest_does_not_count_as_turning() -> None:
    """A late gyro reports nothing when the turn begins, even after a long rest.

    It must not be found faulty for this.
    """
    trial = Trial()
    turned(trial, 1.0, 0.0, 0.05)
    turned(trial, 0.0, 0.0, 0.4)
    assert turned(trial, 4.0, 0.0, 0.1) == "none yet"


def test_only_a_gyro_in_degrees_is_recognized_without_a_known_bias() -> None:
    for share, verdict in ((57.3, "in degrees"), (-1.0, "none yet"), (1.0, "none yet")):
        trial = Trial()
        for _ in range(100):
            trial.add(DT, share * DT, DT, certain=False)
        assert trial.verdict == verdict
