"""Tests that find the response time and the highest speed of wheels in a log with commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration.calibration_report import keys
from acsard.calibration.log_table import Table
from acsard.calibration.runs import Log, runs
from acsard.calibration.solve import calibrate
from acsard.calibration.wheel_response import WheelResponse, response
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from tests.unit.calibration.robots import (
    GUIDED,
    RADIUS,
    SEPARATION,
    Drive,
    Floats,
    Plan,
    Robot,
    drive,
)

REVERSING: Plan = [(3.0, 0.0, 0.0), *[(4.0, 0.5, 0.0), (4.0, -0.5, 0.0)] * 3, (2.0, 0.0, 0.0)]
"""Commands that reverse at once, without a ramp."""


def followed(plan: Plan, seconds: float, fastest: float = 99.0) -> tuple[Drive, Floats, Floats]:
    """Return a drive whose wheels follow the plan with a lag, and the commands in each line."""
    v, w = (np.repeat([p[i] for p in plan], [round(p[0] * 100) for p in plan]) for i in (1, 2))
    sides = np.zeros((2, len(v)))
    for side, way in zip(sides, (-1.0, 1.0), strict=True):
        command, speed = (v + way * w * SEPARATION / 2) / RADIUS, 0.0
        for at, wanted in enumerate(np.clip(command, -fastest, fastest)):
            speed += (wanted - speed) * 0.01 / seconds
            side[at] = speed
    left, right = sides * RADIUS
    moves = [(0.01, (a + b) / 2, (b - a) / SEPARATION) for a, b in zip(left, right, strict=True)]
    trip = drive(Robot(rng=np.random.default_rng(1), outliers=0.0), moves)
    speeds = [np.round(side[: len(trip.t)], 2) for side in sides]
    return replace(trip, left=speeds[0], right=speeds[1]), v, w


def log(plan: Plan, seconds: float, fastest: float = 99.0) -> Log:
    trip, v, w = followed(plan, seconds, fastest)
    return runs(
        Table.joined(
            [
                {"t": trip.t, "left": trip.left, "right": trip.right, "applied_linear": v,
                 "applied_angular": w},
                {"t": trip.gyro_t, "yaw_rate": trip.gyro},
            ]
        )
    )  # fmt: skip


def measured_response(
    plan: Plan, seconds: float, fastest: float = 99.0, **feedback: float
) -> WheelResponse:
    settings = structs.replace(FeedbackConfig(), **feedback)
    made = response(log(plan, seconds, fastest).runs, DriveConfig(), settings)
    assert made is not None
    return made


@pytest.mark.parametrize("seconds", [0.05, 0.2, 0.9])
def test_the_response_time_is_found(seconds: float) -> None:
    made = measured_response(GUIDED, seconds)
    assert made.seconds == pytest.approx(seconds, rel=0.15, abs=0.012)
    assert made.fastest == np.inf


def test_a_response_time_that_is_longer_than_the_configured_one_is_proposed() -> None:
    made = measured_response(REVERSING, 2.0)
    assert made.settings() == {"response_time": pytest.approx(2.0, rel=0.1)}
    assert "the configured feedback.response_time = 0.2 s is too short" in made.sentences()[0]
    proposed = made.settings()["response_time"]
    again = measured_response(REVERSING, 2.0, response_time=proposed)
    assert again.settings() == {}
    assert f"feedback.response_time = {proposed:g} s is long enough" in again.sentences()[0]


def test_wheels_that_stay_below_their_commands_show_their_highest_speed() -> None:
    made = measured_response(GUIDED, 0.1, 6.0)
    assert made.fastest == pytest.approx(6.0, rel=0.02)
    assert made.seconds == pytest.approx(0.1, rel=0.3)
    assert "write limits.wheel_speed = 6" in made.sentences()[1]


def test_commands_of_another_drive_show_nothing() -> None:
    (run,) = log(GUIDED, 0.1).runs
    other = log([(s, -v, -w) for s, v, w in GUIDED], 0.1).runs[0]
    mixed = structs.replace(run, linear=other.linear, angular=other.angular)
    assert response([mixed], DriveConfig(), FeedbackConfig()) is None


@pytest.mark.slow
def test_the_calibration_writes_a_response_time_that_is_needed() -> None:
    made = calibrate(log([*GUIDED, *REVERSING], 2.0), DriveConfig())
    assert keys(made)["feedback.response_time"] > 1.0  # type: ignore[operator]
    assert any("would report a wheel fault" in note for note in made.notes)
    sound = calibrate(log(GUIDED, 0.2), DriveConfig())
    assert "feedback.response_time" not in keys(sound)
