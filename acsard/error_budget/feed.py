"""Messages of a running daemon -> what its error budget is made of."""

from __future__ import annotations

import math
from collections import deque

from acsard.config.settings import Config
from acsard.error_budget.budget import Heard
from acsard.error_budget.drive_log import Line
from acsard.messages.schema import (
    DiagnosticArray,
    JointState,
    Message,
    Odometry,
    RobotState,
    TwistStamped,
)
from acsard.values import NS_PER_S

KEYS = ("odom", "wheel_states", "cmd_vel_out")
"""What there is to follow."""

MOST = 60_000
"""Lines that are remembered: ten minutes."""

LEAST_LOST, SHARE_LOST = 3, 0.01
"""Lines of the daemon that may not be here: fewer than both are the ends of what was heard."""

SAMPLED = "checked with samples"
"""The check of a link whose lines carry the encoders' counts, as `diagnostics` have it."""


class Feed:
    """Follows a daemon; `add` each message, then ask what was `heard`."""

    def __init__(self, config: Config, first: RobotState) -> None:
        """`first` is the state just before the first message."""
        self._config, self._first = config, first
        self._start_ns = first.stamp.to_ns()
        self._odom: dict[int, Odometry] = {}
        self._lines: deque[tuple[int, Line]] = deque(maxlen=MOST)
        self._sent: deque[int] = deque(maxlen=MOST)
        self._wheels: dict[int, JointState] = {}
        self._count = 0

    def add(self, message: Message) -> None:
        """One of `KEYS`, each in its order."""
        if isinstance(message, TwistStamped):
            self._sent.append(message.header.stamp.to_ns())
        elif isinstance(message, Odometry):
            self._odom[message.header.stamp.to_ns()] = message
            self._join(message.header.stamp.to_ns())
        elif isinstance(message, JointState):
            self._wheels[message.header.stamp.to_ns()] = message
            self._join(message.header.stamp.to_ns())

    def heard(self, last: RobotState, diagnostics: DiagnosticArray) -> Heard:
        """All so far; both are of now."""
        lines, zero = [line for _, line in self._lines], self._start_ns
        learned, deviation, used = _learned(diagnostics)
        return Heard(
            lines,
            [(at - zero) / NS_PER_S for at in self._sent],
            whole=self._whole(last),
            counted=self._config.mcu.wants_samples and _value(diagnostics, "check") == SAMPLED,
            gyro=last.gyro in ("used", "disagrees"),
            learned=learned,
            deviation=deviation,
            used=used,
        )

    def _join(self, stamp_ns: int) -> None:
        """A line when both of its messages are here; several of one stamp count as they come."""
        odom, wheels = self._odom.get(stamp_ns), self._wheels.get(stamp_ns)
        if odom is None or wheels is None:
            for waiting in (self._odom, self._wheels):
                if len(waiting) > 100:  # the other one was lost
                    del waiting[next(iter(waiting))]
            return
        del self._odom[stamp_ns], self._wheels[stamp_ns]
        q, covariance = odom.pose.pose.orientation, odom.pose.covariance
        a, b, c, d = wheels.velocity
        e, f, g, h = wheels.position
        at = (stamp_ns - self._start_ns) / NS_PER_S
        yaw = 2 * math.atan2(q.z, q.w)
        self._lines.append((stamp_ns, Line(at, (a, b, c, d), (e, f, g, h), yaw, covariance[35])))
        self._count += 1

    def _whole(self, last: RobotState) -> bool:
        rates, before = self._config.rates, self._first.counters
        if rates.odom or rates.wheel_states:
            return False
        lines, impossible = (
            last.counters.get(name, 0) - before.get(name, 0)
            for name in ("lines", "line_impossible")
        )
        lost = lines - impossible - self._count
        return lost <= max(LEAST_LOST, SHARE_LOST * lines)


def _value(diagnostics: DiagnosticArray, key: str) -> str:
    """The first value of this name in any row, "" for none."""
    rows = (value for status in diagnostics.status for value in status.values)
    return next((value.value for value in rows if value.key == key), "")


def _learned(diagnostics: DiagnosticArray) -> tuple[float | None, float, bool]:
    """The track that a gyro implies, as a share of the configured one, its deviation, its use."""
    names = ("learned_multiplier", "wheel_separation_multiplier", "learned_multiplier_std")
    learned, configured, std = (_value(diagnostics, name) for name in names)
    used = _value(diagnostics, "multiplier_in_use") == learned != configured
    try:
        return float(learned) / float(configured), float(std) / float(learned), used
    except (ValueError, ZeroDivisionError):
        return None, 0.0, False
