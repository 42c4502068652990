"""Tests of the turn in each feedback line, which comes from the gyro if it has good samples."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.motion.gyro import SILENCE_TIMEOUT_NS, STATUS_TEXTS, Gyro, Turn, claims
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S, GyroDoes, GyroSample
from tests.noise import gauss

MS = 1_000_000
LINE_NS = 10 * MS
DT = 0.01

CLAIMS = claims(OdometryConfig(), Kinematics(DriveConfig()), 3200)

Rate = Callable[[float], float]
REST_FIRST = 1.0
"""Time after which the bias is known, s."""


class Bench:
    """A robot that rests for a second and then turns as commanded.

    Its wheels report `skid` times the true turn.
    """

    def __init__(
        self,
        *,
        bias: float = 0.0,
        noise: float = 0.0,
        skid: float = 1.0,
        sample_ms: int = 10,
        late_ms: int = 0,
        stamped: bool = False,
        sign: float = 1.0,
        first: int = 0,
    ) -> None:
        """`first` is the index of the first noise value."""
        self.clock_ns = 10**18
        """By how much the clock of the stamps is ahead."""
        self.gyro = Gyro()
        self.now_ns = 7 * NS_PER_S
        self.bias, self.noise, self.skid, self.sign = bias, noise, skid, sign
        self.sample_ns, self.late_ns, self.stamped = sample_ms * MS, late_ms * MS, stamped
        self.true = self.told = self.variance = self.doubt = 0.0
        self.none = 0
        self.silent = False
        self.does: list[GyroDoes] = []
        self.other = False
        """Whether the next sample is the first one of another sender."""
        self.distort: Rate = lambda rate: rate
        """What the gyro reports instead of the given rate."""
        self._sampled_ns, self._sampled = self.now_ns, 0.0
        self._samples = first
        self._way: list[GyroSample] = []
        self.held_back_ns = 0
        """Time before which no sample arrives; the waiting samples then arrive together."""
        self.per_line: int | None = None
        """Number of samples that the network delivers in each line, or None for all."""
        self._backlog: list[GyroSample] = []

    def run(
        self,
        seconds: float,
        rate: float | Rate = 0.0,
        skid: float | None = None,
        still: bool | None = None,
    ) -> None:
        begun = self.now_ns
        for _ in range(round(seconds / DT)):
            t = (self.now_ns - begun) / NS_PER_S
            now = rate(t) if callable(rate) else rate
            for _ in range(10):
                self.now_ns += LINE_NS // 10
                self.true += now * DT / 10
                self._sample()
            samples: tuple[GyroSample, ...] = ()
            if self.now_ns > self.held_back_ns:
                samples = tuple(sample for sample in self._way if sample.at_ns <= self.now_ns)
                samples = tuple(
                    replace(sample, at_ns=max(sample.at_ns, self.held_back_ns))
                    for sample in samples
                )
                self._way = [sample for sample in self._way if sample.at_ns > self.now_ns]
            if self.per_line is not None:
                self._backlog += samples
                samples = tuple(
                    replace(sample, at_ns=self.now_ns) for sample in self._backlog[: self.per_line]
                )
                self._backlog = self._backlog[self.per_line :]
            self.gyro.add_samples(samples)
            wheels = now * (self.skid if skid is None else skid) * DT
            stands = now == 0.0 if still is None else still
            turn = self.gyro.turn(self.now_ns, DT, wheels, 0.0, stands, CLAIMS)
            self.told += wheels if turn is None else turn.angle
            self.variance += 0.0 if turn is None else turn.variance
            self.doubt += 0.0 if turn is None else turn.doubt
            self.none += turn is None
            event = self.gyro.event()
            if event is not None:
                self.does.append(event.kind)  # type: ignore[arg-type]

    def _sample(self) -> None:
        span_ns = self.now_ns - self._sampled_ns
        if span_ns < self.sample_ns:
            return
        mean = (self.true - self._sampled) * NS_PER_S / span_ns
        rate = self.distort(self.sign * mean + self.bias + self.noise * gauss(3, self._samples))
        at_ns = self.now_ns + self.late_ns
        stamp_ns = self.now_ns + self.clock_ns if self.stamped else None
        if not self.silent:
            self._way.append(GyroSample(at_ns, stamp_ns, rate, anew=self.other))
            self.other = False
        self._sampled_ns, self._sampled, self._samples = self.now_ns, self.true, self._samples + 1

    def says(self) -> GyroDoes:
        return self.gyro.status.does


def stirring(t: float) -> float:
    return 0.8 * math.sin(1.3 * t) + 0.5 * math.sin(3.1 * t + 1.0) + 1e-3


def over_a_gap(bench: Bench, seconds: float, rate: float, still: bool = False) -> Turn | None:
    """Turn for this time without a line. Return the turn of a next line that covers no time."""
    for _ in range(round(seconds / DT)):
        bench.now_ns += LINE_NS
        bench.true += rate * DT
        bench._sample()
    bench.gyro.add_samples(tuple(bench._way))
    bench._way = []
    return bench.gyro.turn(bench.now_ns, 0.0, 0.0, 0.0, still, CLAIMS)


# a gyro in use


@pytest.mark.slow
def test_a_robot_at_rest_does_not_turn_whatever_the_bias_and_noise_of_its_gyro() -> None:
    bench = Bench(bias=-0.03, noise=0.01)
    bench.run(REST_FIRST)
    bench.told = 0.0
    bench.run(600.0)
    assert bench.told == 0.0
    assert bench.gyro.status.bias == pytest.approx(-0.03, abs=0.002)


def test_the_gyro_gives_the_turn_of_a_gap_in_the_feedback() -> None:
    bench = Bench()
    bench.run(REST_FIRST)
    bench.run(1.0, 0.5)
    turn = over_a_gap(bench, 0.3, 0.5)
    assert turn is not None
    assert turn.angle == pytest.approx(0.15, abs=1e-6)


# delay and stamps


def test_stamps_remove_the_jitter_of_the_transmission() -> None:
    bench, worst = Bench(stamped=True), 0.0
    bench.run(REST_FIRST)
    for n in range(500):
        bench.late_ns = (n * 7 % 5) * 4 * MS if n % 9 else 0
        before = bench.told
        bench.run(DT, 1.0)
        if n > 50:
            worst = max(worst, abs(bench.told - before - DT))
    assert worst < 2e-3


def test_a_sample_with_a_wrong_stamp_does_not_spoil_the_turn() -> None:
    bench = Bench(stamped=True)
    bench.run(REST_FIRST)
    bench.run(1.0, 0.5)
    early = GyroSample(bench.now_ns + MS, 5, 0.5)
    bench.gyro.add_samples((early,))
    bench.run(2.0, 0.5)
    assert bench.told == pytest.approx(bench.true, rel=0.02)


@pytest.mark.parametrize("set_ms", [-15, -175, -240, 175])
def test_an_adjustment_of_the_stamp_clock_makes_no_wrong_turn(set_ms: int) -> None:
    bench, worst = Bench(stamped=True), 0.0
    bench.run(REST_FIRST)
    bench.run(2.0)
    bench.clock_ns += set_ms * MS
    for n in range(300):
        bench.run(DT, n / 100)
        worst = max(worst, abs(bench.told - bench.true))
    # 3 rad/s over a line and a sample is 0.06 rad.
    assert worst < 0.07


# silence, slip, contradictions


@pytest.mark.parametrize("back_ms", [150, 210, 230, 290, 400])
@pytest.mark.parametrize("rate", [1.0, -2.0])
def test_a_turn_that_was_assumed_during_a_silence_is_not_counted_twice(
    back_ms: int, rate: float
) -> None:
    bench = Bench(stamped=True, skid=1.0)
    bench.run(REST_FIRST)
    bench.run(1.0, rate)
    bench.held_back_ns = bench.now_ns + back_ms * MS
    bench.run(2.0, rate)
    assert bench.says() == "used"
    assert bench.told == pytest.approx(bench.true, abs=0.01 * abs(rate))


def test_a_late_gyro_is_not_silent() -> None:
    bench = Bench(late_ms=150, sample_ms=100)
    bench.run(REST_FIRST)
    for _ in range(5):
        bench.run(math.tau, lambda t: 0.6 * math.sin(t))
        bench.run(1.0)
    bench.does.clear()
    none, begun, true = bench.none, bench.told, bench.true
    bench.run(5.0, 0.5)
    bench.run(1.0)
    assert bench.none == none
    assert "silent" not in bench.does
    assert bench.told - begun == pytest.approx(bench.true - true, abs=0.03)


def test_the_last_turn_rate_continues_for_a_moment_without_samples() -> None:
    bench = Bench()
    bench.run(REST_FIRST)
    bench.run(1.0, 0.5)
    bench.silent = True
    bench.run(SILENCE_TIMEOUT_NS / NS_PER_S - DT, 0.5)
    assert bench.says() == "used"
    assert bench.told == pytest.approx(bench.true, abs=1e-6)


@pytest.mark.parametrize("missing_ms", [100, 150, 190, 250])
@pytest.mark.parametrize(("before", "after"), [(2.0, -2.0), (2.0, 0.0), (0.0, 2.0)])
@pytest.mark.parametrize("stamped", [False, True])
def test_the_variance_contains_the_turn_while_samples_are_missing(
    missing_ms: int, before: float, after: float, stamped: bool
) -> None:
    bench = Bench(skid=1.0, noise=0.002, stamped=stamped)
    bench.run(REST_FIRST)
    bench.run(3.0, 1.0)
    bench.run(1.0, before)
    bench.told = bench.true = bench.variance = 0.0
    bench.silent = True
    seconds = missing_ms / 1000
    bench.run(seconds, lambda t: before + (after - before) * t / seconds)
    bench.silent = False
    bench.run(1.0, after)
    assert abs(bench.told - bench.true) < 0.02 + 2.0 * math.sqrt(bench.variance)


def test_the_wheels_also_give_the_turn_since_the_last_sample_of_a_gyro_that_falls_silent() -> None:
    bench = Bench(skid=1.0, noise=0.002)
    bench.run(REST_FIRST)
    bench.run(3.0, 1.0)
    bench.told = bench.true = 0.0
    bench.silent = True
    bench.run(0.1, lambda t: 1.0 - 10.0 * t)
    bench.run(0.4, still=False)
    assert bench.says() == "silent"
    assert bench.told == pytest.approx(bench.true, abs=0.02)


@pytest.mark.parametrize("held_s", [0.4, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("per_line", [2, 3, 10])
def test_a_backlog_of_samples_does_not_turn_a_robot_that_stands(
    held_s: float, per_line: int
) -> None:
    bench = Bench(skid=1.0, noise=0.002, stamped=True)
    bench.run(REST_FIRST)
    bench.run(3.0, 1.0)
    bench.told = bench.true = 0.0
    bench.per_line = 0
    bench.run(held_s - 0.3, 2.0)
    bench.run(0.3, lambda t: 2.0 - t / 0.15)
    bench.per_line = per_line
    bench.run(1.0 + held_s / (per_line - 1))
    assert bench.told == pytest.approx(bench.true, abs=0.03)
    assert bench.says() == "used"
    bench.run(2.0, 0.5)
    assert bench.told == pytest.approx(bench.true, abs=0.03)


@pytest.mark.parametrize("jitter_ms", [0, 60])
def test_a_clock_that_was_set_back_in_a_silence_is_believed_after_a_second(jitter_ms: int) -> None:
    bench = Bench(skid=1.0, stamped=True)
    bench.run(REST_FIRST)
    bench.run(3.0, 1.0)
    bench.silent = True
    bench.run(1.0, 1.0)
    bench.silent = False
    bench.clock_ns -= 900 * MS
    chance = random.Random(1)
    for _ in range(20):
        bench.held_back_ns = bench.now_ns + chance.randrange(0, jitter_ms + 1) * MS
        bench.run(0.1, 1.0)
    assert bench.says() == "used"
    assert bench.does[-2:] == ["silent", "used"]
    assert bench.told == pytest.approx(bench.true, abs=0.03)


def test_a_gyro_that_is_mounted_upside_down_is_not_believed() -> None:
    bench = Bench(sign=-1.0)
    bench.run(REST_FIRST)
    bench.run(20.0, stirring)
    assert bench.says() == "reversed"
    none = bench.none
    bench.run(5.0, stirring)
    assert bench.none - none == 500


# wrong samples


def proved(noise: float = 0.0, sample_ms: int = 10) -> Bench:
    """Return a robot without slip whose gyro has proved itself. The robot stands still."""
    bench = Bench(skid=1.0, noise=noise, sample_ms=sample_ms)
    bench.run(REST_FIRST)
    for rate in (1.0, -1.0):
        bench.run(2.0, rate)
    bench.run(2.0)
    assert bench.says() == "used"
    bench.told = bench.true = bench.variance = 0.0
    return bench


def spoiled(bench: Bench, values: list[float]) -> None:
    """Let the gyro report these rates, rad/s, and then the true ones again."""
    left = list(values)
    bench.distort = lambda rate: left.pop(0) if left else rate


@pytest.mark.parametrize("missing_ms", [0, 50, 150, 170, 500])
@pytest.mark.parametrize("wrong", [34.9, -49.9, 3.0])
@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_one_wrong_sample_does_not_turn_the_robot(
    missing_ms: int, wrong: float, rate: float
) -> None:
    bench = proved()
    bench.run(0.5, rate)
    bench.silent = True
    bench.run(missing_ms / 1000, rate)
    bench.silent = False
    spoiled(bench, [wrong])
    off = []
    for _ in range(100):
        bench.run(DT, rate)
        off.append(abs(bench.told - bench.true))
    assert max(off) < 0.01
    assert bench.says() == "used"


def test_two_wrong_samples_that_contradict_each_other_do_not_turn_the_robot() -> None:
    bench = proved()
    spoiled(bench, [30.0, -20.0])
    bench.run(1.0)
    assert bench.told == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("fast", [2.5, 8.0, -30.0])
@pytest.mark.parametrize("lines", [2, 3, 30])
def test_a_person_who_turns_the_robot_with_a_jerk_is_followed(fast: float, lines: int) -> None:
    bench = proved()
    bench.run(lines * DT, fast, skid=0.0, still=True)
    bench.run(0.1)
    assert bench.told == pytest.approx(lines * DT * fast)


def test_a_bump_that_dies_out_quickly_is_followed() -> None:
    bench = proved()
    for rate in (6.0, 4.0, 2.5, 1.5, 0.8):
        bench.run(DT, rate, skid=0.0, still=True)
    bench.run(0.1)
    assert bench.told == pytest.approx(0.148)


# a gyro that repeats its last rate, or contradicts the wheels for long


def frozen(bench: Bench) -> None:
    """Let the gyro report one value from now on."""
    rates: list[float] = []

    def repeated(rate: float) -> float:
        rates.append(rate)
        return rates[0]

    bench.distort = repeated


def test_a_gyro_that_hangs_is_replaced_by_the_wheels_since_its_first_repetition() -> None:
    bench = proved(noise=0.004)
    bench.run(1.0, 0.5)
    frozen(bench)
    bench.run(0.45, -0.5)
    assert bench.says() == "used"
    bench.run(0.1, -0.5)
    assert bench.says() == "hangs"
    assert bench.told == pytest.approx(bench.true, abs=0.02)
    bench.run(3.0, -0.5)
    assert bench.told == pytest.approx(bench.true, abs=0.02)
    bench.distort = lambda rate: rate
    bench.run(1.0, 0.5)
    assert bench.says() == "used"
    assert bench.told == pytest.approx(bench.true, abs=0.02)


def test_a_gyro_without_noise_may_repeat_its_rate_on_a_straight_and_in_an_even_turn() -> None:
    bench = proved()
    bench.run(20.0, 0.0, still=False)
    bench.run(20.0, 0.7)
    assert bench.does == ["waiting for rest", "waiting for turn"]
    assert bench.told == pytest.approx(bench.true, abs=0.01)


@pytest.mark.parametrize("sample_ms", [10, 20, 100])
def test_a_coarse_gyro_that_repeats_half_of_its_samples_does_not_hang(sample_ms: int) -> None:
    bench = Bench(noise=0.002, sample_ms=sample_ms)
    bench.distort = lambda rate: round(rate / 0.004) * 0.004
    bench.run(2.0)
    for _ in range(10):
        bench.run(3.0, 0.5)
        bench.run(10.0, 0.0, still=False)
    assert "hangs" not in bench.does


def test_a_rate_that_is_repeated_at_rest_is_no_turn() -> None:
    bench = proved()
    bench.distort = lambda rate: 0.5
    bench.run(2.0)
    assert bench.says() == "hangs"
    assert bench.told == pytest.approx(0.0, abs=0.01)


# comparison with the wheels


@pytest.mark.parametrize("skid", [0.5, 2.0])
def test_a_difference_that_nobody_can_decide_is_uncertainty_of_the_gyros_turn(skid: float) -> None:
    bench = proved(noise=0.002)
    bench.run(5.0, 0.5, skid=skid)
    assert bench.says() == "disagrees"
    assert bench.told == pytest.approx(bench.true, abs=0.02)
    assert bench.doubt == pytest.approx((1.0 - skid) * 2.5, rel=0.1)
    bench.run(3.0)
    assert bench.says() == "disagrees"  # at rest they cannot disagree
    bench.run(8.0, 0.5)
    assert bench.says() == "used"


@pytest.mark.parametrize(("step", "seconds"), [(0.05, 4.0), (-0.05, 4.0), (0.03, 8.0)])
def test_a_step_of_the_bias_shows_on_a_straight_and_is_learned_at_rest(
    step: float, seconds: float
) -> None:
    bench = proved(noise=0.004)
    bench.bias += step
    bench.run(seconds, 0.0, still=False)
    assert bench.says() == "disagrees"
    assert abs(bench.told) < 2.0 * abs(bench.doubt)
    bench.run(2.0)
    assert bench.gyro.status.bias == pytest.approx(step, abs=0.003)


@pytest.mark.parametrize("rate", [0.1, 0.001, -0.01])
def test_wheels_that_spin_on_the_spot_are_not_believed(rate: float) -> None:
    bench = proved(noise=0.002)
    bench.run(6.0, rate, skid=1.0 / rate, still=False)
    assert bench.says() == "disagrees"
    assert bench.told == pytest.approx(bench.true, abs=0.03)


@pytest.mark.parametrize(("factor", "does"), [(-1.0, "reversed"), (57.3, "in degrees")])
def test_a_gyro_that_later_reports_another_quantity_must_prove_itself_again(
    factor: float, does: str
) -> None:
    bench = proved(noise=0.002)
    bench.distort = lambda rate: factor * rate
    bench.run(3.0, 0.5)
    assert bench.says() == does
    assert abs(bench.told - bench.true) < 2.0 * abs(bench.doubt)
    bench.distort = lambda rate: rate
    bench.run(1.0, 0.5)
    assert bench.says() == "used"


def test_a_gyro_in_degrees_is_named_even_if_its_bias_never_becomes_known() -> None:
    bench = Bench(bias=0.6, noise=0.2)
    bench.distort = lambda rate: 57.3 * rate
    bench.run(REST_FIRST)
    bench.run(2.0, 0.5)
    assert bench.does == ["waiting for rest", "in degrees"]
    assert bench.told == pytest.approx(bench.true)


def test_another_gyro_must_rest_and_prove_itself() -> None:
    bench = proved(noise=0.002)
    bench.run(1.0, 0.5)
    bench.other, bench.bias = True, 0.1
    bench.run(1.0, 0.5)
    assert bench.says() == "waiting for rest"
    bench.run(1.0)
    assert bench.says() == "waiting for turn"
    bench.run(1.0, 0.5)
    assert bench.says() == "used"
    assert bench.told == pytest.approx(bench.true, abs=0.01)


def test_a_new_pose_ends_the_uncertainty_of_the_turns_before_it() -> None:
    bench = proved(noise=0.002)
    bench.run(0.5, 1.0, skid=0.2)
    bench.gyro.forget_doubt()
    bench.doubt = 0.0
    bench.run(1.0)
    assert abs(bench.doubt) < 0.01


# rest


@pytest.mark.parametrize("count", [0.002, 0.0001])
def test_wheels_that_swing_by_a_count_rest(count: float) -> None:
    gyro, at_ns = Gyro(), 0
    for n in range(100):
        at_ns += LINE_NS
        gyro.add_samples((GyroSample(at_ns, None, 0.01),))
        # 0.4 mm of a side is 0.008 rad of its wheels, four counts of 3200.
        gyro.turn(at_ns, DT, (-1) ** n * count / 3, (-1) ** n * count / 10, True, CLAIMS)
    assert gyro.status.bias == pytest.approx(0.01) if count < 0.001 else gyro.status.bias is None


def test_a_robot_that_is_commanded_or_creeps_does_not_rest() -> None:
    for idle, creep in ((False, 0.0), (True, 2e-5)):
        gyro, at_ns = Gyro(), 0
        for _ in range(300):
            at_ns += LINE_NS
            gyro.add_samples((GyroSample(at_ns, None, 0.01),))
            gyro.turn(at_ns, DT, creep / 0.15, 0.0, idle, CLAIMS)
        assert gyro.status.bias is None


# uncertainty


@pytest.mark.slow
def test_the_variance_of_the_turn_is_that_of_its_errors() -> None:
    """The heading errors, divided by their published standard deviations, are about normal."""
    squares = []
    for seed in range(60):
        bench = Bench(noise=0.02, bias=0.01, first=10_000 * seed)
        bench.run(2.0)
        bench.run(0.5, 0.5)
        bench.run(2.0)
        bench.told = bench.variance = 0.0
        bench.run(10.0, still=False)
        squares.append(bench.told**2 / bench.variance)
    assert 0.5 < sum(squares) / 60 < 2.0


def test_every_state_of_the_gyro_has_a_text() -> None:
    assert set(STATUS_TEXTS) == set(GyroDoes.__args__)  # type: ignore[attr-defined]


def test_the_declared_error_of_the_track_is_a_fraction_of_its_multiplier() -> None:
    odometry = OdometryConfig(gyro_scale_std=0.0, wheel_separation_multiplier_std=0.2)
    kinematics = Kinematics(DriveConfig(wheel_separation_multiplier=2.0))
    assert claims(odometry, kinematics, 3200).scale == pytest.approx(0.1)


def test_a_bias_that_was_wrong_since_the_last_rest_becomes_doubt() -> None:
    """Its step is too small to contradict wheels that turn all the time."""
    bench = proved(noise=0.002)
    bench.bias = 0.03
    for _ in range(10):
        bench.run(2.0, 0.8)
        bench.run(2.0, -0.8)
    assert bench.says() == "used"
    bench.run(2.0)
    assert abs(bench.told - bench.true) == pytest.approx(1.2, abs=0.1)
    assert abs(bench.told - bench.true) < 2.0 * abs(bench.doubt)


def test_the_rate_of_a_gyro_that_disagrees_is_as_uncertain_as_the_difference() -> None:
    bench = proved(noise=0.002)
    bench.run(3.0, 0.1, skid=10.0)
    assert bench.says() == "disagrees"
    turn = bench.gyro.turn(bench.now_ns + LINE_NS, DT, DT, 0.0, False, CLAIMS)
    assert turn is not None
    assert turn.rate_variance == pytest.approx(0.81, rel=0.1)
