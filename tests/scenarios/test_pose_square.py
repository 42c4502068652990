"""With `mcu.encoder_counts`, the odometry is as exact as the raw counts of the encoders allow.

The robot drives a square. The tests compare the pose of the daemon with a pose that is computed
directly from the whole counts of the simulated encoders. Run the table with `pytest -m "slow or not
slow" -s tests/scenarios/test_pose_square.py`.
"""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.simulator.vehicle import whole_counts
from acsard.core.values import Pose
from tests.scenarios.world import World
from tests.stepped import Outputs
from tests.unit.odometer import arc
from tests.wheels import four_and_two


class Square:
    """A drive along a square of 20 m with timed commands.

    It computes a second pose from the raw encoder counts.
    """

    def __init__(self, link: str, counts: int, stalls: bool, seed: int, wheels: WheelMap) -> None:
        mcu = McuConfig(
            link_check="off" if link == "plain" else "on",
            encoder_counts=counts,
            wheels=wheels,
        )
        self.world = world = World(Config(sim=SimConfig(encoder_counts=counts), mcu=mcu))
        self._counts, self._pose, self._before = counts, Pose(), [0] * 4
        self._dice, self._stalls, self._since = random.Random(seed), stalls, 0.0
        if link == "checked":
            with world.mcu.fault("no_sample"):
                self._drive()
        else:
            self._drive()

    def _drive(self) -> None:
        world, dice = self.world, self._dice
        world.watch = self._count
        world.run(1.0 + dice.uniform(0.0, 0.1))
        speed, rate = dice.uniform(0.4, 0.9), dice.choice((-1, 1)) * dice.uniform(0.8, 1.5)
        world.drive(0.0, 0.0, 0.2)
        for _ in range(4):
            self._hold(speed, 0.0, 5.0 / speed)
            self._hold(0.0, rate, math.pi / 2 / abs(rate) + 0.2)
        self._hold(0.0, 0.0, 1.0)

    def _hold(self, linear: float, angular: float, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            self.world.hold(linear, angular, 0.05)
            self._since += 0.05
            if self._stalls and self._since > 3.0:
                self._since = 0.0
                self.world.stall(self._dice.uniform(0.05, 0.15))

    def _count(self, outputs: Outputs) -> None:
        """Advance the pose of the raw counts to the present."""
        angles = self.world.mcu.vehicle.angles
        counts = [whole_counts(angle, self._counts) for angle in angles]
        a, b, c, d = (now - then for now, then in zip(counts, self._before, strict=True))
        self._before = counts
        metres = math.tau / self._counts * 0.05
        right, left = (a + d) / 2 * metres, (b + c) / 2 * metres
        self._pose = arc(self._pose, (right + left) / 2, (right - left) / 0.30)

    def errors(self) -> tuple[float, float, float, float]:
        """Return the final errors in m and degrees, of the daemon and then of the raw counts."""
        state = self.world.state
        ours, raw = self._off(Pose(state.x, state.y, state.yaw)), self._off(self._pose)
        return *ours, *raw

    def _off(self, pose: Pose) -> tuple[float, float]:
        true = self.world.mcu.vehicle.pose
        yaw = math.degrees(abs(math.remainder(pose.yaw - true.yaw, math.tau)))
        return math.dist((pose.x, pose.y), (true.x, true.y)), yaw


@pytest.mark.slow
@pytest.mark.variations(73)
@pytest.mark.parametrize("stalls", [True, False], ids=["stalls", ""])
@pytest.mark.parametrize("counts", [16, 20, 96, 400, 1000, 3200])
@pytest.mark.parametrize("link", ["plain", "checked", "checked with counts"])
@four_and_two
def test_a_square_ends_where_the_raw_counter_says(
    link: str, counts: int, stalls: bool, wheels: WheelMap
) -> None:
    square = Square(link, counts, stalls, 1, wheels)
    far, turned, raw_far, raw_turned = square.errors()
    print(
        f"{link}, {counts} counts, {'stalls' if stalls else 'no stalls'}: "
        f"{1000 * far:.1f} mm {turned:.2f} deg; raw {1000 * raw_far:.1f} mm {raw_turned:.2f} deg"
    )
    assert "line_implausible" not in square.world.state.counters
    # The counts are the same, but the host's clock shows the counter at other moments. Of finer
    # encoders it does not know the time to a count, and their lines are speeds times time.
    fine = counts > 400 and link != "checked with counts"
    assert turned <= 1.05 * raw_turned + (0.4 if fine else 0.05)
    assert far <= 1.05 * raw_far + (0.03 if fine else 0.005)


@four_and_two
def test_state_reports_the_configured_counts_if_the_speeds_agree_with_them(
    wheels: WheelMap,
) -> None:
    mcu = McuConfig(encoder_counts=16, wheels=wheels)
    world = World(Config(sim=SimConfig(encoder_counts=16), mcu=mcu))
    world.run(0.5)
    world.drive(0.5, 0.3, 2.0)
    assert world.state.encoder_counts == [16] * len(wheels.names)
    assert "coarse_encoder_lines" not in world.state.counters
