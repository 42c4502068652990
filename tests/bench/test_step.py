"""Compare the step time of the full odometry with that of the simplest odometry, in the same run.

The full odometry adds sample times, quantization, covariance, the consistency check and the gyro.
The test measures the time that they add: the time of today's session and odometry, minus the time
of a simple odometry (`Simplest`). The session's bookkeeping of the link is counted as added, too.

A step is one step of the control loop on a received line. It includes encoding the odometry for one
subscriber, and excludes the bus. The test compares processor time, which is the same on a busy
machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from contextlib import ExitStack
from statistics import median
from time import thread_time_ns
from types import MethodType

import pytest

from acsard.core.config.settings import (
    Config,
    DriveConfig,
    McuConfig,
    OdometryConfig,
    SimConfig,
    WheelMap,
)  # fmt: skip
from acsard.core.link.codec import Codec
from acsard.core.link.lines import LineReader
from acsard.core.messages.encodings import encode
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Instant, Pose, PoseCovariance, Received
from acsard.daemon.control_loop import Step
from acsard.daemon.pacing import NO_PERIOD, Period
from tests.scenarios.world import World
from tests.unit.odometer import arc

pytestmark = [pytest.mark.bench, pytest.mark.timeout(300)]

ROUNDS, SECONDS = 7, 10.0

ASSERTED = 2.0
"""Allowed ratio of the added parts to the rest of the step."""

ALL = Config(
    odometry=OdometryConfig(
        gyro=True,
        wheel_separation_multiplier_std=0.02,
        wheel_radius_ratio_std=0.003,
        distance_scale_std=0.002,
    ),
    sim=SimConfig(encoder_counts=400, track_multiplier=1.6),
    mcu=McuConfig(encoder_counts=400, reply_period=0.01),
)
"""Every part has work: three parameters, a gyro at 100 Hz, and counts that plain lines show."""


class Timed:
    """Replaces a method of an object. Counts its calls and their total processor time, ns."""

    def __init__(self, method: Callable[..., object]) -> None:
        assert isinstance(method, MethodType)
        self._call: Callable[..., object] = method
        self.calls = self.ns = 0
        setattr(method.__self__, method.__name__, self)

    def __call__(self, *arguments: object) -> object:
        began = thread_time_ns()
        try:
            return self._call(*arguments)
        finally:
            self.ns += thread_time_ns() - began
            self.calls += 1


class Simplest:
    """The simplest odometry: it moves along an arc at each line, with a first-order covariance."""

    def __init__(self) -> None:
        self._lines, self._codec = LineReader(), Codec(WheelMap())
        self._kinematics = Kinematics(DriveConfig())
        self._pose, self._p = Pose(), PoseCovariance(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
        self._last_ns = 0

    def hear(self, received: Received) -> None:
        for line, _ in self._lines.feed(received.data):
            speeds, now_ns = self._codec.decode(line), received.at.mono_ns
            dt, self._last_ns = (now_ns - (self._last_ns or now_ns)) / 1e9, now_ns
            twist = self._kinematics.twist(speeds)
            self._move(twist.linear * dt, twist.angular * dt)

    def _move(self, distance: float, turn: float) -> None:
        p, heading = self._p, self._pose.yaw + turn / 2
        c, s = math.cos(heading), math.sin(heading)
        fx, fy, along = -distance * s, distance * c, 1e-4 * abs(distance)
        self._p = PoseCovariance(
            p.xx + 2 * fx * p.xyaw + fx * fx * p.yawyaw + along * c * c,
            p.xy + fy * p.xyaw + fx * p.yyaw + fx * fy * p.yawyaw + along * c * s,
            p.xyaw + fx * p.yawyaw,
            p.yy + 2 * fy * p.yyaw + fy * fy * p.yawyaw + along * s * s,
            p.yyaw + fy * p.yawyaw,
            p.yawyaw + 1e-4 * abs(distance) + 1e-2 * abs(turn),
        )
        self._pose = arc(self._pose, distance, turn)


class Run:
    """A simulated robot that drives at random, and the time of those steps that receive a line."""

    def __init__(self, config: Config) -> None:
        self.world = made = World(config)
        # The board reports by its own clock, so that the daemon estimates the period, and counts
        # show.
        self.reports = ExitStack()
        self.reports.enter_context(made.mcu.fault("free_running", 0.01))
        made.run(1.5)
        made.drive(0.0, 0.0, 0.2)
        made.bus.wanted_keys = {"odom"}
        setattr(made.bus, "publish", lambda key, message: encode(message, "msgpack"))  # noqa: B010
        made.bus.publish_feedback = lambda topic, estimate: topic.encode(estimate, "msgpack")  # type: ignore[assignment, method-assign]
        feed, step = made.port.feed, made.loop.step
        robot, self.heard = made.loop.robot, list[Received]()
        self.lines = Timed(robot._check_and_integrate)
        self.parts = {"odometry": self.lines, "session": Timed(robot.state.session.update)}
        self.parts["gyro"] = Timed(robot.state.checks.gyro.add_samples)
        self.took = dict.fromkeys((*self.parts, "step", "simplest"), 0)
        simplest = Simplest()

        def hear(received: Received) -> None:
            self.heard.append(received)
            feed(received)

        def timed(now: Instant, period: Period = NO_PERIOD) -> Step:
            calls, before = self.lines.calls, {name: part.ns for name, part in self.parts.items()}
            began = thread_time_ns()
            result = step(now, period)
            ended = thread_time_ns()
            if self.lines.calls > calls:
                for received in self.heard:
                    simplest.hear(received)
                self.took["simplest"] += thread_time_ns() - ended
                self.took["step"] += ended - began
                for name, part in self.parts.items():
                    self.took[name] += part.ns - before[name]
            self.heard.clear()
            return result

        setattr(made.port, "feed", hear)  # noqa: B010
        setattr(made.loop, "step", timed)  # noqa: B010

    def drive(self, seed: int) -> dict[str, float]:
        """Drive for `SECONDS`, and return the processor time in us per received line.

        The keys of the dictionary are the whole step, its parts, and the simplest odometry.
        """
        self.took, calls = dict.fromkeys(self.took, 0), self.lines.calls
        chance, left = random.Random(seed), SECONDS
        while left > 0.0:
            length = chance.uniform(0.5, 2.0)
            self.world.hold(chance.uniform(0.1, 0.8), chance.uniform(-1.5, 1.5), length)
            left -= length
        lines = self.lines.calls - calls
        assert lines > 90 * SECONDS
        return {name: ns / lines / 1e3 for name, ns in self.took.items()}


def test_the_time_that_the_full_odometry_adds_to_a_step() -> None:
    run, rounds = Run(ALL), []
    for seed in range(ROUNDS):
        times = run.drive(seed)
        added = sum(times[name] for name in run.parts) - times["simplest"]
        rounds.append(times | {"added": added, "share": added / (times["step"] - added)})
    medians = {name: median(timing[name] for timing in rounds) for name in rounds[0]}
    assert run.world.state.gyro == "used"
    assert (
        run.world.loop.robot.state.session.encoder_counts(run.world.loop.robot.link_setup)
        == (400,) * 4
    )
    share = medians.pop("share")
    print("\nus a line: " + ", ".join(f"{name} {value:.1f}" for name, value in medians.items()))
    print(f"added is {share:.0%} of the rest of the step")
    assert share < ASSERTED
