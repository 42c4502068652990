"""The time of a gyro's samples, and samples that are late, missing or wrong."""

from __future__ import annotations

import math

import pytest

from acsard.core.motion.gyro import SILENCE_TIMEOUT_NS
from acsard.core.values import NS_PER_S, GyroSample
from tests.each import each
from tests.unit.test_gyro import CLAIMS, DT, LINE_NS, MS, Bench


@each("rate", [0.5, -2.0])
def test_the_gyro_gives_the_turn_of_a_gap_in_the_feedback(rate: float) -> None:
    bench = Bench().run(1.0, rate)
    for _ in range(30):
        bench.now_ns += LINE_NS
        bench.true += rate * DT
        bench.sample()
    bench.gyro.add_samples(bench.arrived())
    turn = bench.gyro.turn(bench.now_ns, 0.0, 0.0, 0.0, False, CLAIMS)
    assert turn is not None
    assert turn.angle == pytest.approx(0.3 * rate, abs=1e-6)


def test_stamps_remove_the_jitter_of_the_transmission_and_one_wrong_stamp_spoils_nothing() -> None:
    bench, worst = Bench(stamped=True), 0.0
    for n in range(300):
        bench.late_ns = (n * 7 % 5) * 4 * MS if n % 9 else 0
        before = bench.told
        bench.run(DT, 1.0)
        worst = max(worst, abs(bench.told - before - DT) if n > 50 else 0.0)
    assert worst < 2e-3
    bench.gyro.add_samples((GyroSample(bench.now_ns + MS, 5, 0.5),))
    bench.run(2.0, 0.5)
    assert bench.off < 0.02 * bench.true


@each("back_ms", [150, 210, 230, 290, 400])
def test_a_turn_that_was_assumed_during_a_silence_is_not_counted_twice(back_ms: int) -> None:
    for rate in (1.0, -2.0):
        bench = Bench(stamped=True).run(1.0, rate)
        bench.held_back_ns = bench.now_ns + back_ms * MS
        bench.run(2.0, rate)
        assert bench.says == "used"
        assert bench.off < 0.01 * abs(rate)


def test_a_late_gyro_is_not_silent() -> None:
    bench = Bench(late_ms=150, sample_ms=100)
    for _ in range(5):
        bench.run(math.tau, lambda t: 0.6 * math.sin(t)).run(1.0)
    bench.does.clear()
    none, error = bench.none, bench.told - bench.true
    bench.run(5.0, 0.5).run(1.0)
    assert (bench.none, "silent" in bench.does) == (none, False)
    assert bench.told - bench.true == pytest.approx(error, abs=0.03)


def test_the_last_rate_continues_for_a_moment_and_then_the_wheels_give_the_turn_since() -> None:
    bench = Bench(noise=0.002).run(3.0, 1.0)
    bench.zero()
    bench.silent = True
    bench.run(SILENCE_TIMEOUT_NS / NS_PER_S - DT, 1.0)
    assert bench.says == "used"
    assert bench.off < 0.01
    bench.run(0.1, lambda t: 1.0 - 10.0 * t).run(0.4, still=False)
    assert bench.does[-1] == "silent"
    assert bench.off < 0.02


@each("missing_ms", [100, 150, 190, 250])
@each(("before", "after"), [(2.0, -2.0), (2.0, 0.0), (0.0, 2.0)])
@each("stamped", [False, True])
def test_the_variance_contains_the_turn_while_samples_are_missing(
    missing_ms: int, before: float, after: float, stamped: bool
) -> None:
    bench = Bench(noise=0.002, stamped=stamped).run(1.0, 1.0).run(0.5, before)
    bench.zero()
    bench.silent = True
    seconds = missing_ms / 1000
    bench.run(seconds, lambda t: before + (after - before) * t / seconds)
    bench.silent = False
    bench.run(0.5, after)
    assert bench.off < 0.02 + 2.0 * math.sqrt(bench.variance)


def test_a_clock_that_was_set_back_in_a_silence_is_believed_after_a_second() -> None:
    bench = Bench(stamped=True).run(3.0, 1.0)
    bench.silent = True
    bench.run(1.0, 1.0)
    bench.silent = False
    bench.clock_ns -= 900 * MS
    bench.run(2.0, 1.0)
    assert bench.does[-2:] == ["silent", "used"]
    assert bench.off < 0.03


# wrong samples


@each("missing_ms", [0, 50, 150, 170, 500])
@each("wrong", [[34.9], [-49.9], [3.0], [30.0, -20.0]])
def test_wrong_samples_do_not_turn_the_robot(missing_ms: int, wrong: list[float]) -> None:
    for rate in (0.0, 0.5):
        bench, left = Bench().proved().run(0.5, rate), list(wrong)
        bench.silent = True
        bench.run(missing_ms / 1000, rate)
        bench.silent = False
        bench.distort = lambda true, left=left: left.pop(0) if left else true  # type: ignore[misc]
        limit = 0.01 if len(wrong) == 1 else 0.2
        assert max(bench.run(DT, rate).off for _ in range(60)) < limit
        assert bench.says == "used"


@each("rates", [[2.5] * 2, [8.0] * 3, [-30.0] * 3, [-30.0] * 30, [6.0, 4.0, 2.5, 1.5, 0.8]])
def test_a_person_who_turns_the_robot_with_a_jerk_is_followed(rates: list[float]) -> None:
    bench = Bench().proved()
    for rate in rates:
        bench.run(DT, rate, skid=0.0, still=True)
    assert bench.run(0.1).told == pytest.approx(DT * sum(rates))
