"""The gyro's bias is its mean rate at rest. A new mean gets more weight if the last one is old."""

from __future__ import annotations

import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.gyro_bias import BIAS_RANDOM_WALK, LEARNING_TIME_S, MAX_BIAS, Bias
from tests.noise import gauss

DT = 0.01


def rested(seconds: float, bias: float = 0.01, noise: float = 0.0, seed: int = 1) -> Bias:
    learned = Bias()
    for n in range(round(seconds / DT)):
        learned.drift(DT)
        assert learned.update_at_rest(bias + noise * gauss(seed, n), 0.0, DT)
    return learned


@given(st.floats(-0.9 * MAX_BIAS, 0.9 * MAX_BIAS))
def test_the_bias_of_a_gyro_without_noise_is_exact_after_the_shortest_rest(bias: float) -> None:
    learned = rested(LEARNING_TIME_S + DT, bias)
    assert learned.is_known
    assert learned.value == pytest.approx(bias, abs=1e-6)


def test_the_bias_is_unknown_until_the_robot_has_rested_long_enough() -> None:
    assert not rested(LEARNING_TIME_S - DT).is_known


def test_the_error_of_the_bias_is_that_of_a_mean_and_matches_the_variance() -> None:
    noise, seconds = 0.01, 1.0
    runs = [rested(seconds, noise=noise, seed=seed) for seed in range(200)]
    spread = statistics.pstdev([run.value for run in runs])
    assert spread == pytest.approx(noise / math.sqrt(seconds / DT), rel=0.35)
    claimed = statistics.fmean(math.sqrt(run.variance) for run in runs)
    assert claimed == pytest.approx(spread, rel=0.35)


def test_the_noise_of_a_sample_is_learned() -> None:
    assert math.sqrt(rested(5.0, noise=0.02).noise) == pytest.approx(0.02, rel=0.35)


def test_the_variance_of_the_bias_grows_by_its_random_walk_while_the_robot_drives() -> None:
    learned = rested(2.0, noise=0.01)
    before = learned.variance
    for _ in range(1000):
        learned.drift(0.1)
    assert learned.variance - before == pytest.approx(BIAS_RANDOM_WALK**2 * 100)


def test_a_bias_that_has_walked_is_found_again() -> None:
    learned = rested(2.0, bias=0.01, noise=0.005)
    learned.drift(3600.0)
    for n in range(100):
        assert learned.update_at_rest(0.016 + 0.005 * gauss(9, n), 0.0, DT)
    assert learned.value == pytest.approx(0.016, abs=0.0015)


def test_a_fast_turn_while_the_wheels_stand_does_not_change_the_bias() -> None:
    learned = rested(2.0, noise=0.005)
    before = learned.value
    assert not learned.update_at_rest(0.3, 0.0, DT)
    assert learned.value == before


@pytest.mark.parametrize("rate", [1.1 * MAX_BIAS, -3.0])
def test_a_rate_above_the_largest_bias_is_not_taken_as_the_first_bias(rate: float) -> None:
    learned = Bias()
    assert not learned.update_at_rest(rate, 0.0, DT)
    assert (learned.value, learned.is_known) == (0.0, False)


def test_the_noise_that_a_gyro_claims_reduces_the_weight_of_its_samples() -> None:
    claiming, silent = rested(2.0), rested(2.0)
    for learned, claim in ((claiming, 0.05**2), (silent, 0.0)):
        learned.drift(1000.0)
        assert learned.update_at_rest(0.012, claim, DT)
    assert silent.value == pytest.approx(0.012, abs=1e-4)
    assert claiming.value == pytest.approx(0.01, abs=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("jump", [0.03, 0.1, -0.15])
def test_a_bias_that_has_jumped_is_learned_again_at_rest(jump: float, noise: float) -> None:
    learned, off = rested(10.0, noise=noise), 0.0
    for n in range(6000):
        learned.drift(DT)
        rate = 0.01 + jump + noise * gauss(2, n)
        if not learned.update_at_rest(rate, 0.0, DT):
            off += (rate - learned.value) * DT
    assert learned.value == pytest.approx(0.01 + jump, abs=0.002)
    assert abs(off) < 1.2 * abs(jump)  # the error of one second, not of the whole minute


def test_swinging_to_and_fro_while_the_wheels_stand_does_not_change_the_bias() -> None:
    learned = rested(10.0)
    for n in range(300):
        learned.update_at_rest(0.01 + 0.15 * math.sin(n * DT), 0.0, DT)
    assert learned.value == pytest.approx(0.01, abs=2e-3)
