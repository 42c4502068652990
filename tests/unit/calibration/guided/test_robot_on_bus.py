"""Tests that turn the messages of the bus into a run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acsard.calibration.guided import robot_on_bus
from acsard.calibration.guided.drive_plan import DisturbedError, GuideError, Leg, Move
from acsard.calibration.guided.leg_driver import STALL_REASON
from acsard.calibration.guided.robot_on_bus import LegRecorder, RobotOnBus, Sample, times
from acsard.calibration.log_table import LogError
from acsard.core.config.settings import Config, JointsConfig
from acsard.core.messages.schema import (
    Header,
    Imu,
    JointState,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Time,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)  # fmt: skip
from acsard.core.values import NS_PER_S
from acsard.core.values import Twist as Command
from acsard.host import clock
from acsard.terminal.prompt import Prompt
from tests.unit.calibration.guided.test_leg_driver import US, telling
from tests.unit.top.screens import sample_of

JOINTS = JointsConfig().as_tuple()


def stamped(seconds: float) -> Header:
    return Header(Time.from_ns(round(seconds * 1e9)))


def wheels(seconds: float, right: float, left: float) -> JointState:
    return JointState(stamped(seconds), list(JOINTS), [0.0] * 4, [right, left, left, right])


def recorded() -> LegRecorder:
    """Record wheel messages and gyro messages through the bus.

    The wheel messages have stamps of another clock and arrive at least 0.1 s late. The gyro
    messages have no stamps.
    """
    recorder = LegRecorder(JOINTS)
    for k in range(100):
        at = 10.0 + 0.02 * k
        recorder.wheels(wheels(at + 5000.0, 3.0, 1.0), at + 0.1 + 0.05 * (k % 3))
        imu = Imu(
            Header(), Quaternion(), [0.0] * 9, Vector3(z=0.5), [0.0] * 9, Vector3(), [0.0] * 9
        )
        recorder.gyro(imu, at)
    return recorder


def test_sample_times_follow_their_stamps_and_the_least_delayed_sample() -> None:
    run = recorded().log().runs[0]
    assert np.diff(run.t) == pytest.approx(0.02)
    # The gyro began at 10.0 s on this computer's clock, the wheels 0.1 s later.
    assert run.gyro_t[0] == pytest.approx(-0.1)
    assert set(run.left) == {1.0}
    assert set(run.right) == {3.0}
    assert set(run.gyro) == {0.5}


def test_arrival_times_replace_stamps_that_jump() -> None:
    samples = [Sample(float(k), k + (100.0 if k > 5 else 0.0), ()) for k in range(10)]
    assert list(times(samples)) == [float(k) for k in range(10)]


def test_positions_are_taken_from_a_pose_and_from_odometry_alike() -> None:
    pose = Pose(Vector3(1.0, 2.0), Quaternion())
    unknown = [0.0] * 36
    twist = TwistWithCovariance(Twist(Vector3(), Vector3()), unknown)
    for message in (
        PoseStamped(stamped(1.0), pose),
        Odometry(stamped(1.0), "base", PoseWithCovariance(pose, unknown), twist),
    ):
        recorder = LegRecorder(JOINTS)
        recorder.place(message, 5.0)
        assert recorder.samples["places"] == [Sample(5.0, 1.0, (1.0, 2.0))]


def test_the_applied_commands_are_part_of_the_run() -> None:
    recorder = recorded()
    for k in range(100):
        twist = Twist(Vector3(x=0.4), Vector3(z=-0.5))
        recorder.command(TwistStamped(stamped(5010.0 + 0.02 * k), twist), 10.1 + 0.02 * k)
    run = recorder.log().runs[0]
    assert (set(run.linear), set(run.angular)) == ({0.4}, {-0.5})
    assert run.commands_t[0] == pytest.approx(0.0)


def test_the_speed_of_the_fastest_wheel_is_returned_for_either_direction() -> None:
    speeds = LegRecorder(JOINTS).wheels(wheels(1.0, 1.0, -4.0), 1.0)
    assert max(map(abs, speeds.as_tuple())) == 4.0


def test_wheel_states_without_a_joint_of_the_robot_are_refused() -> None:
    message = wheels(1.0, 1.0, 1.0)
    message.name[0] = "arm_joint"
    with pytest.raises(GuideError, match=f"no speed of {JOINTS[0]}"):
        LegRecorder(JOINTS).wheels(message, 1.0)


def test_a_recording_without_wheels_is_refused() -> None:
    with pytest.raises(LogError):
        LegRecorder(JOINTS).log()


def test_a_wheel_that_contradicts_the_other_of_its_side_is_noted_or_refused() -> None:
    def with_rear_left(speed: float) -> LegRecorder:
        recorder = LegRecorder(JOINTS)
        for k in range(100):
            message = wheels(0.02 * k + 1.0, 6.0, 6.0)
            message.velocity[2] = speed
            recorder.wheels(message, 0.02 * k)
        return recorder

    assert with_rear_left(6.0).log().notes == ()
    assert "fl and rl differ by 25%" in with_rear_left(4.5).log().notes[0]
    with pytest.raises(LogError, match="rl hardly turns while fl does"):
        with_rear_left(0.0).log()


def test_a_leg_without_wheel_speeds_for_a_minute_is_disturbed() -> None:
    recorder = LegRecorder(JOINTS)
    for k in range(200):
        at = 10.0 + 0.02 * k + (61.0 if k >= 100 else 0.0)
        recorder.wheels(wheels(at, 3.0, 1.0), at)
    with pytest.raises(DisturbedError, match="no wheel speeds arrived for 60 s"):
        recorder.log()


class Laptop(Prompt):
    """A computer that drives a robot. The computer is suspended 2 s after a leg has begun."""

    source, sender, session, unreadable = "app", US, None, 0

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now, self.asleep = 100.0, 0.0
        self.sent: list[float] = []
        self.told = 0.0
        monkeypatch.setattr(clock, "mono_ns", lambda: round((self.now - self.asleep) * NS_PER_S))
        monkeypatch.setattr(clock, "asleep_ns", lambda: round(self.asleep * NS_PER_S))
        monkeypatch.setattr(robot_on_bus, "queue_on", lambda *_, **__: self)
        monkeypatch.setattr(robot_on_bus, "time", SimpleNamespace(sleep=self.keys))

    def keys(self, wait_s: float) -> str:
        """Let the time `wait_s` pass. The simulated person presses no key."""
        self.now += wait_s
        if self.now > 102.0 and not self.asleep:
            self.now, self.asleep = self.now + 60.0, 60.0
            self.sent.clear()
        return ""

    def key(self, name: str) -> str:
        return name

    def subscribe(self, name: str) -> Any:
        return States(self)

    def send(self, linear: float, angular: float) -> None:
        self.sent.append(linear)

    def try_recv(self) -> None:
        """Return None, because no message of a sensor waits."""


class States:
    """The states that the daemon publishes ten times a second while it follows this client."""

    def __init__(self, laptop: Laptop) -> None:
        self._laptop = laptop

    def undeclare(self) -> None:
        """Do nothing."""

    def try_recv(self) -> Any:
        laptop = self._laptop
        if laptop.now < laptop.told + 0.1:
            return None
        laptop.told = laptop.now
        return sample_of(telling(Command(laptop.sent[-1] if laptop.sent else 0.0, 0.0)))


def test_a_leg_does_not_continue_after_a_suspend(monkeypatch: pytest.MonkeyPatch) -> None:
    laptop: Any = Laptop(monkeypatch)
    robot = RobotOnBus(laptop, Config(), laptop)
    with pytest.raises(DisturbedError, match=STALL_REASON):
        robot.ride(Leg("ahead", "", (Move(20.0, 0.3),)))
    assert laptop.asleep
    assert set(laptop.sent) == {0.0}
