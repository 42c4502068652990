"""Records the bus messages of a leg as a run, in the form that a log has.

Each sender stamps its messages with its own clock, or not at all. Within one key, the samples keep
the spacing of their stamps, and the sample with the smallest delay is taken to have arrived at
once. No clock has to be set, and the fit finds the remaining delays.
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
"""Largest variation of the delay between stamps and arrivals, s.

A larger one is not due to a clock.
"""


class Sample(Struct, frozen=True):
    """A sample's arrival and its own stamp, s, and its values in the order of `STREAMS`."""

    came: float
    made: float | None
    values: tuple[float, ...]


class Recorder:
    """Recorder of the samples of one leg."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._right = joints[0], joints[3]
        self._left = joints[1], joints[2]
        self.samples: dict[str, list[Sample]] = {name: [] for name in STREAMS}

    def wheels(self, message: JointState, came: float) -> float:
        """Add wheel speeds and return the largest of them, rad/s."""
        speeds = dict(zip(message.name, message.velocity, strict=False))
        left, right = (
            (speeds[one] + speeds[other]) / 2 for one, other in (self._left, self._right)
        )
        self._take("wheels", message.header.stamp, came, (left, right))
        return max(map(abs, speeds.values()))

    def gyro(self, message: Imu, came: float) -> None:
        """Add a turn rate."""
        self._take("gyro", message.header.stamp, came, (message.angular_velocity.z,))

    def place(self, message: PoseStamped | Odometry, came: float) -> None:
        """Add a position. Its heading, if it has one, is ignored."""
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        spot = pose.position
        self._take("places", message.header.stamp, came, (spot.x, spot.y))

    def _take(self, stream: str, stamp: Time, came: float, values: tuple[float, ...]) -> None:
        made = stamp.to_ns() / NS_PER_S if stamp.sec else None
        self.samples[stream].append(Sample(came, made, values))

    def run(self) -> Run:
        """Return the leg as a run. Raises `LogError` if there are too few wheel samples."""
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
    """Return the times of the samples by the local clock, s.

    Stamps give their spacing if every sample has one and the delay varies little.
    """
    came = np.array([sample.came for sample in samples])
    made = np.array([math.nan if s.made is None else s.made for s in samples])
    if not len(came) or np.isnan(made).any():
        return came
    late = came - made
    if float(np.ptp(late)) > LONGEST_S:
        return came
    return np.asarray(made + float(late.min()))
