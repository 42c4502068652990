"""What a faulty gyro or a second gyro may do to the heading.

The robot stands, turns to both sides, and drives round three corners. The wheels do not skid, so
the heading must stay within three standard deviations, and the turn that the wheels must claim
before a difference is a contradiction.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import msgspec
import pytest

from acsard.core.config.settings import Config, McuConfig, OdometryConfig, SimConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.simulator.simulated_robot import Observation
from acsard.core.values import NS_PER_S
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.world import World

CLAIMED = 0.3
"""Three standard deviations of the wheels' turn of a radian, rad: less is no contradiction."""

SMALL = math.radians(5.0)

Rate = Callable[[float, float], float]


class Bench(World):
    """A robot on a serial port, with another program's gyro: `rate(seconds, true)` in rad/s."""

    def __init__(self, period: int = 1) -> None:
        super().__init__(
            Config(
                mcu=McuConfig(port="/dev/ttyUSB0"),
                odometry=OdometryConfig(gyro=True),
                sim=SimConfig(encoder_counts=1440),
            ),
            gyro=ImperfectGyro(),
        )
        self.dice = random.Random(1)
        self.rate: Rate = lambda t, true: true + self.noise()
        self.others: list[tuple[str, Rate]] = []
        """Further programs that publish `imu`, each with its frame."""
        self.first: list[tuple[str, Rate]] = []
        self.worst = self.heading = self.hung = 0.0
        """Of error - 3 standard deviations, the largest error, and that in `hangs`, rad."""
        self.does: set[str] = set()
        self._period, self._begun_ns, self._yaw, self._told = period, self.now_ns, 0.0, 0.0
        self._mean: list[float] = []

    def noise(self) -> float:
        return 0.003 + self.dice.gauss(0.0, 0.004)

    def _see(self, sight: Observation) -> None:
        self.truth = sight.pose
        self._mean.append(sight.gyro)
        if len(self._mean) < self._period:
            return
        true, t = sum(self._mean) / len(self._mean), (sight.at_ns - self._begun_ns) / NS_PER_S
        self._mean.clear()
        for i, (frame, rate) in enumerate((*self.first, ("imu_link", self.rate), *self.others)):
            stamp_ns = sight.at_ns + self.wall_offset_ns + 5_000_000 * i
            payload = msgspec.json.encode(
                {
                    "header": {
                        "frame_id": frame,
                        "stamp": {"sec": stamp_ns // NS_PER_S, "nanosec": stamp_ns % NS_PER_S},
                    },
                    "angular_velocity": {"z": rate(t, true)},
                }
            )
            self.bus.arrivals.append(Arrival("imu", True, payload, "", sight.at_ns, None, ""))

    def leg(self, linear: float, angular: float, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            self.hold(linear, angular, 0.05)
            yaw, true = self.state.yaw, self.mcu.vehicle.turned
            self._told += math.remainder(yaw - self._yaw, math.tau)
            self._yaw = yaw
            error = abs(self._told - true)
            self.heading = max(self.heading, error)
            self.worst = max(self.worst, error - 3 * math.sqrt(self.odom.pose.covariance[35]))
            self.does.add(self.state.gyro)
            if self.state.gyro == "hangs":
                self.hung = max(self.hung, error)

    def course(self, corners: int = 3) -> None:
        self.leg(0.0, 0.0, 4.0)
        self.leg(0.0, 0.8, 4.0)
        self.leg(0.0, 0.0, 0.5)
        self.leg(0.0, -0.8, 4.0)
        self.leg(0.0, 0.0, 2.0)
        self.leg(0.3, 0.0, 4.0)
        for _ in range(corners):
            self.leg(0.3, 0.0, 3.0)
            self.leg(0.0, 0.785, 2.0)
        self.leg(0.0, 0.0, 6.0)
        error, std = self._told - self.mcu.vehicle.turned, math.sqrt(self.odom.pose.covariance[35])
        print(
            f"error {math.degrees(error):.2f} deg, largest {math.degrees(self.heading):.2f}, "
            f"hung {math.degrees(self.hung):.2f}, std {math.degrees(std):.2f}, "
            f"beyond 3 std {math.degrees(self.worst):.2f}, "
            f"{self.state.gyro}, {sorted(self.does)}, "
            f"{ {k: v for k, v in self.state.counters.items() if 'imu' in k} }"
        )


def hanging(at: float, until: float = math.inf) -> Callable[[Bench], Rate]:
    last = 0.0

    def of(bench: Bench) -> Rate:
        def rate(t: float, true: float) -> float:
            nonlocal last
            if not at < t < until:
                last = true + bench.noise()
            return last

        return rate

    return of


def scaled(share: float, at: float = 0.0) -> Callable[[Bench], Rate]:
    return lambda bench: lambda t, true: (share if t >= at else 1.0) * (true + bench.noise())


def stepped(bias: float, at: float) -> Callable[[Bench], Rate]:
    return lambda bench: lambda t, true: true + bench.noise() + (bias if t >= at else 0.0)


def single(rate_: float) -> Callable[[Bench], Rate]:
    return lambda bench: (
        lambda t, true: rate_ if bench.dice.random() < 0.01 else true + bench.noise()
    )


# The course: rest until 4.3 s, a turn until 8.5 s, ...
FAULTS = {
    "sound": lambda bench: bench.rate,
    "half the scale": scaled(0.5),
    "half the scale from 16 s on": scaled(0.5, 16.0),
    "1.5 times the scale": scaled(1.5),
    "1.5 times from 16 s on": scaled(1.5, 16.0),
    "bias +0.05 on the straight": stepped(0.05, 16.0),
    "bias -0.05 in the first turn": stepped(-0.05, 6.0),
    "bias +0.15 on the straight": stepped(0.15, 16.0),
    "reversed": scaled(-1.0),
    "reversed from 16 s on": scaled(-1.0, 16.0),
    "degrees": scaled(57.3),
    "degrees from 16 s on": scaled(57.3, 16.0),
    "dead": lambda bench: lambda t, true: bench.noise(),
    "dead from 16 s on": lambda bench: lambda t, true: (true if t < 16.0 else 0.0) + bench.noise(),
    "hangs on the straight": hanging(18.0),
    "hangs in a turn": hanging(23.5),
    "hangs in a turn for 3 s": hanging(23.5, 26.5),
    "hangs at rest before the drive": hanging(3.0),
    "single wrong samples": single(-30.0),
    "single small wrong samples": single(1.5),
}


MORE = (pytest.mark.slow, pytest.mark.nightly)
FIRST = ("hangs in a turn",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "period"),
    [
        pytest.param(fault, period, marks=() if fault in FIRST and period == 1 else MORE)
        for period in (1, 10)
        for fault in FAULTS
    ],
)
def test_the_heading_of_a_faulty_gyro_stays_within_its_covariance(fault: str, period: int) -> None:
    bench = Bench(period=period)
    bench.rate = FAULTS[fault](bench)
    bench.course()
    assert bench.worst < CLAIMED
    if "hangs" in fault:
        assert bench.hung < SMALL


@pytest.mark.parametrize(
    ("still", "noise", "period", "seed"),
    [
        pytest.param(0.1, 0.1, 5, 2, marks=pytest.mark.slow),
        pytest.param(0.004, 0.3, 10, 2, marks=MORE),
        *(
            pytest.param(still, 0.3, period, seed, marks=MORE)
            for still in (0.004, 0.3)
            for period in (1, 5, 10)
            for seed in range(2)
        ),
    ],
)
def test_the_noise_of_a_gyro_that_claims_none_is_in_the_covariance(
    still: float, noise: float, period: int, seed: int
) -> None:
    """The noise at rest is `still`, and from the first turn on `noise`, rad/s."""
    bench = Bench(period=period)
    bench.dice.seed(seed)
    bench.rate = lambda t, true: true + bench.dice.gauss(0.003, noise if t > 4.3 else still)
    bench.course()
    assert bench.worst < CLAIMED
    if still > 0.2:
        assert "used" not in bench.does


@pytest.mark.slow
@pytest.mark.variations(3)
@pytest.mark.parametrize("who", ["another frame", "first another frame", "the same frame"])
def test_a_second_gyro_on_the_key_makes_no_wrong_and_certain_heading(who: str) -> None:
    bench = Bench()

    def lidar(t: float, true: float) -> float:
        return bench.noise() - 0.003

    match who:
        case "another frame":
            bench.others.append(("lidar_imu", lidar))
        case "first another frame":
            bench.first.append(("lidar_imu", lidar))
        case "the same frame":
            bench.others.append(("imu_link", lidar))
    bench.course()
    assert bench.worst < 0.01
    if who == "another frame":
        assert bench.heading < SMALL
        assert bench.state.counters["imu_second_sender"] > 0
