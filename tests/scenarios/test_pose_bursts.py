"""The odometry of drives with bursts of lost lines.

The tests compare `state` with the simulated robot. `unit/test_covariance_nees.py` tests the
covariance of 1000 robots that lose plain lines.
"""

from __future__ import annotations

import math
import random
from contextlib import ExitStack
from typing import Literal

import pytest

from acsard.core.config.settings import Config, McuConfig, SimConfig
from tests.scenarios.world import World

COUNTS = 3200
EVERY_S = 30.0


def drive(seed: int, seconds: float) -> tuple[float, float, int]:
    """Drive for `seconds`. Return the final position error, the distance, and the lost lines.

    The error and the distance are in m.
    """
    mcu = McuConfig(link_check="on", encoder_counts=COUNTS)
    made = World(Config(sim=SimConfig(encoder_counts=COUNTS), mcu=mcu))
    chance = random.Random(seed)
    made.run(1.5)
    made.drive(0.0, 0.0, 0.2)
    burst, lost = chance.uniform(1.0, min(EVERY_S, seconds) / 2), 0
    begun = made.now_ns
    while (now := (made.now_ns - begun) / 1e9) < seconds:
        linear, angular = chance.uniform(0.6, 1.0), chance.uniform(-1.0, 1.0)
        if now >= burst:
            length, before = (
                chance.choice((0.1, 0.2, 0.3, 0.4, 0.5)),
                made.loop.robot.session.good_lines,
            )
            with made.mcu.lost_replies(1):
                made.hold(linear, angular, length)
            lost += round(100 * length) - (made.loop.robot.session.good_lines - before)
            burst += chance.uniform(0.8, 1.2) * EVERY_S
            made.drive(linear, angular, 0.5)
        made.hold(linear, angular, chance.uniform(0.5, 3.0))
    made.hold(0.0, 0.0, 1.5)
    state, true = made.state, made.mcu.vehicle.pose
    return math.dist((state.x, state.y), (true.x, true.y)), made.loop.robot.travelled, lost


@pytest.mark.slow
def test_with_the_mcu_s_counts_bursts_of_lost_lines_cost_at_most_a_centimetre() -> None:
    off, metres, lost = drive(0, 30.0)
    assert lost > 10
    assert metres > 18.0
    assert off <= 0.01


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
                fault_over.enter_context(made.mcu.mute())
            else:
                cable.setattr(made.port, "feed", lambda received: None)
            if fault == "all lines":
                cable.setattr(made.mcu, "receive", lambda *line: None)
            made.hold(0.8, 0.0, silence_s)
        made.hold(0.8, 0.0, 1.5)
    made.drive(0.0, 0.0, 1.5)
    error, variance = made.mcu.vehicle.pose.x - made.state.x, made.odom.pose.covariance[0]
    assert abs(error) < 2.0 * math.sqrt(variance), f"{error:+.3f} m"
