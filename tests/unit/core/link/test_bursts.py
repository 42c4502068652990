"""The covariance contains the errors of bursts of 0.1 to 0.5 s without plain lines.

Run it with `pytest -s -m soak core/link/test_bursts.py`. `test_line_time.py` tests the pose error
after 450 m, and `scenarios/test_pose_bursts.py` tests boards that send counts.
"""

from __future__ import annotations

import numpy as np
import pytest

from acsard.core.link.feedback import Feedback
from acsard.core.values import STILL
from tests.unit.core.link.drives import Case, Host, reporting
from tests.unit.core.motion.nees import (
    AT,
    DEFAULT,
    PERIOD,
    REGION,
    WHEELS,
    Array,
    Model,
    nees,
    true_ends,
)
from tests.unit.core.motion.odometer import Odometer

BURSTS = Case(burst_every=30.0)


def drive(seed: int, seconds: float, model: Model, robots: int) -> Array:
    """Return the NEES of robots that get the same commands and slip differently."""
    host = Host(BURSTS, seed, seconds)
    host.found = Odometer(model.config())
    reporting(host)
    path = host.path
    wheels = np.stack([path.left, path.right], axis=1)[:: round(PERIOD / 0.001)]
    ends = true_ends([np.diff(wheels, axis=0) / PERIOD], robots, model, host.rng)
    end = host.found.fold(Feedback(AT, STILL, 0.0))
    p = end.covariance
    covariance = [[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]]
    pose = np.array([end.pose.x, end.pose.y, end.pose.yaw])
    assert host.found.odometry.filled > 0.05
    return nees(pose, np.array(covariance), ends[:, 0])


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("model", "least"), [(WHEELS, 2.7), (DEFAULT, 2.85)], ids=["wheels", "default"]
)
def test_after_bursts_of_lost_lines_the_covariance_is_consistent(
    model: Model, least: float
) -> None:
    """The wheels err by only 3 mm per metre, so lost lines cause most of the error.

    The covariance is a little larger than the error from the lost lines.
    """
    values = np.concatenate([drive(seed, 90.0, model, 10) for seed in range(100)])
    inside = float((values < REGION).mean())
    print(f"\nbursts, {len(values)} runs: NEES {values.mean():.2f}, region holds {inside:.1%}")
    assert least < values.mean() < 3.15
    assert 0.93 <= inside <= 0.97
