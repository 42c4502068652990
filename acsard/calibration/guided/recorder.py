"""What comes on the bus while a leg is driven -> a run, as a log would have it.

Every sender stamps by a clock of its own, or not at all. The samples of one key are as far apart as
their stamps say, and the one that came soonest came at once: so no clock needs to be set, and what
is left of the delays is found with the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.runs import Run, runs
from acsard.calibration.table import Floats, Table
from acsard.messages.schema import Imu, JointState, Odometry, PoseStamped, Time
from acsard.values import NS_PER_S

STREAMS = {"wheels": ("left", "right"), "gyro": ("yaw_rate",), "places": ("x", "y")}

LONGEST_S = 5.0
"""Between two samples' stamps and their arrivals: differences of more are no clock's."""


class Sample(Struct, frozen=True):
    """When it came and when it says it was made, s; and its values, as `STREAMS` names them."""

    came: float
    made: float | None
    values: tuple[float, ...]


class Recorder:
    """The samples of one leg."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._right = joints[0], joints[3]
        self._left = joints[1], joints[2]
        self.samples: dict[str, list[Sample]] = {name: [] for name in STREAMS}

    def wheels(self, message: JointState, came: float) -> float:
        """Take the wheels' speeds; the largest of them, rad/s."""
        speeds = dict(zip(message.name, message.velocity, strict=False))
        left, right = (
            (speeds[one] + speeds[other]) / 2 for one, other in (self._left, self._right)
        )
        self._take("wheels", message.header.stamp, came, (left, right))
        return max(map(abs, speeds.values()))

    def gyro(self, message: Imu, came: float) -> None:
        """Take a turn rate."""
        self._take("gyro", message.header.stamp, came, (message.angular_velocity.z,))

    def place(self, message: PoseStamped | Odometry, came: float) -> None:
        """Take a position; a heading may be there or not, and is not looked at."""
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        spot = pose.position
        self._take("places", message.header.stamp, came, (spot.x, spot.y))

    def _take(self, stream: str, stamp: Time, came: float, values: tuple[float, ...]) -> None:
        made = stamp.to_ns() / NS_PER_S if stamp.sec else None
        self.samples[stream].append(Sample(came, made, values))

    def run(self) -> Run:
        """All of it; raises `LogError` where the wheels told nothing."""
        count = sum(map(len, self.samples.values()))
        columns: dict[str, Floats] = {"t": np.full(count, math.nan)}
        at = 0
        for stream, names in STREAMS.items():
            samples = self.samples[stream]
            rows = slice(at, at + len(samples))
            columns["t"][rows] = times(samples)
            for number, column in enumerate(names):
                columns[column] = np.full(count, math.nan)
                columns[column][rows] = [sample.values[number] for sample in samples]
            at += len(samples)
        order = np.argsort(columns["t"], kind="stable")
        columns = {column: values[order] for column, values in columns.items()}
        return runs(Table(columns, np.zeros(count, dtype=np.int64), ("",), ())).runs[0]


def times(samples: Sequence[Sample]) -> Floats:
    """By our clock, s."""
    came = np.array([sample.came for sample in samples])
    made = np.array([math.nan if s.made is None else s.made for s in samples])
    if not len(came) or np.isnan(made).any():
        return came
    late = came - made
    if float(np.ptp(late)) > LONGEST_S:
        return came
    return np.asarray(made + float(late.min()))
