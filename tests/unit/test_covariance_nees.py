"""NEES of the published covariance over many robots whose wheels have the configured errors.

It is 3 if the covariance is right, and its bound is 2.7 to 4.5. `-m soak -s` prints all figures.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from acsard.core.link.feedback import Line
from acsard.core.values import WheelSpeeds
from tests.unit.nees import (
    AT,
    DEFAULT,
    PERIOD,
    REGION,
    SCENARIOS,
    WHEELS,
    Array,
    Heard,
    fold,
    plain,
    random,
    reports,
    study,
)

CALIBRATED = {"ratio_std": 0.0028, "track_std": 0.01, "scale_std": 0.002}
MODELS = {
    "wheels": WHEELS,
    "default": DEFAULT,
    "wheels, parameters": replace(WHEELS, **CALIBRATED),
    "default, parameters": replace(DEFAULT, **CALIBRATED),
}


def check(values: Array, name: str, low: float = 0.90) -> None:
    inside = float((values < REGION).mean())
    print(f"{name}: NEES {values.mean():.2f}, 95 % region holds {100 * inside:.1f} %")
    assert 2.7 < values.mean() < 4.5
    assert inside >= low


def drive_of(scenario: str, model: str, runs: int) -> Array:
    chosen = MODELS[model]
    if scenario == "straight" and chosen.ratio_std:
        # A ratio that is wrong by 0.28 % gives 0.57 rad at the end of 60 m, which the second order
        # does not describe.
        chosen = replace(chosen, ratio_std=0.0014)
    return study(
        SCENARIOS[scenario], chosen, runs, drives=runs // 100 if scenario == "random" else 1
    )


@pytest.mark.parametrize("scenario", [pytest.param("random", marks=pytest.mark.slow), "straight"])
def test_the_covariance_of_a_sample_of_robots_matches_their_pose_errors(scenario: str) -> None:
    """`-m soak` has 2,000 robots for each drive and model."""
    check(drive_of(scenario, "wheels, parameters", 500), scenario, 0.88)


@pytest.mark.soak
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_covariance_matches_the_pose_errors(scenario: str, model: str) -> None:
    values = drive_of(scenario, model, 2000)
    check(values, f"{scenario}, {model}", 0.89)


# encoders


def counting(counts: int) -> Heard:
    """Return a function that makes lines with the whole counts of wheel counters.

    Each counter starts at a random fraction of a count.
    """

    def lines_of(drive: Array, rng: np.random.Generator) -> list[Line]:
        wheels = drive[:, [1, 0, 0, 1]] * PERIOD / math.tau * counts
        counted = np.floor(np.cumsum(wheels, axis=0) + rng.random(4))
        turned = np.diff(counted, axis=0, prepend=counted[:1]) * math.tau / counts
        rows = zip(drive.tolist(), turned.tolist(), strict=True)
        return [
            Line(AT, WheelSpeeds(r, le, le, r), PERIOD, turned=tuple(row)) for (le, r), row in rows
        ]

    return lines_of


DRIVES = SCENARIOS | {"minute": lambda rng: random(rng, 60.0)}


@pytest.mark.soak
@pytest.mark.parametrize("counts", [20, 96, 400, 3200])
@pytest.mark.parametrize("scenario", ["square", "minute", "circle"])
def test_the_covariance_matches_the_errors_of_coarse_encoders(scenario: str, counts: int) -> None:
    values = study(
        DRIVES[scenario], DEFAULT, 1000, drives=40, heard=counting(counts), counts=counts
    )
    check(values, f"{scenario}, {counts} counts")


@pytest.mark.parametrize("counts", [400, 3200])
def test_the_encoder_counts_of_a_straight_add_no_yaw_variance(counts: int) -> None:
    rng = np.random.default_rng(1)
    drive = reports([(0.5, 0.0, 20.0)])
    _, by_counts = fold(counting(counts)(drive, rng), DEFAULT, counts)
    _, exact = fold(plain(drive), DEFAULT)
    assert by_counts[2, 2] == pytest.approx(exact[2, 2], rel=0.05)
