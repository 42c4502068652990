"""Delays of the host and lost lines change the pose in `state` only a little."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import Literal

import numpy as np
import pytest

from acsard.core.config.settings import (
    Config,
    ControlConfig,
    McuConfig,
    OdometryConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.values import Estimate, Received
from tests.scenarios.boards import blocks
from tests.scenarios.world import World
from tests.stepped import Outputs
from tests.wheels import four_and_two

FINE = SimConfig(encoder_counts=20_000)
"""Fine encoders, so that the two decimals of a line limit its accuracy."""

COUNTS = 3200


@pytest.mark.parametrize("link", ["plain", "checked", "checked with counts"])
def test_the_pose_of_a_pushed_robot_is_right_although_stop_lines_leave_late(link: str) -> None:
    """A person pushes the robot, so that it moves while only stop lines are sent."""
    mcu = McuConfig(
        link_check="off" if link == "plain" else "on",
        encoder_counts=COUNTS if link == "checked with counts" else 0,
    )
    world, estimates, true = World(Config(mcu=mcu)), list[Estimate](), list[tuple[int, float]]()

    def watch(outputs: Outputs) -> None:
        estimates.extend(outputs.estimates)
        true.append((world.now_ns, world.mcu.vehicle.pose.x))

    world.watch = watch
    world.run(1.0)
    with world.mcu.fault("pushed", 1.0):
        for _ in range(5):
            world.stall_in_step(0.15)
            world.run(0.4)
    times, places = zip(*true, strict=True)
    at = np.interp([estimate.at.mono_ns for estimate in estimates], times, places)
    off = at - [estimate.pose.x for estimate in estimates]
    assert np.abs(off).max() < 0.025
    assert at[-1] > 1.5


@pytest.mark.parametrize("rate", [10.0, 20.0, 100.0])
@pytest.mark.parametrize("held", ["by the host", "by the board"])
def test_the_clock_of_the_board_dates_lines_that_come_together(rate: float, held: str) -> None:
    """A USB hub holds its lines back, or the firmware blocks: its clock shows which of them."""
    mcu = McuConfig(link_check="on", encoder_counts=COUNTS)
    world = World(Config(mcu=mcu, control=ControlConfig(rate=rate)))
    estimates, true = list[Estimate](), list[tuple[int, float]]()

    def watch(outputs: Outputs) -> None:
        estimates.extend(outputs.estimates)
        world.mcu.advance(world.now_ns)
        true.append((world.now_ns, world.mcu.vehicle.pose.x))

    world.run(1.0)
    world.drive(0.6, 0.0, 3.0)
    world.watch = watch
    if held == "by the board":
        blocks(world.mcu, 1.0, 0.15)
        world.drive(0.6, 0.0, 6.0)
    else:
        with world.mcu.fault("stalls", 1.0, 0.15):
            world.drive(0.6, 0.0, 6.0)
    times, places = zip(*true, strict=True)
    at = np.interp([estimate.at.mono_ns for estimate in estimates], times, places)
    off = at - [estimate.pose.x for estimate in estimates]
    assert np.ptp(off) < 0.6 * 0.01


class Gap:
    """A checked link on which a gap in the feedback begins while the robot drives at a speed."""

    def __init__(self, speed: float) -> None:
        sure = OdometryConfig(distance_variance_per_metre=1e-6, distance_scale_std=0.0)
        config = Config(sim=FINE, mcu=McuConfig(link_check="on"), odometry=sure)
        self.world, self.speed = World(config), speed
        self.estimates: list[Estimate] = []
        self.world.watch = lambda outputs: self.estimates.extend(outputs.estimates)
        self.world.run(1.5)
        self.variance = self.estimates[-1].covariance.xx
        self.world.drive(speed, seconds=2.0)
        self.before = self.off

    @property
    def off(self) -> float:
        """The error of the pose along its path, m."""
        return self.world.state.x - self.world.mcu.vehicle.pose.x

    def end(self) -> tuple[float, float]:
        """Stop the robot and end the gap. Return the gap's error and the standard deviation, m."""
        self.world.hold(0.0, seconds=1.5)
        grown = self.estimates[-1].covariance.xx - self.variance
        return self.off - self.before, math.sqrt(grown)


@pytest.mark.variations(6)
@pytest.mark.parametrize("mute", [False, True], ids=["lost replies", "mute"])
@pytest.mark.parametrize(("commanded", "waiting"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.2)])
@pytest.mark.parametrize("stall", [0.2, 0.3, 0.5])
def test_a_stall_in_a_gap_does_not_end_the_motion_in_the_pose_before_rest_is_commanded(
    commanded: float, stall: float, waiting: float, mute: bool
) -> None:
    """During the gap the daemon stalls and sends nothing, and the robot drives on.

    It stops when it receives zeros, or when the board's watchdog stops the motors. The pose must
    not stop earlier.

    Args:
        commanded: Time in the gap during which commands continue, s.
        stall: Length of the stall, s.
        waiting: Length of a stall before the gap, s. A reply then waits in the buffer.
        mute: Whether the board is mute in the gap. Its first speeds then are means over the gap.
    """
    gap = Gap(0.5)
    if waiting:
        gap.world.stall(waiting)
    with gap.world.mcu.fault("mute") if mute else gap.world.mcu.fault("lost_replies", 1):
        gap.world.hold(0.5, seconds=commanded)
        gap.world.stall(stall)
        gap.world.run(0.6 - commanded - stall)
    off, deviation = gap.end()
    assert abs(off) < 0.1
    assert abs(off) < 3 * deviation


def test_a_stall_behind_the_command_to_rest_changes_nothing_in_the_pose() -> None:
    deviations = []
    for stall in (0.0, 0.3):
        gap = Gap(0.5)
        with gap.world.mcu.fault("mute"):
            gap.world.hold(0.5, seconds=0.3)
            gap.world.stall(stall)
            gap.world.run(0.5 - stall)
        deviations.append(gap.end()[0])
    assert deviations[0] == pytest.approx(deviations[1], abs=0.002)


@pytest.mark.variations(5)
@pytest.mark.parametrize("speed", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("seconds", [0.2, 0.35, 0.4, 0.5, 0.8])
def test_a_board_that_misses_the_command_to_rest_is_in_the_covariance(
    seconds: float, speed: float
) -> None:
    """The board receives no lines, so only its watchdog stops the robot, up to 0.2 s later.

    The covariance includes this additional distance.
    """
    gap = Gap(speed)
    with gap.world.mcu.fault("lost_commands", 1):
        gap.world.hold(speed, seconds=seconds)
    off, deviation = gap.end()
    assert abs(off) < 3 * deviation


@pytest.mark.slow
@pytest.mark.parametrize(("after", "every"), [(0.8, 3), (2.0, 2)])
def test_a_board_that_answered_late_before_loses_little_distance_with_its_replies(
    after: float, every: int
) -> None:
    """The board first answers late, then promptly, and then replies are lost.

    The change from late to prompt looks like jitter, which could hide the lost replies. It may hide
    the first three.
    """
    world = World(Config())
    with world.mcu.fault("slow_reply", 0.03):
        world.run(1.0)
        world.drive(0.3, seconds=2.0)
    world.drive(0.3, seconds=after)
    begun = world.state.x
    with world.mcu.fault("lost_replies", every):
        world.drive(0.3, seconds=4.0)
        assert world.state.x - begun == pytest.approx(1.2, abs=0.011)


@pytest.mark.variations(24)
@pytest.mark.parametrize("check", ["off", "on"])
@pytest.mark.parametrize("lag_s", [0.05, 0.15])
@pytest.mark.parametrize("silence_s", [0.12, 0.15, 0.19, 0.3])
@pytest.mark.parametrize("fault", ["lines to the host", "all lines", "the board"])
def test_errors_of_many_equal_silences_add_up_within_the_covariance(
    fault: str, silence_s: float, lag_s: float, check: Literal["off", "on"]
) -> None:
    """Each silence has the same cause, so the errors of all have the same sign.

    A loose cable loses the lines to the host or all lines, or the board itself is silent. In most
    silences the daemon commands rest. `lag_s` is the time constant of the motors.
    """
    sim = SimConfig(motor_time_constant=lag_s)
    made = World(Config(mcu=McuConfig(link_check=check), sim=sim))
    made.run(2.5)
    made.drive(0.8, 0.0, 2.0)
    for _ in range(8):
        with ExitStack() as fault_over, pytest.MonkeyPatch.context() as cable:
            if fault == "the board":
                fault_over.enter_context(made.mcu.fault("mute"))
            else:
                cable.setattr(made.port, "feed", lambda received: None)
            if fault == "all lines":
                cable.setattr(made.mcu, "receive", lambda *line: None)
            made.hold(0.8, 0.0, silence_s)
        made.hold(0.8, 0.0, 1.5)
    made.drive(0.0, 0.0, 1.5)
    error, variance = made.mcu.vehicle.pose.x - made.state.x, made.odom.pose.covariance[0]
    assert abs(error) < 2.0 * math.sqrt(variance), f"{error:+.3f} m"


@pytest.mark.variations(13)
@pytest.mark.parametrize("wheel", [0, 1])
@pytest.mark.parametrize("tens", [b"0", b"3", b"5"])
@pytest.mark.parametrize(("rate", "silence_s"), [(10.0, 0.0), (100.0, 0.15), (100.0, 0.5)])
@four_and_two
def test_a_damaged_speed_in_a_long_line_or_after_a_silence_is_in_the_covariance(
    rate: float, silence_s: float, tens: bytes, wheel: int, wheels: WheelMap
) -> None:
    """The robot drives on. One line reports another digit for tens of rad/s of one wheel."""
    made = World(Config(mcu=McuConfig(wheels=wheels), control=ControlConfig(rate=rate)))
    made.run(1.0)
    made.drive(0.6, 0.0, 2.0)
    feed, damaged = made.port.feed, [0]

    def damages(received: Received) -> None:
        data = bytearray(received.data)
        place = data.find(wheels.motors[wheel][1].encode() + b"p")
        if place >= 0 and not damaged[0]:
            data[place + 2 : place + 3], damaged[0] = tens, 1
        feed(Received(received.at, bytes(data)))

    with pytest.MonkeyPatch.context() as cable:
        cable.setattr(made.port, "feed", lambda received: None)
        made.hold(0.6, 0.0, silence_s)
        cable.setattr(made.port, "feed", damages)
        made.hold(0.6, 0.0, 1.0)
    made.drive(0.0, 0.0, 1.5)
    true, state, covariance = made.mcu.vehicle.pose, made.state, made.odom.pose.covariance
    turned = abs(math.remainder(state.yaw - true.yaw, math.tau))
    assert damaged[0]
    assert turned < 3.0 * math.sqrt(covariance[35])
    off = math.dist((state.x, state.y), (true.x, true.y))
    assert off < 3.0 * math.sqrt(covariance[0] + covariance[7])
