"""Random drives, the lines that an MCU makes of them, and when a host gets to read those.

The path is the truth; what the session under test makes of the reads is compared with it and with
the floor: every line with its true time. All randomness comes from the seed.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from msgspec import Struct

from acsard.config.settings import DriveConfig, McuConfig, OdometryConfig
from acsard.drive.kinematics import Kinematics
from acsard.drive.odometry import Odometry
from acsard.mcu.feedback import Feedback
from acsard.mcu.session import McuSession
from acsard.values import NS_PER_S, Instant, Pose, Received, WheelSpeeds

GRID = 0.001
"""s between the points at which a path is known."""

RIPPLE = 0.03
"""rad/s by which each side's speed varies from report to report."""

AT_REST = 1500
"""Points of a path before which nothing moves: a robot stands while its link comes up."""

WALL_NS = 1_800_000_000 * NS_PER_S

Adapter = Literal["acm", "ftdi"]


class Path:
    """Wheel angles of both sides over time, of a drive with turns and stops."""

    def __init__(self, rng: np.random.Generator, seconds: float) -> None:
        count = int((seconds + 2.0) / GRID)
        linear = _ramped(rng, count, 1.0, 1.0, lowest=0.6)
        angular = _ramped(rng, count, 1.0, 4.0)
        left = (linear - angular * 0.15) / 0.05
        right = (linear + angular * 0.15) / 0.05
        # No wheel turns so evenly that two decimals always round it the same way.
        left += np.repeat(rng.normal(0, RIPPLE, count // 10 + 1), 10)[:count]
        right += np.repeat(rng.normal(0, RIPPLE, count // 10 + 1), 10)[:count]
        left[:AT_REST] = right[:AT_REST] = 0.0
        self.left = np.concatenate([[0.0], np.cumsum(left) * GRID])
        self.right = np.concatenate([[0.0], np.cumsum(right) * GRID])

    def angles(self, at: float) -> tuple[float, float]:
        """rad that the left and the right wheels have turned by `at` s."""
        place = at / GRID
        i = int(place)
        share = place - i
        left, right = self.left, self.right
        return (
            float(left[i] + (left[i + 1] - left[i]) * share),
            float(right[i] + (right[i + 1] - right[i]) * share),
        )


def _ramped(
    rng: np.random.Generator, count: int, most: float, rate: float, lowest: float | None = None
) -> np.ndarray:
    """A speed that goes at `rate` to one random target after the other, a sixth of them zero."""
    lowest = -most if lowest is None else lowest
    targets = np.empty(0)
    while len(targets) < count:
        target = 0.0 if rng.random() < 1 / 6 else rng.uniform(lowest, most)
        targets = np.concatenate([targets, np.full(int(rng.uniform(0.8, 4.0) / GRID), target)])
    speeds, speed = np.empty(count), 0.0
    for i, target in enumerate(targets[:count].tolist()):
        speed += min(max(target - speed, -rate * GRID), rate * GRID)
        speeds[i] = speed
    return speeds


class Case(Struct, frozen=True):
    """What is between the MCU and us."""

    adapter: Adapter = "acsm"  # type: ignore[assignment]
    prompted: bool = False
    stall: float = 0.0
    stall_every: float = 5.0
    lost: float = 0.0
    burst: tuple[float, float] = (0.0, 0.0)
    burst_every: float = 30.0
    period: float = 0.01
    drift: float = 100e-6
    baud_rate: int = 115200


class Line(Struct):
    """One report: made at `at` s, of the time since `before`."""

    at: float
    before: float
    speeds: WheelSpeeds
    data: bytes


class Host:
    """The session under test, its odometry, and the floor's."""

    def __init__(self, case: Case, seed: int, seconds: float) -> None:
        self.case, self.rng, self.seconds = case, np.random.default_rng(seed), seconds
        self.path = Path(self.rng, seconds)
        mcu = McuConfig(baud_rate=115200)
        self.session = McuSession(mcu, 100.0)
        self.kinematics = Kinematics(DriveConfig())
        self.odometry = Odometry(OdometryConfig(), self.kinematics)
        self.floor = Odometry(OdometryConfig(), self.kinematics)
        self.arrival = Odometry(OdometryConfig(), self.kinematics)
        self.truth = Pose()
        self.lines: list[Line] = []
        self.heard: list[Feedback] = []
        self._arrived: int | None = None
        self._arrived_speeds = WheelSpeeds()
        self._reported = 0.0
        rng = self.rng
        self.stalls = _times(rng, seconds, case.stall_every, case.stall) if case.stall else []
        self.bursts = (
            [(b, b + rng.uniform(*case.burst)) for b, _ in _times(rng, seconds, case.burst_every, 0)]
            if case.burst[1]
            else []
        )
        self._stall_starts = [s for s, _ in self.stalls]
        self._phase = rng.uniform(0, 0.016)

    # the microcontroller

    def report(self, at: float, nominal: float | None) -> Line:
        """The line that it makes at `at` of what the wheels did since the last one."""
        left, right = self.path.angles(at)
        before_left, before_right = self.path.angles(self._reported)
        dt = at - self._reported if nominal is None else nominal
        l, r = (round((a - b) / dt, 2) for a, b in ((left, before_left), (right, before_right)))
        line = Line(at, self._reported, WheelSpeeds(r, l, l, r), _encode(r, l, l, r))
        self._reported = at
        self.lines.append(line)
        self.floor.fold(Feedback(Instant(0, 0), line.speeds, dt))
        return line

    def lost(self, at: float) -> bool:
        return self.rng.random() < self.case.lost or any(b <= at < e for b, e in self.bursts)

    # the way to the host

    def delivered(self, line: Line) -> float:
        """When its bytes are in the kernel."""
        at = line.at + len(line.data) * 10 / 115200
        if self.case.adapter == "ftdi":
            return math.ceil((at - self._phase) / 0.016) * 0.016 + self._phase
        return at + float(self.rng.uniform(0, 0.001))

    def awake(self, at: float) -> float:
        """When a process that wants to run at `at` does."""
        at += float(self.rng.exponential(0.0003))
        i = bisect.bisect_right(self._stall_starts, at) - 1
        if i >= 0 and at < self.stalls[i][1]:
            at = self.stalls[i][1] + float(self.rng.exponential(0.0003))
        return at

    # the host

    def read(self, at: float, data: bytes) -> None:
        for start in range(0, len(data), 1024):
            now = self.instant(at + start / 1024 * 0.0002)
            self.update(now, (Received(now, data[start : start + 1024]),))

    def instant(self, at: float) -> Instant:
        ns = 10**12 + int(at * NS_PER_S)
        return Instant(ns, ns + WALL_NS)

    def update(self, now: Instant, received: tuple[Received, ...]) -> None:
        for feedback in self.session.update(now, True, 1, received):
            self.heard.append(feedback)
            self.odometry.fold(feedback)
            heard_ns, self._arrived = getattr(feedback, "heard_ns", 0), self._arrived
            dt = (heard_ns - (self._arrived or heard_ns)) / NS_PER_S
            self._arrived = heard_ns
            if dt:
                self.arrival.fold(_by_arrival(feedback, dt))

    def tick(self, at: float) -> bool:
        now = self.instant(at)
        self.update(now, ())
        return self.session.line(now.mono_ns, WheelSpeeds(1.0, 1.0, 1.0, 1.0)) is not None


def _by_arrival(feedback: Feedback, dt: float) -> Feedback:
    return Feedback(feedback.at, feedback.speeds, dt, bridged=dt)


def _times(
    rng: np.random.Generator, seconds: float, every: float, length: float
) -> list[tuple[float, float]]:
    starts = np.arange(every * 0.7, seconds - 1.0, every) + rng.uniform(0, every * 0.2, 1)
    return [(s, s + length) for s in (starts + rng.uniform(0, every * 0.1, len(starts))).tolist()]


def _encode(*speeds: float) -> bytes:
    tokens = [
        f"{letter}{'n' if s < 0 else 'p'}{abs(s):05.2f}"
        for letter, s in zip("abcd", speeds, strict=True)
    ]
    return ", ".join(tokens).encode() + b"\r\n"


def drive(case: Case, seed: int, seconds: float) -> Host:
    """All of a drive: `odometry` and `floor` end where they believe to be."""
    host = Host(case, seed, seconds)
    (_prompted if case.prompted else _free)(host)
    end = host.lines[-1].at
    angles = host.path.angles
    truth = Odometry(OdometryConfig(), host.kinematics)
    before = (0.0, 0.0)
    for i in range(1, int(end / 0.005) + 1):
        now = angles(min(i * 0.005, end))
        left, right = now[0] - before[0], now[1] - before[1]
        before = now
        truth.fold(Feedback(Instant(0, 0), WheelSpeeds(right, left, left, right), 1.0))
    host.truth = truth.pose
    return host


def _ticks(host: Host) -> Iterator[float]:
    at, due = 0.0, 0.0
    while due < host.seconds:
        due = max(due + 0.01, math.floor(at / 0.01) * 0.01 + 0.01 * (at > due + 0.01))
        at = max(host.awake(due), at + 1e-6)
        yield at


def _free(host: Host) -> None:
    case = host.case
    period = case.period * (1 + case.drift)
    arrivals: list[tuple[float, bytes]] = []
    for k in range(1, int(host.seconds / period)):
        line = host.report(k * period, case.period)
        if not host.lost(line.at):
            arrivals.append((host.delivered(line), line.data))
    _play(host, arrivals, None)


def _play(host: Host, arrivals: list[tuple[float, bytes]], _: None) -> None:
    ticks, i = _ticks(host), 0
    tick = next(ticks)
    while i < len(arrivals):
        at = host.awake(arrivals[i][0])
        while tick is not None and tick < at:
            host.tick(tick)
            tick = next(ticks, None)  # type: ignore[assignment]
        data = b""
        while i < len(arrivals) and arrivals[i][0] <= at:
            data += arrivals[i][1]
            i += 1
        host.read(at, data)


def _prompted(host: Host) -> None:
    rng, replies = host.rng, []
    ready = 0.0
    wire = 33 * 10 / 115200
    for tick in _ticks(host):
        while replies:
            at = host.awake(replies[0][0])
            if at >= tick:
                break
            data = b""
            while replies and replies[0][0] <= at:
                data += replies.pop(0)[1]
            host.read(at, data)
        if not host.tick(tick):
            continue
        at = max(tick + 0.0001 + wire + float(rng.uniform(0.001, 0.005)), ready)
        ready = at + 0.0031
        line = host.report(at, None)
        if not host.lost(at):
            replies.append((max(host.delivered(line), replies[-1][0] if replies else 0), line.data))
    for at, data in replies:
        host.read(host.awake(at), data)


def error(host: Host, odometry: Odometry) -> tuple[float, float]:
    """m and deg from where it is in truth."""
    pose, truth = odometry.pose, host.truth
    turn = math.remainder(pose.yaw - truth.yaw, math.tau)
    return math.hypot(pose.x - truth.x, pose.y - truth.y), abs(math.degrees(turn))
