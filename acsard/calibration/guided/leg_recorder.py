"""Records the samples of one leg of a guided drive, in the form that a log has.

Each sender stamps its messages with its own clock, or not at all, and the clocks need not agree.
The stamps of one key give the intervals between its samples. The sample of a key with the smallest
delay between stamp and arrival is taken to have arrived without delay. The fit finds the delays
that remain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.log_table import Floats, Table
from acsard.calibration.runs import Run, runs
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped, Time
from acsard.core.values import NS_PER_S

STREAMS = {"wheels": ("left", "right"), "gyro": ("yaw_rate",), "places": ("x", "y")}
"""Columns of the log by the source of their samples."""

MOST_JITTER_S = 5.0
"""Largest variation of the delay between stamp and arrival, s. Beyond it, stamps are not used."""


class Sample(Struct, frozen=True):
    """The values of one message, with its time of arrival and its stamp."""

    came: float
    """Time of arrival by this computer's clock, s."""
    made: float | None
    """Stamp by the sender's clock, s; None if the message has no stamp."""
    values: tuple[float, ...]
    """Values in the order of `STREAMS`."""


class Recorder:
    """Collects the samples of one leg. `came` is a message's time of arrival, s."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._right = joints[0], joints[3]
        self._left = joints[1], joints[2]
        self.samples: dict[str, list[Sample]] = {name: [] for name in STREAMS}

    def wheels(self, message: JointState, came: float) -> float:
        """Add wheel speeds and return the speed of the fastest wheel, rad/s."""
        speeds = dict(zip(message.name, message.velocity, strict=False))
        left, right = (
            (speeds[one] + speeds[other]) / 2 for one, other in (self._left, self._right)
        )
        self._add("wheels", message.header.stamp, came, (left, right))
        return max(map(abs, speeds.values()))

    def gyro(self, message: Imu, came: float) -> None:
        """Add the turn rate of a gyro."""
        self._add("gyro", message.header.stamp, came, (message.angular_velocity.z,))

    def place(self, message: PoseStamped | Odometry, came: float) -> None:
        """Add a position. Its heading, if it has one, is ignored."""
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        spot = pose.position
        self._add("places", message.header.stamp, came, (spot.x, spot.y))

    def _add(self, stream: str, stamp: Time, came: float, values: tuple[float, ...]) -> None:
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
    """Return the times of the samples of one stream by this computer's clock, s.

    They are the times of arrival unless every sample has a stamp.
    """
    came = np.array([sample.came for sample in samples])
    made = np.array([math.nan if s.made is None else s.made for s in samples])
    return came if not len(came) or np.isnan(made).any() else on_arrival_clock(came, made)


def on_arrival_clock(came: Floats, made: Floats) -> Floats:
    """Return the times of the samples of one stream by the clock of their arrival, s.

    If the delays vary little, the times are the stamps plus the smallest delay. Otherwise they are
    the times of arrival.

    Args:
        came: the times of arrival, s.
        made: the stamps by the sender's clock, s.
    """
    delay = came - made
    if float(np.ptp(delay)) > MOST_JITTER_S:
        return came
    return np.asarray(made + float(delay.min()))
