"""The turn in each feedback line, which comes from the gyro if it has good samples."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.motion.agreement import claims
from acsard.core.motion.gyro import Gyro
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S, GyroDoes, GyroSample
from tests.each import each
from tests.noise import gauss

MS = 1_000_000
LINE_NS, DT = 10 * MS, 0.01
CLAIMS = claims(OdometryConfig(), Kinematics(DriveConfig()), 3200)
Rate = Callable[[float], float]


class Bench:
    """A robot that rests for a second, which shows the bias, and then turns as commanded.

    Its wheels report `skid` times the true turn.
    """

    def __init__(
        self,
        bias: float = 0.0,
        noise: float = 0.0,
        sample_ms: int = 10,
        late_ms: int = 0,
        stamped: bool = False,
        sign: float = 1.0,
        first: int = 0,  # index of the first noise value
    ) -> None:
        self.gyro = Gyro()
        self.now_ns = 7 * NS_PER_S
        self.clock_ns = 10**18  # by which the clock of the stamps is ahead
        self.bias, self.noise, self.sign = bias, noise, sign
        self.sample_ns, self.late_ns, self.stamped = sample_ms * MS, late_ms * MS, stamped
        self.none, self.does = 0, list[GyroDoes]()
        self.silent = self.other = False  # `other`: the next sample is the first of another sender
        self.distort: Rate = lambda rate: rate  # what the gyro reports instead of the given rate
        self.held_back_ns = 0  # until then no sample arrives; then they come together
        self._samples = first
        self._way: list[GyroSample] = []
        self._sampled_ns, self._sampled = self.now_ns, 0.0
        self.true = 0.0
        self.zero()
        self.run(1.0)

    def zero(self) -> None:
        self._sampled -= self.true
        self.true = self.told = self.variance = self.doubt = 0.0

    def run(
        self, seconds: float, rate: float | Rate = 0.0, skid: float = 1.0, still: bool | None = None
    ) -> Bench:
        begun = self.now_ns
        for _ in range(round(seconds / DT)):
            t = (self.now_ns - begun) / NS_PER_S
            now = rate(t) if callable(rate) else rate
            for _ in range(10):
                self.now_ns += LINE_NS // 10
                self.true += now * DT / 10
                self.sample()
            self.gyro.add_samples(self.arrived())
            wheels = now * skid * DT
            stands = now == 0.0 if still is None else still
            turn = self.gyro.turn(self.now_ns, DT, wheels, 0.0, stands, CLAIMS)
            if turn is None:
                self.told, self.none = self.told + wheels, self.none + 1
            else:
                self.told += turn.angle
                self.variance += turn.variance
                self.doubt += turn.doubt
            if (event := self.gyro.event()) is not None:
                self.does.append(event.kind)  # type: ignore[arg-type]
        return self

    def arrived(self) -> tuple[GyroSample, ...]:
        came, way = [s for s in self._way if s.at_ns <= self.now_ns], self._way
        if self.now_ns <= self.held_back_ns:
            return ()
        self._way = way[len(came) :]
        return tuple(replace(s, at_ns=max(s.at_ns, self.held_back_ns)) for s in came)

    def sample(self) -> None:
        span_ns = self.now_ns - self._sampled_ns
        if span_ns < self.sample_ns:
            return
        mean = (self.true - self._sampled) * NS_PER_S / span_ns
        rate = self.distort(self.sign * mean + self.bias + self.noise * gauss(3, self._samples))
        stamp_ns = self.now_ns + self.clock_ns if self.stamped else None
        if not self.silent:
            sample = GyroSample(self.now_ns + self.late_ns, stamp_ns, rate, anew=self.other)
            self._way.append(sample)
            self.other = False
        self._sampled_ns, self._sampled, self._samples = self.now_ns, self.true, self._samples + 1

    def proved(self) -> Bench:
        """Turn until the gyro is believed, and stand again."""
        self.run(2.0, 1.0).run(2.0, -1.0).run(2.0)
        assert self.says == "used"
        self.zero()
        return self

    def freeze(self) -> Bench:
        """Let the gyro repeat its next value from now on."""
        rates: list[float] = []

        def repeated(rate: float) -> float:
            rates.append(rate)
            return rates[0]

        self.distort = repeated
        return self

    @property
    def says(self) -> GyroDoes:
        return self.gyro.status.does

    @property
    def off(self) -> float:
        return abs(self.told - self.true)


# a gyro that is not believed yet


def stirring(t: float) -> float:
    return 0.8 * math.sin(1.3 * t) + 0.5 * math.sin(3.1 * t + 1.0) + 1e-3


def test_a_gyro_that_is_mounted_upside_down_is_not_believed() -> None:
    bench = Bench(sign=-1.0).run(20.0, stirring)
    assert bench.says == "reversed"
    none = bench.none
    bench.run(5.0, stirring)
    assert bench.none - none == 500


def test_a_gyro_in_degrees_is_named_even_if_its_bias_never_becomes_known() -> None:
    bench = Bench(bias=0.6, noise=20.0)
    bench.noise, bench.distort = 0.2, lambda rate: 57.3 * rate
    bench.run(2.0, 0.5)
    assert bench.does == ["waiting for rest", "in degrees"]
    assert bench.off == pytest.approx(0.0)


def test_another_gyro_must_rest_and_prove_itself() -> None:
    bench = Bench(noise=0.002).proved().run(1.0, 0.5)
    bench.other, bench.bias = True, 0.1
    says = [bench.run(1.0, rate).says for rate in (0.5, 0.0, 0.5)]
    assert says == ["waiting for rest", "waiting for turn", "used"]
    assert bench.off < 0.01


@each(("idle", "creep", "bias"), [(False, 0.0, None), (True, 2e-5, None), (True, 0.0, 0.01)])
@each("swing", [0.0, 0.0001, 0.002])
def test_the_bias_is_learned_while_the_wheels_rest_but_for_a_count(
    idle: bool, creep: float, bias: float | None, swing: float
) -> None:
    gyro, at_ns = Gyro(), 0
    for n in range(300):
        at_ns += LINE_NS
        gyro.add_samples((GyroSample(at_ns, None, 0.01),))
        # 0.4 mm of a side is 0.008 rad of its wheels, four counts of 3200.
        turn, way = (-1) ** n * swing / 3 + creep / 0.15, (-1) ** n * swing / 10
        gyro.turn(at_ns, DT, turn, way, idle, CLAIMS)
    rests = bias if swing < 0.001 else None
    assert gyro.status.bias == (None if rests is None else pytest.approx(rests))


# a gyro that hangs


def test_a_gyro_that_hangs_is_replaced_by_the_wheels_since_its_first_repetition() -> None:
    bench = Bench(noise=0.004).proved().run(1.0, 0.5).freeze().run(0.45, -0.5)
    assert bench.says == "used"
    assert bench.run(0.1, -0.5).says == "hangs"
    assert bench.off < 0.02
    assert bench.run(3.0, -0.5).off < 0.02
    bench.distort = lambda rate: rate
    assert bench.run(1.0, 0.5).says == "used"
    assert bench.off < 0.02
    still = Bench().proved()
    still.distort = lambda rate: 0.5
    assert still.run(2.0).says == "hangs"
    assert still.off < 0.01


def test_a_gyro_without_noise_or_with_coarse_steps_may_repeat_its_rate() -> None:
    bench = Bench().proved().run(20.0, 0.0, still=False).run(20.0, 0.7)
    assert bench.does == ["waiting for rest", "waiting for turn"]
    assert bench.off < 0.01
    for sample_ms in (10, 20, 100):
        bench = Bench(noise=0.002, sample_ms=sample_ms)
        bench.distort = lambda rate: round(rate / 0.004) * 0.004
        for _ in range(5):
            bench.run(2.0).run(3.0, 0.5).run(10.0, 0.0, still=False)
        assert "hangs" not in bench.does


# comparison with the wheels


@each("skid", [0.5, 2.0])
def test_a_difference_that_nobody_can_decide_is_uncertainty_of_the_gyros_turn(skid: float) -> None:
    bench = Bench(noise=0.002).proved().run(5.0, 0.5, skid)
    assert bench.says == "disagrees"
    assert bench.off < 0.02
    assert bench.doubt == pytest.approx((1.0 - skid) * 2.5, rel=0.1)
    assert bench.run(3.0).says == "disagrees"  # at rest they cannot disagree
    assert bench.run(8.0, 0.5).says == "used"
    turn = bench.run(3.0, 0.1, 10.0).gyro.turn(bench.now_ns + LINE_NS, DT, DT, 0.0, False, CLAIMS)
    assert turn is not None
    assert turn.rate_variance == pytest.approx(0.81, rel=0.1)


@each(("step", "seconds"), [(0.05, 4.0), (-0.05, 4.0), (0.03, 8.0)])
def test_a_step_of_the_bias_shows_on_a_straight_and_is_learned_at_rest(
    step: float, seconds: float
) -> None:
    bench = Bench(noise=0.004).proved()
    bench.bias += step
    assert bench.run(seconds, 0.0, still=False).says == "disagrees"
    assert abs(bench.told) < 2.0 * abs(bench.doubt)
    assert bench.run(2.0).gyro.status.bias == pytest.approx(step, abs=0.003)


@each("rate", [0.1, 0.001, -0.01])
def test_wheels_that_spin_on_the_spot_are_not_believed(rate: float) -> None:
    bench = Bench(noise=0.002).proved().run(6.0, rate, 1.0 / rate, still=False)
    assert bench.says == "disagrees"
    assert bench.off < 0.03


@each(("factor", "does"), [(-1.0, "reversed"), (57.3, "in degrees")])
def test_a_gyro_that_reports_another_quantity_must_prove_itself(factor: float, does: str) -> None:
    bench = Bench(noise=0.002).proved()
    bench.distort = lambda rate: factor * rate
    assert bench.run(3.0, 0.5).says == does
    assert bench.off < 2.0 * abs(bench.doubt)
    bench.distort = lambda rate: rate
    assert bench.run(1.0, 0.5).says == "used"


def test_a_new_pose_ends_the_uncertainty_of_the_turns_before_it() -> None:
    bench = Bench(noise=0.002).proved().run(0.5, 1.0, 0.2)
    bench.gyro.forget_doubt()
    bench.doubt = 0.0
    assert abs(bench.run(1.0).doubt) < 0.01


# uncertainty


@settings(max_examples=20)
@given(bias=st.floats(-0.05, 0.05), noise=st.floats(0.0, 0.01))
def test_a_robot_at_rest_does_not_turn_whatever_bias_and_noise(bias: float, noise: float) -> None:
    bench = Bench(bias, noise)
    assert bench.run(3.0).told == 0.0
    assert bench.gyro.status.bias == pytest.approx(bias, abs=0.005)


@pytest.mark.slow
def test_the_variance_of_the_turn_is_that_of_its_errors() -> None:
    """The heading errors, divided by their published standard deviations, are about normal."""
    squares = []
    for seed in range(60):
        bench = Bench(noise=0.02, bias=0.01, first=10_000 * seed).run(1.0)
        bench.run(0.5, 0.5).run(2.0)
        bench.zero()
        bench.run(10.0, still=False)
        squares.append(bench.told**2 / bench.variance)
    assert 0.5 < sum(squares) / 60 < 2.0
