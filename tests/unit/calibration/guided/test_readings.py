"""Tests that turn tape readings into parameters and their standard deviations."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.doubts import RefusedError
from acsard.calibration.evidence import LEFT, RIGHT, TURN
from acsard.calibration.guided.readings import Reading, What, found, joined, predicted
from acsard.calibration.runs import Run
from tests.unit.calibration.cut import BASE, IDEAL, log_of
from tests.unit.calibration.robots import Plan, Robot, drive

SPIN: Plan = [(0.5, 0, 0), (15, 0, 1.2), (1, 0, 0)]
STRAIGHT: Plan = [(0.5, 0, 0), (6, 0.3, 0), (1, 0, 0)]
CURVE: Plan = [(0.5, 0, 0), (6, 0.3, 0.4), (1, 0, 0)]

TRUE = {"chi": 1.5, "left": 0.98, "right": 1.01}


def driven(plan: Plan) -> tuple[Run, complex, float]:
    """Return the wheel log of a robot without noise, its true end position and its true heading."""
    made = drive(replace(Robot(), **(IDEAL | TRUE)), plan)  # type: ignore[arg-type]
    run = log_of(made.csv(gyro=False)).runs[0]
    return run, complex(made.where[-1]), float(made.yaw[-1])


def readings() -> list[Reading]:
    """Return one exact reading of every kind."""
    spin, _, turned = driven(SPIN)
    straight, end, bent = driven(STRAIGHT)
    curve, there, _ = driven(CURVE)
    return [
        Reading((spin,), "turned", turned, 0.01),
        Reading((straight,), "distance", abs(end), 0.002),
        Reading((straight,), "angle", bent, 0.01),
        Reading((curve,), "ahead", there.real, 0.002),
        Reading((curve,), "aside", there.imag, 0.002),
    ]


def test_exact_readings_give_the_robot() -> None:
    told = found(readings(), BASE)
    assert 1 / told.parameters[TURN] == pytest.approx(1.5, rel=2e-3)
    assert told.parameters[LEFT] == pytest.approx(0.98, rel=1e-3)
    assert told.parameters[RIGHT] == pytest.approx(1.01, rel=1e-3)
    assert np.all(np.abs(told.left) < 3e-3)


def test_whole_turns_that_were_not_counted_do_not_matter() -> None:
    given = readings()
    spin, _, turned = driven(SPIN)
    given.append(Reading((spin,), "angle", math.remainder(turned, 2 * math.pi), 0.01))
    assert found(given, BASE).parameters == pytest.approx(
        found(readings(), BASE).parameters, abs=3e-3
    )


@pytest.mark.parametrize("what", ["turned", "distance", "ahead", "aside"])
def test_slopes_are_those_of_small_steps(what: What) -> None:
    """The computed slopes ignore a small second-order effect of the rate parameter."""
    steps = joined([driven(CURVE)[0]])
    start = np.array([0.99, 1.01, 0.7, 0.03, 0.0, 0.0, 0.0])
    told = predicted(steps, what, BASE, start)
    for index in range(4):
        more = start.copy()
        more[index] += 1e-6
        slope = (predicted(steps, what, BASE, more).value - told.value) / 1e-6
        assert told.slopes[index] == pytest.approx(slope, rel=0.02)


def test_rides_that_follow_each_other_are_one() -> None:
    spin, _, turned = driven(SPIN)
    straight, end, bent = driven(STRAIGHT)
    parameters = np.array([0.98, 1.01, 1 / 1.5, 0.0, 0.0, 0.0, 0.0])
    steps = joined([spin, straight])
    assert np.all(np.diff(steps.t) > 0)
    assert predicted(steps, "turned", BASE, parameters).value == pytest.approx(
        turned + bent, abs=2e-3
    )
    there = end * cmath.exp(1j * turned)
    assert predicted(steps, "ahead", BASE, parameters).value == pytest.approx(there.real, abs=5e-3)


def test_readings_that_contradict_each_other_are_less_sure() -> None:
    exact, worse = readings(), readings()
    spin, _, turned = driven(SPIN)
    for given, wrong in ((exact, 0.0), (worse, 0.6)):
        given += [Reading((spin,), "turned", turned + side * wrong, 0.01) for side in (1, -1)]
    sure, unsure = (found(given, BASE).covariance[TURN, TURN] for given in (exact, worse))
    assert unsure > 4 * sure


def test_a_robot_that_never_turned_tells_nothing_of_the_track() -> None:
    with pytest.raises(RefusedError, match="hardly turned"):
        found([one for one in readings() if one.what == "distance"], BASE)


def test_a_turn_that_the_wheels_deny_is_refused() -> None:
    given = readings()
    given[0] = Reading(given[0].rides, "turned", -given[0].value, 0.01)
    with pytest.raises(RefusedError, match="to the left"):
        found(given, BASE)
