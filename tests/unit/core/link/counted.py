"""Drives as coarse encoders report them, and the pose from the raw counters for comparison.

A drive is a random path of 450 m with stops: 600 s at 100 Hz. The true path is a chain of arcs
between the wheels' true angles at each report. The pose from the raw counters uses whole counts
instead of these angles. This module is written in numpy from the equations and shares no code with
the modules that it tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acsard.core.config.settings import FeedbackConfig, McuConfig
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.session import McuSession
from acsard.core.motion.sanity import Sanity
from acsard.core.values import Instant, Received
from tests.unit.core.motion.odometer import Odometer

Array = NDArray[np.float64]
RADIUS, TRACK, PERIOD = 0.05, 0.30, 0.01
PERIOD_NS = 10_000_000
WALL_NS = 1_800_000_000_000_000_000


def speeds(rng: np.random.Generator, seconds: float) -> Array:
    """Return the mean speeds of both sides in each period, rad/s, shape (periods, 2).

    The right side comes first.
    """
    v = w = 0.0
    rows, goal, left = [], (0.0, 0.0), 100
    for _ in range(round(seconds / PERIOD)):
        if left == 0:
            stop = rng.random() < 0.1
            goal = (0.0, 0.0) if stop else (rng.uniform(0.6, 1.2), rng.uniform(-1.2, 1.2))
            left = int(rng.uniform(50, 400))
        left -= 1
        v += max(-PERIOD, min(PERIOD, goal[0] - v))
        w += max(-4 * PERIOD, min(4 * PERIOD, goal[1] - w))
        rows.append(((v + w * TRACK / 2) / RADIUS, (v - w * TRACK / 2) / RADIUS))
    return np.array(rows)


def angles(rng: np.random.Generator, seconds: float) -> Array:
    """Return the wheels' true angles, rad, shape (periods + 1, 4).

    Each wheel starts at a random angle.
    """
    sides = speeds(rng, seconds) * PERIOD
    wheels = np.vstack([np.zeros(4), np.cumsum(sides[:, [0, 1, 1, 0]], axis=0)])
    return wheels + rng.uniform(0, math.tau, 4)


def counted(wheels: Array, counts: int | NDArray[np.int_]) -> Array:
    """Return the whole counts of each wheel in each period, shape (periods, 4).

    `counts` is the number of counts per turn.
    """
    deltas: Array = np.diff(np.floor(wheels / math.tau * counts), axis=0)
    return deltas


def end(turned: Array) -> tuple[float, float]:
    """Return the final x and y, m, of a chain of exact arcs between these wheel angles."""
    right, left = (turned[:, 0] + turned[:, 3]) / 2, (turned[:, 1] + turned[:, 2]) / 2
    distance, turn = (right + left) / 2 * RADIUS, (right - left) * RADIUS / TRACK
    heading = np.cumsum(turn) - turn / 2
    chord = distance * np.sinc(turn / math.tau)
    return float(np.sum(chord * np.cos(heading))), float(np.sum(chord * np.sin(heading)))


def text(row: Array) -> bytes:
    """Return the line that firmware writes for these speeds."""
    return (
        ",".join(
            f"{motor}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
            for motor, speed in zip("abcd", row.tolist(), strict=True)
        ).encode()
        + b"\r\n"
    )


class Host:
    """The host's path from lines to a pose: session, slew check, odometry as in `core/robot.py`."""

    def __init__(self, feedback: FeedbackConfig | None = None, counts: int = 0) -> None:
        """`counts` is the configured number of counts per turn, or 0 if it is unknown."""
        self.setup = LinkSetup.of(McuConfig(encoder_counts=counts), 100.0)
        self.session = McuSession()
        self.sanity, self.fastest = Sanity(), (feedback or FeedbackConfig()).wheel_speed
        self.odometry = Odometer(counts=counts)
        self.now_ns = 1_000_000_000
        self.lines = self.dropped = 0
        self.why = ""

    def receive(self, line: bytes, after_ns: int = PERIOD_NS) -> None:
        self.now_ns += after_ns
        now = Instant(self.now_ns, self.now_ns + WALL_NS)
        for feedback in self.session.update(self.setup, now, True, 1, (Received(now, line),)):
            self.lines += 1
            why = self.sanity.impossible(feedback, self.fastest)
            if why:
                self.why = why
                self.dropped += 1
                self.odometry.skip(feedback)
            else:
                self.odometry.fold(feedback)


def lines(wheels: Array, counts: int) -> Iterator[bytes]:
    """Yield the lines of firmware that divides counts by the nominal period."""
    for row in counted(wheels, counts) * (math.tau / counts / PERIOD):
        yield text(row)
