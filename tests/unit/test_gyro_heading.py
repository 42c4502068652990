"""The heading by odometry with a gyro: each turn of the wheels is compared and corrected once."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.link.feedback import Line
from acsard.core.motion.gyro import Gyro, Turn
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.uncertainty import ErrorModel
from acsard.core.values import NS_PER_S, GyroSample, Instant, Twist, WheelSpeeds
from tests.unit.odometer import Odometer

KINEMATICS = Kinematics(DriveConfig())

PERIOD_NS = NS_PER_S // 100

GYRO_SCALE_STD = OdometryConfig().gyro_scale_std


class Listening(Gyro):
    """A gyro that records the turns that the wheels report, and never corrects them."""

    by_wheels: float = 0.0

    def turn(self, at_ns: int, dt: float, wheels: float, *line: object) -> Turn | None:
        self.by_wheels += wheels
        return None


@st.composite
def feedback(draw: st.DrawFn) -> Line:
    """Return a line with or without counts, missing time or a gap, of wheels that never rest."""
    left, right = draw(WHEEL), draw(WHEEL)
    speeds, at = WheelSpeeds(right, left, left, right), Instant(0, 0)
    match draw(st.sampled_from(("plain", "bridged", "counts", "gap"))):
        case "gap":
            return Line(at, speeds, 0.0, 0.5)
        case "counts":
            a, b, c, d = (speed * 0.01 for speed in speeds.as_tuple())
            return Line(at, speeds, 0.01, turned=(a, b, c, d))
        case "bridged":
            return Line(at, speeds, 0.31, bridged=0.3)
    return Line(at, speeds, 0.01)


WHEEL = st.floats(1.0, 20.0)  # never at rest, because counts are held back there


@given(st.lists(st.tuples(feedback(), st.booleans()), max_size=30))
def test_the_turn_of_the_wheels_that_a_gyro_gets_is_the_turn_of_the_heading(
    lines: list[tuple[Line, bool]],
) -> None:
    robot, listening = Odometer(counts=3200), Listening()
    robot.use(listening)
    for line, skipped in lines:
        if skipped:
            robot.skip(line)
        else:
            robot.fold(line)
    off = math.remainder(robot.pose.yaw - listening.by_wheels, math.tau)
    assert off == pytest.approx(0.0, abs=1e-9)


class Turning:
    """A robot with an accurate gyro that rests for a second and then moves as commanded."""

    def __init__(self, scale: float = 1.0) -> None:
        """Start at rest. The gyro reports `scale` times the true turn."""
        self.scale = scale
        self.gyro, self.robot = Gyro(), Odometer(counts=3200)
        self.robot.use(self.gyro)
        self.now_ns, self.true = NS_PER_S, 0.0
        self.hangs_at: float | None = None
        """The rate that the gyro repeats forever, rad/s; None if it works."""
        self.run(1.0, Twist())

    def run(self, seconds: float, twist: Twist) -> None:
        """Move at this twist."""
        speeds = KINEMATICS.wheel_speeds(twist)
        for _ in range(round(100 * seconds)):
            self.now_ns += PERIOD_NS
            self.true += twist.angular / 100
            measured = twist.angular * self.scale if self.hangs_at is None else self.hangs_at
            self.gyro.add_samples((GyroSample(self.now_ns, None, measured),))
            line = Line(Instant(self.now_ns, self.now_ns), speeds, 0.01)
            self.yaw_variance = self.robot.fold(line, speeds).covariance.yawyaw

    @property
    def off(self) -> float:
        """Return the error of the heading, rad."""
        return math.remainder(self.robot.pose.yaw - self.true, math.tau)


def proved(scale: float) -> Turning:
    """Return a robot whose gyro has proved itself, so that odometry uses it from now on."""
    bench = Turning(scale)
    bench.run(0.5, Twist(0.0, 1.0))
    bench.run(1.0, Twist())
    assert bench.gyro.status.does == "used"
    return bench


@pytest.mark.parametrize("drives_on", [False, True])
def test_a_hanging_gyro_s_heading_is_taken_back_or_in_the_covariance(
    drives_on: bool,
) -> None:
    bench = proved(1.0)
    bench.run(1.0, Twist(0.0, 1.0))
    bench.hangs_at = 1.0
    bench.run(8.0, Twist(0.5 if drives_on else 0.0, 0.0))
    assert bench.gyro.status.does == ("disagrees" if drives_on else "hangs")
    assert abs(bench.off) < 2.0 * math.sqrt(bench.yaw_variance)
    if not drives_on:
        assert abs(bench.off) < 0.02
        assert math.sqrt(bench.yaw_variance) < 0.7


@pytest.mark.parametrize("std", [GYRO_SCALE_STD, 0.02])
@pytest.mark.parametrize("turns", [2, pytest.param(15, marks=pytest.mark.slow)])
def test_the_error_of_a_gyros_scale_grows_with_the_turns(turns: int, std: float) -> None:
    bench = proved(1 + std)
    bench.robot.model = ErrorModel(OdometryConfig(gyro=True, gyro_scale_std=std), KINEMATICS, 3200)
    off, variance = bench.off, bench.yaw_variance
    bench.run(turns * math.tau / 2.0, Twist(0.0, 2.0))
    bench.run(1.0, Twist())
    off, variance = bench.off - off, bench.yaw_variance - variance
    assert off == pytest.approx(std * turns * math.tau, rel=0.05)
    assert off**2 / variance == pytest.approx(1.0, rel=0.25)


def test_the_error_of_a_gyros_scale_cancels_when_the_robot_turns_back() -> None:
    bench = proved(1 + GYRO_SCALE_STD)
    off, variance = bench.off, bench.yaw_variance
    for rate in (2.0, -2.0):
        bench.run(10.0, Twist(0.0, rate))
    bench.run(1.0, Twist())
    assert bench.off == pytest.approx(off, abs=0.01)
    assert bench.yaw_variance - variance < (GYRO_SCALE_STD * 20.0) ** 2 / 20
