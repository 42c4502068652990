"""Follows a running daemon, and collects its messages for the error budget."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Mapping

from acsard.bus.subscription import encoded
from acsard.calibration.error_budget.budget import Budget, DriveMessages, budget
from acsard.calibration.error_budget.measured_errors import Line
from acsard.client import Client, Subscription
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.client.synchronous import decoder
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import (
    DiagnosticArray,
    JointState,
    Message,
    Odometry,
    RobotState,
    TwistStamped,
)
from acsard.core.values import NS_PER_S
from acsard.host.errors import ReplyError

KEYS = ("odom", "wheel_states", "cmd_vel_out")
"""Zenoh keys of the messages that an error budget needs."""

MAX_LINES = 60_000
"""Maximum number of feedback lines that are kept: ten minutes at 100 Hz.

Older lines are dropped.
"""

MAX_COARSE_FRACTION = 0.1
"""If more than this fraction of the feedback lines shows coarse encoders, the report says so."""

LEAST_LOST, SHARE_LOST = 3, 0.01
"""Limits for the number of feedback lines that this program missed.

At most `LEAST_LOST` lines may be missed, or the fraction `SHARE_LOST` of all lines if that is
more. A few lines always seem to be missed, because this program reads the daemon's counters and
messages at different moments.
"""

SAMPLED_CHECK = "checked with samples"
"""Value of `check` in the message `diagnostics` if feedback lines carry samples.

The samples are encoder counts and the microcontroller's time.
"""

POLL_PERIOD_S = 0.05
"""Interval at which the message queues are polled, s."""


def budgets(robot: Client, config: Config, seconds: float) -> Iterator[Budget]:
    """Yield the error budget of the whole drive so far, every `seconds` s.

    Raises `ReplyError` if no feedback lines arrive, or if a message cannot be decoded.
    """
    queues = {key: robot.subscribe(key) for key in KEYS}
    _await_line(robot, queues["wheel_states"])
    feed = MessageCollector(config, robot.get("state"))
    while True:
        _follow(feed, queues, seconds)
        yield budget(feed.received(robot.get("state"), robot.get("diagnostics")), config)


def _await_line(robot: Client, lines: Subscription) -> None:
    """Wait for the first feedback line, after which messages on all of `KEYS` arrive.

    Raises `ReplyError` if no line arrives within `FIRST_STATE_TIMEOUT_S`.
    """
    end = time.monotonic() + FIRST_STATE_TIMEOUT_S
    while lines.try_recv() is None:
        if time.monotonic() > end:
            raise ReplyError(f"the daemon receives no feedback lines: {robot.get('state').reason}")
        time.sleep(POLL_PERIOD_S)


def _follow(feed: MessageCollector, queues: Mapping[str, Subscription], seconds: float) -> None:
    decoders = {key: decoder(key) for key in queues}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(POLL_PERIOD_S)
        for key, queue in queues.items():
            while (sample := queue.try_recv()) is not None:
                try:
                    feed.add(decoders[key].decode(*encoded(sample)))
                except DecodeError as error:
                    raise ReplyError(
                        f"cannot read the daemon's messages on the Zenoh key {key} ({error}): if "
                        "the daemon has another version of acsard, use that version here too"
                    ) from None


class MessageCollector:
    """Collects the messages of a daemon.

    Call `add()` for each message, and then `received()`.
    """

    def __init__(self, config: Config, first: RobotState) -> None:
        """Start an empty collection.

        `first` is the daemon's state before the first message.
        """
        self._config, self._first = config, first
        self._start_ns = first.stamp.to_ns()
        self._odom: dict[int, Odometry] = {}
        self._lines: deque[Line] = deque(maxlen=MAX_LINES)
        self._sent: deque[int] = deque(maxlen=MAX_LINES)
        self._wheels: dict[int, JointState] = {}
        self._count = 0

    def add(self, message: Message) -> None:
        """Add a message of one of `KEYS`. The messages of a key must be in order of time."""
        if isinstance(message, TwistStamped):
            self._sent.append(message.header.stamp.to_ns())
        elif isinstance(message, Odometry):
            self._odom[message.header.stamp.to_ns()] = message
            self._join(message.header.stamp.to_ns())
        elif (
            isinstance(message, JointState) and len(message.velocity) == len(message.position) == 4
        ):
            self._wheels[message.header.stamp.to_ns()] = message
            self._join(message.header.stamp.to_ns())

    def received(self, last: RobotState, diagnostics: DiagnosticArray) -> DriveMessages:
        """Return the messages of the drive so far.

        `last` is the daemon's latest state, and `diagnostics` its latest message `diagnostics`.
        """
        learned, deviation, used = _learned(diagnostics)
        return DriveMessages(
            list(self._lines),
            [(at - self._start_ns) / NS_PER_S for at in self._sent],
            complete=self._complete(last),
            counted=self._config.mcu.wants_samples
            and _value(diagnostics, "check") == SAMPLED_CHECK,
            gyro=last.gyro in ("used", "disagrees"),
            learned=learned,
            deviation=deviation,
            used=used,
            coarse=self._coarse(last),
        )

    def _coarse(self, last: RobotState) -> bool:
        lines, coarse = (self._counted(last, name) for name in ("lines", "coarse_encoder_lines"))
        return coarse > MAX_COARSE_FRACTION * lines

    def _counted(self, last: RobotState, name: str) -> int:
        return last.counters.get(name, 0) - self._first.counters.get(name, 0)

    def _join(self, stamp_ns: int) -> None:
        odom, wheels = self._odom.get(stamp_ns), self._wheels.get(stamp_ns)
        if odom is None or wheels is None:
            for waiting in (self._odom, self._wheels):
                if len(waiting) > 100:  # the counterpart of the oldest message was lost
                    del waiting[next(iter(waiting))]
            return
        del self._odom[stamp_ns], self._wheels[stamp_ns]
        q, covariance = odom.pose.pose.orientation, odom.pose.covariance
        a, b, c, d = wheels.velocity
        e, f, g, h = wheels.position
        at = (stamp_ns - self._start_ns) / NS_PER_S
        yaw = 2 * math.atan2(q.z, q.w)
        self._lines.append(Line(at, (a, b, c, d), (e, f, g, h), yaw, covariance[35]))
        self._count += 1

    def _complete(self, last: RobotState) -> bool:
        """Return whether this program received nearly every feedback line of the daemon."""
        rates = self._config.rates
        if rates.odom or rates.wheel_states:
            return False
        lines, impossible = (self._counted(last, name) for name in ("lines", "line_implausible"))
        lost = lines - impossible - self._count
        return lost <= max(LEAST_LOST, SHARE_LOST * lines)


def _value(diagnostics: DiagnosticArray, key: str) -> str:
    rows = (value for status in diagnostics.status for value in status.values)
    return next((value.value for value in rows if value.key == key), "")


def _learned(diagnostics: DiagnosticArray) -> tuple[float | None, float, bool]:
    """Read from `diagnostics` which effective track the daemon has learned with the gyro.

    The results are the fields `learned`, `deviation` and `used` of `DriveMessages`.
    """
    names = ("learned_multiplier", "wheel_separation_multiplier", "learned_multiplier_std")
    learned, configured, std = (_value(diagnostics, name) for name in names)
    used = _value(diagnostics, "multiplier_in_use") == learned != configured
    try:
        return float(learned) / float(configured), float(std) / float(learned), used
    except (ValueError, ZeroDivisionError):
        return None, 0.0, False
