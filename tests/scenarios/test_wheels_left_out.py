"""When an encoder fails in motion, the pose stays right, and `state` names the wheel."""

from __future__ import annotations

import math
import random
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import (
    Config,
    LimitsConfig,
    McuConfig,
    OdometryConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.messages.schema import DiagnosticArray, DiagnosticStatus
from acsard.core.values import WHEELS
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.world import World
from tests.wheels import FOUR, TWO

COUNTS = SimConfig().encoder_counts


def world(
    gyro: ImperfectGyro | None = None, sim: SimConfig | None = None, counts: int = COUNTS
) -> World:
    made = World(
        Config(
            mcu=McuConfig(encoder_counts=counts),
            odometry=OdometryConfig(gyro=gyro is not None),
            sim=sim or SimConfig(),
        ),
        gyro=gyro,
    )
    made.run(1.5)
    return made


def off(made: World) -> tuple[float, float]:
    """Return the position error in m and the heading error in rad of the odometry."""
    pose, truth = made.state, made.mcu.vehicle.pose
    turn = math.remainder(pose.yaw - truth.yaw, math.tau)
    return math.dist((pose.x, pose.y), (truth.x, truth.y)), abs(turn)


def row(made: World) -> DiagnosticStatus:
    message = made.loop.publication.current("diagnostics")
    assert isinstance(message, DiagnosticArray)
    (row_status,) = [status for status in message.status if status.name == "acsard: wheels"]
    return row_status


def encoder_fault(made: World, kind: str, wheel: int) -> AbstractContextManager[None]:
    return {
        "dead": made.mcu.fault("stuck_encoder", wheel),
        "reversed": made.mcu.fault("bias", wheel, -1.0),
        "stuck": made.mcu.fault("frozen_encoder", wheel),
    }[kind]


SLOW = pytest.mark.slow

SURE = OdometryConfig(
    distance_variance_per_metre=1e-6,
    yaw_variance_per_metre=1e-6,
    yaw_variance_per_radian=1e-5,
    wheel_radius_ratio_std=1.4e-4,
    wheel_separation_multiplier_std=1e-3,
)
"""Small errors of healthy wheels, so that the covariance shows the errors of a fault."""


@pytest.mark.parametrize(
    ("kind", "wheel"),
    [
        ("dead", 0), ("reversed", 2), ("stuck", 1),
        *(pytest.param(kind, wheel, marks=SLOW)
          for kind in ("dead", "reversed", "stuck") for wheel in range(4)),
    ],
)  # fmt: skip
def test_with_one_wheel_fault_the_pose_stays_right_and_state_names_the_wheel(
    kind: str, wheel: int
) -> None:
    made = world()
    made.drive(0.3, seconds=1.0)
    with encoder_fault(made, kind, wheel):
        made.hold(0.6, -0.8, seconds=1.0)
        made.send(0.0)
        made.run(1.0)
        assert made.state.wheel_fault.startswith(f"{WHEELS[wheel]} wheel is left out")
        assert (row(made).level, row(made).message) == (1, made.state.wheel_fault)
        distance, turn = off(made)
        assert distance < 0.03
        assert turn < 0.05
    reports = [event.text for event in made.events if event.name == "wheel_fault"]
    assert any(f"{WHEELS[wheel]} wheel is left out" in report for report in reports)


def test_with_a_gyro_and_a_wheel_fault_heading_and_distance_stay_right() -> None:
    made = world(ImperfectGyro(bias=0.01), SimConfig(track_multiplier=1.6))
    made.drive(0.4, 0.8, seconds=3.0)
    with made.mcu.fault("stuck_encoder", 0):
        made.hold(0.4, 0.8, seconds=3.0)
        made.send(0.0)
        made.run(1.0)
        assert made.state.wheel_fault.startswith("front_right wheel is left out")
    # The track is not calibrated, so the wheels turn too far, in the pose only until the gyro
    # proves itself.
    assert made.state.gyro == "disagrees"
    distance, turn = off(made)
    assert distance < 0.2
    assert turn < 0.1


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("lag", "reaches"), [(0.6, 0.6), pytest.param(0.6, 1.0, marks=SLOW), pytest.param(0.2, 0.6)]
)
def test_a_big_robot_that_responds_late_and_falls_short_is_a_warning(
    lag: float, reaches: float
) -> None:
    """The motors respond with the delay `lag` and reach only the share `reaches` of each speed.

    The robot drives on without a wheel fault, and the diagnostics warn if it is too slow.
    """
    rate = 20.0
    limits = LimitsConfig(
        linear_acceleration=rate, linear_deceleration=rate, linear_stop_deceleration=rate,
        angular_acceleration=4 * rate, angular_deceleration=4 * rate,
        angular_stop_deceleration=4 * rate,
    )  # fmt: skip
    for seed in range(4):
        dice = random.Random(seed)
        made = World(Config(limits=limits, sim=SimConfig(motor_time_constant=lag)))
        made.run(1.0)
        with made.mcu.switched(partial(replace, drives=(reaches,) * 4)):
            made.send(0.0)
            made.run(0.1)
            for _ in range(6):
                made.hold(dice.uniform(-1, 1), dice.uniform(-3, 3), dice.uniform(0.3, 2.0))
            for _ in range(2):
                made.hold(0.8, 0.0, 2.5)
            assert made.state.mode == "driving"
            assert ("wheel" in row(made).message and row(made).level == 1) is (reaches < 1.0)


def test_a_wheel_that_is_ignored_as_dead_leaves_the_turn_rate_uncertain() -> None:
    """The wheel may be blocked instead, and then the robot turns, but its odometry does not."""
    made = world()
    made.drive(0.8, seconds=1.0)
    with made.mcu.fault("dead_motor", 0):
        made.hold(0.8, seconds=0.4)
        before = made.mcu.vehicle.pose.yaw
        made.hold(0.8, seconds=0.1)
    assert made.state.wheel_fault
    truth = (made.mcu.vehicle.pose.yaw - before) / 0.1
    assert abs(truth) > 0.5
    assert made.odom.twist.covariance[35] > (truth / 3) ** 2


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("kind", "wheels"),
    [
        ("dead motor", FOUR), ("reversed motor", FOUR), ("all right encoders", FOUR),
        ("all right encoders", TWO),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("linear", "angular"), [(0.5, 0.0), (0.3, 1.0)])
def test_a_wheel_that_may_be_right_although_it_is_ignored_is_in_the_covariance(
    kind: str, linear: float, angular: float, wheels: WheelMap
) -> None:
    mcu = McuConfig(encoder_counts=COUNTS, wheels=wheels)
    made = World(Config(mcu=mcu, odometry=SURE))
    made.run(1.5)
    made.drive(linear, angular, seconds=2.0)
    before = off(made)[1]
    right = {motor[1] for name, motor in named(wheels) if "right" in name}
    with ExitStack() as faults:
        if kind == "all right encoders":
            board = made.mcu

            def speeds(now_ns: int, read: Any = board._speeds) -> list[float]:
                by_motor = zip(board.letters, read(now_ns), strict=True)
                return [0.0 if letter in right else speed for letter, speed in by_motor]

            faults.enter_context(pytest.MonkeyPatch.context()).setattr(board, "_speeds", speeds)
        else:
            faults.enter_context(made.mcu.fault(kind.replace(" ", "_"), 0))
        made.hold(linear, angular, seconds=1.0)
        made.run(1.0)
    error, std = off(made)[1] - before, math.sqrt(made.odom.pose.covariance[35])
    assert 0.1 < error < 3.0 * std


def named(wheels: WheelMap) -> list[tuple[str, str]]:
    return list(zip(wheels.names, wheels.motors, strict=True))


@pytest.mark.parametrize("wheel", range(2))
def test_of_two_wheels_none_is_left_out_and_a_dead_encoder_is_reported_once(wheel: int) -> None:
    made = World(Config(mcu=McuConfig(encoder_counts=COUNTS, wheels=TWO)))
    made.run(1.5)
    made.drive(0.3, seconds=1.0)
    name, letter = named(TWO)[wheel]
    with made.mcu.fault("stuck_encoder", TWO.letters.index(letter[1])):
        made.hold(0.6, -0.8, seconds=3.0)
        assert made.state.wheel_fault.startswith(f"{name} wheel is blocked")
        assert (row(made).level, row(made).message) == (1, made.state.wheel_fault)
    reports = [event.text for event in made.events if event.name == "wheel_fault"]
    assert len(reports) == 1
    assert made.state.mode == "driving"


def test_the_motion_that_the_pose_gets_back_leaves_no_side_in_doubt() -> None:
    """The lines before the one that showed the fault count once."""
    made = world(counts=400, sim=SimConfig(encoder_counts=400))
    made.drive(0.5, seconds=2.0)
    with made.mcu.fault("reversed_encoder", 1):
        made.hold(0.5, 0.0, seconds=1.0)
    left = made.loop.robot.state.odometry.doubts.left
    assert abs(left.short) < 0.1
