"""A skid-steer robot computes its heading from the gyro, and reports the state of the gyro."""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.config.settings import Config, OdometryConfig, SimConfig
from acsard.recording.recorded_steps import StepRecorder
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.world import World

CALIBRATED, SKIDDING = 1.05, 1.6
"""Turn of the wheels divided by the true one, of robots with a calibrated track and without."""


def world(
    imperfect: ImperfectGyro | None = None,
    gyro: bool = True,
    recorder: StepRecorder | None = None,
    skid: float = CALIBRATED,
    track_std: float = 0.0,
) -> World:
    """Return a world whose robot has been at rest for 1.5 s."""
    made = World(
        Config(
            odometry=OdometryConfig(gyro=True, wheel_separation_multiplier_std=track_std),
            sim=SimConfig(track_multiplier=skid),
        ),
        recorder=recorder,
        gyro=imperfect or ImperfectGyro(bias=0.01, noise=0.005),
    )
    made.gyro_dead = not gyro
    made.run(1.5)
    return made


class Drive:
    """Measures the rotation during a drive, simulated and by odometry, including whole turns."""

    def __init__(self, made: World) -> None:
        self.world, self.told, self.all = made, 0.0, 0.0
        self._yaw, self._true = made.state.yaw, made.mcu.vehicle.turned
        self._begun = self._true

    def hold(self, linear: float, angular: float, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            self.world.hold(linear, angular, 0.05)
            yaw, true = self.world.state.yaw, self.world.mcu.vehicle.turned
            self.told += math.remainder(yaw - self._yaw, math.tau)
            self.all += abs(true - self._true)
            self._yaw, self._true = yaw, true

    @property
    def error(self) -> float:
        """The heading error, as a share of the total rotation in both directions."""
        return abs(self.told - (self._true - self._begun)) / self.all


def wandering(made: World, seed: int, seconds: float = 60.0) -> Drive:
    """Drive at random with some stops for `seconds`, and end at rest. Return the measured drive."""
    chance, drive, left = random.Random(seed), Drive(made), seconds
    made.drive(0.0, 0.0, 0.2)
    while left > 0.0:
        linear, angular = chance.uniform(-0.3, 0.8), chance.uniform(-1.5, 1.5)
        if chance.random() < 0.2:
            linear = angular = 0.0
        length = chance.uniform(1.0, 4.0)
        drive.hold(linear, angular, length)
        left -= length
    drive.hold(0.0, 0.0, 1.5)
    return drive


@pytest.mark.slow
@pytest.mark.parametrize(("skid", "does"), [(CALIBRATED, "used"), (SKIDDING, "disagrees")])
def test_with_a_gyro_the_heading_error_is_below_one_percent_of_all_rotation(
    skid: float, does: str
) -> None:
    drive = wandering(world(skid=skid), 1)
    print(f"with a gyro {drive.error:.2%} of {drive.all:.1f} rad")
    assert drive.error < 0.01
    assert drive.world.state.gyro == does


@pytest.mark.slow
@pytest.mark.parametrize("track_std", [0.0, 0.3])
def test_the_heading_is_not_sure_if_gyro_and_wheels_differ_whatever_the_settings_say(
    track_std: float,
) -> None:
    """The gyro or the track is wrong, and nobody knows which one."""
    drive = Drive(world(skid=SKIDDING, track_std=track_std))
    drive.world.drive(0.0, 0.0, 0.2)
    drive.hold(0.2, 1.0, 20.0)
    assert drive.world.state.gyro == "disagrees"
    assert 3.0 < math.sqrt(drive.world.odom.pose.covariance[35]) < 30.0
    assert drive.error < 0.01


@pytest.mark.slow
def test_a_gyro_that_is_40_ms_late_has_a_small_heading_error_too() -> None:
    drive = wandering(world(ImperfectGyro(bias=0.01, noise=0.005, late=4)), 4)
    print(f"with a late gyro {drive.error:.2%} of {drive.all:.1f} rad")
    assert drive.error < 0.01
    assert drive.world.state.gyro == "used"


def test_a_gyro_that_dies_is_reported_and_the_wheels_go_on() -> None:
    made = world()
    made.drive(0.3, 0.5, 1.0)
    made.gyro_dead = True
    before = made.state.yaw
    made.hold(0.3, 0.5, 2.0)
    assert made.state.gyro == "silent"
    assert made.state.mode == "driving"
    assert made.state.yaw - before == pytest.approx(1.0, abs=0.1)
    made.gyro_dead = False
    made.hold(0.3, 0.5, 1.0)
    reports = [event.text.partition(":")[0] for event in made.events if event.name == "gyro"]
    assert reports == ["waiting for rest", "waiting for turn", "silent", "used"]
