"""Tests that turn bus messages into the rows that a calibration reads."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsard.calibration.recorded import HEADER, KEYS, row
from acsard.calibration.table import read
from acsard.messages.schema import (
    Header,
    Imu,
    JointState,
    Message,
    Pose,
    PoseStamped,
    Quaternion,
    ServiceReply,
    Time,
    Vector3,
)
from acsard.messages.topics import by_key

STAMP = Header(Time(1_700_000_000, 5_250_000))
WHEELS = JointState(STAMP, velocity=[1.25, -2.5, -2.0, 1.0])
GYRO = Imu(
    Header(), Quaternion(), [0.0] * 9, Vector3(z=-0.125), [0.0] * 9, Vector3(), [0.0] * 9
)  # fmt: skip
PLACE = PoseStamped(
    STAMP, Pose(Vector3(1.5, -2.25), Quaternion(z=math.sin(0.5), w=math.cos(0.5)))
)  # fmt: skip


def test_each_message_is_a_row_with_its_own_time() -> None:
    arrived_ns = 1_700_000_001_500_000_000
    rows = [row(message, arrived_ns) for message in (WHEELS, GYRO, PLACE)]
    table = read("\n".join([HEADER, *rows]).encode())
    nan = math.nan
    expected = {
        "t": [1_700_000_000.00525, 1_700_000_001.5, 1_700_000_000.00525],
        "fr": [1.25, nan, nan], "fl": [-2.5, nan, nan],
        "rl": [-2.0, nan, nan], "rr": [1.0, nan, nan],
        "yaw_rate": [nan, -0.125, nan],
        "x": [nan, nan, 1.5], "y": [nan, nan, -2.25], "yaw": [nan, nan, 1.0],
    }  # fmt: skip
    for name, values in expected.items():
        assert table.columns[name] == pytest.approx(np.array(values), abs=1e-5, nan_ok=True)


def test_the_keys_are_of_the_table() -> None:
    assert all(by_key(key) is not None for key in KEYS)


@pytest.mark.parametrize("message", [JointState(), ServiceReply(True, "")])
def test_what_tells_nothing_of_wheels_or_turns_is_no_row(message: Message) -> None:
    with pytest.raises(ValueError, match="no part of a log"):
        row(message, 0)
