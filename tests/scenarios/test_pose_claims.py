"""The pose claims nothing that nobody measured: the track, and a gyro whose errors change."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any, Literal

import pytest

from acsard.core.config.settings import Config, McuConfig, OdometryConfig, SimConfig, WheelMap
from acsard.core.messages.state_warnings import warnings
from tests.scenarios.boards import turn_encoders
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.world import World
from tests.stepped import Outputs
from tests.wheels import FOUR, TWO, four_and_two


def heading_sigmas(world: World) -> float:
    off = math.remainder(world.state.yaw - world.mcu.vehicle.pose.yaw, math.tau)
    return abs(off) / math.sqrt(world.odom.pose.covariance[35])


@pytest.mark.variations(6)
@pytest.mark.parametrize("seconds", [3.0, 12.0])
@pytest.mark.parametrize(
    ("wheels", "track"), [(FOUR, 1.5), (FOUR, 1.9), (FOUR, 0.8), (TWO, 1.1), (TWO, 0.92)]
)
def test_a_robot_that_nobody_calibrated_is_not_certain_of_its_turns(
    wheels: WheelMap, track: float, seconds: float
) -> None:
    world = World(Config(mcu=McuConfig(wheels=wheels), sim=SimConfig(track_multiplier=track)))
    world.run(0.5)
    world.drive(0.0, 1.0, seconds)
    world.drive(0.0, 0.0, 1.0)
    # An error of more than half a turn looks small in `state`.
    true, state = world.mcu.vehicle.turned, world.state.yaw
    off = math.remainder(state - true, math.tau) + math.tau * round(
        (true * (track - 1.0)) / math.tau
    )
    assert abs(off) < 3.0 * math.sqrt(world.odom.pose.covariance[35])


@four_and_two
def test_a_robot_says_that_nobody_calibrated_it(wheels: WheelMap) -> None:
    def world(std: float | Literal["uncalibrated"], port: str = "/dev/ttyACM0") -> World:
        odometry = OdometryConfig(wheel_separation_multiplier_std=std)
        made = World(Config(mcu=McuConfig(port, wheels=wheels), odometry=odometry))
        made.run(1.0)
        return made

    (warning,) = warnings(world("uncalibrated").state)
    assert warning.brief == "not calibrated"
    assert "`acsard calibrate drive`" in warning.text
    assert world("uncalibrated").state.pose_doubt == "not_calibrated"
    assert [world(std).state.pose_doubt for std in (0.0, 0.3)] == ["", ""]
    assert world("uncalibrated", "sim").state.pose_doubt == ""


Plan = Callable[[int, random.Random], tuple[float, float]]
Change = Callable[[ImperfectGyro, int], None]


def turns(_: int, dice: random.Random) -> tuple[float, float]:
    return 0.3, dice.uniform(-1.0, 1.0)


def left(_: int, dice: random.Random) -> tuple[float, float]:
    return 0.3, dice.uniform(0.2, 1.0)


def straight(second: int, _: random.Random) -> tuple[float, float]:
    return 0.4, 0.0 if second % 8 else 0.15


def step(gyro: ImperfectGyro, second: int) -> None:
    gyro.bias = 0.05 if second > 9 else 0.0


def back(gyro: ImperfectGyro, second: int) -> None:
    gyro.bias = -0.08 if 5 < second < 15 else 0.0


def ramp(gyro: ImperfectGyro, second: int) -> None:
    gyro.bias = 0.002 * second


def half(gyro: ImperfectGyro, second: int) -> None:
    gyro._share = 0.5


def larger(gyro: ImperfectGyro, second: int) -> None:
    gyro._share = 1.0 if second < 10 else 1.4


def sound(gyro: ImperfectGyro, second: int) -> None:
    pass


@pytest.mark.slow
@pytest.mark.variations(109)
@pytest.mark.parametrize("std", ["uncalibrated", 0.0, 0.3])
@pytest.mark.parametrize("change", [sound, step, back, ramp, half, larger])
@pytest.mark.parametrize("plan", [turns, left, straight])
@four_and_two
def test_a_gyro_that_contradicts_the_wheels_is_a_doubt_and_is_said(
    plan: Plan, change: Change, std: Any, wheels: WheelMap
) -> None:
    odometry = OdometryConfig(gyro=True, wheel_separation_multiplier_std=std)
    gyro = ImperfectGyro(bias=0.0, noise=0.003)
    world = World(Config(mcu=McuConfig(wheels=wheels), odometry=odometry), gyro=gyro)
    world.run(2.0)
    dice, doubts = random.Random(1), set[str]()
    world.drive(0.3, 0.3, 1.0)
    for second in range(25):
        change(gyro, second)
        world.hold(*plan(second, dice), seconds=1.0)
        doubts.add(world.state.pose_doubt)
    world.drive(0.0, 0.0, 1.0)
    assert heading_sigmas(world) < 3.0
    if change is sound:
        assert doubts == {""}
    elif (plan, change) not in ((straight, larger), (left, step)):  # too little shows it
        assert "gyro_disagrees" in doubts


@pytest.mark.slow
@pytest.mark.variations(21)
@pytest.mark.parametrize("share", [0.9, 0.97, 1.03, 1.07, 1.1])
@pytest.mark.parametrize("std", ["uncalibrated", 0.02])
@four_and_two
def test_a_share_of_a_turn_by_which_gyro_and_wheels_may_differ_is_claimed(
    share: float, std: Any, wheels: WheelMap
) -> None:
    odometry = OdometryConfig(gyro=True, wheel_separation_multiplier_std=std)
    gyro = ImperfectGyro(bias=0.01, noise=0.005, share=share)
    world = World(Config(mcu=McuConfig(wheels=wheels), odometry=odometry), gyro=gyro)
    world.run(2.0)
    world.drive(0.2, 0.3, 0.5)
    world.hold(0.1, 1.0, 6.0)
    for _ in range(9):
        world.hold(0.1, 1.0, 1.0)
        assert heading_sigmas(world) < 2.0


@pytest.mark.variations(7)
@pytest.mark.parametrize("counts", [16, 20, 48, 96, 360])
@pytest.mark.parametrize("period", [0.01, 0.02, 0.1])
@four_and_two
def test_the_twist_of_encoders_with_unknown_counts_is_as_uncertain_as_a_count(
    period: float, counts: int, wheels: WheelMap
) -> None:
    mcu = McuConfig(wheels=wheels, reply_period=period)
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=counts)))
    turn_encoders(world.mcu, [0.0, 0.1, 0.2, 0.25])
    squares: list[tuple[float, float, float, float]] = []

    def watch(outputs: Outputs) -> None:
        for estimate in outputs.estimates:
            fr, fl, rl, rr = world.mcu.vehicle.speeds
            linear, angular = 0.05 * (fr + fl + rl + rr) / 4, 0.05 * (fr + rr - fl - rl) / 2 / 0.3
            twist, variances = estimate.twist, estimate.twist_variances
            off = (twist.linear - linear) ** 2, (twist.angular - angular) ** 2
            squares.append((*off, variances.linear, variances.angular))

    with world.mcu.fault("free_running", period):
        world.run(1.0)
        world.drive(0.3, 0.4, 2.0)
        world.watch = watch
        world.hold(0.3, 0.4, 4.0)
    linear, angular, of_linear, of_angular = map(sum, zip(*squares, strict=True))
    assert linear < 3.0 * of_linear
    assert angular < 3.0 * of_angular
