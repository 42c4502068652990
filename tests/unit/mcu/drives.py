"""Random drives, the lines that an MCU makes of them, and when a host gets to read those.

The path is the truth; what the session under test makes of the reads is compared with it and with
the floor: every line with its true time. All randomness comes from the seed.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterator
from typing import Literal

import numpy as np
from msgspec import Struct

from acsard.config.settings import DriveConfig, McuConfig, OdometryConfig
from acsard.drive import path as way
from acsard.drive.kinematics import Kinematics
from acsard.drive.odometry import Odometry
from acsard.mcu.feedback import Feedback
from acsard.mcu.session import McuSession
from acsard.values import NS_PER_S, Instant, Pose, Received, WheelSpeeds

RATE = 100.0
PERIOD, DRIFT = 0.01, 2e-4
"""s, and how far an MCU's clock may be off."""

BYTE = 10 / 115200
"""s of a byte on the wire."""

LATENCY, SCHEDULER = 0.016, 0.0003
"""s that an FTDI adapter holds bytes back, and a process waits for its turn in the mean."""

PIECE = 1024
"""Bytes that one read takes."""

ROLLING = WheelSpeeds(1.0, 1.0, 1.0, 1.0)

GRID = 0.001
"""s between the points at which a path is known."""

RIPPLE = 0.03
"""rad/s by which each side's speed varies from report to report."""

AT_REST = 1500
"""Points of a path before which nothing moves: a robot stands while its link comes up. At the end
it stands too: what is on its way then says nothing."""

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
        for wheels in (left, right):
            wheels[:AT_REST] = wheels[int((seconds - 1.0) / GRID) :] = 0.0
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
    """What is between the MCU and us, s and shares."""

    adapter: Adapter = "acm"
    prompted: bool = False
    """It answers our lines, of the time since the last one; else it reports by its own clock."""
    thinking: float = 0.0002
    """By how much it may take longer over one answer than over another."""
    stall: float = 0.0
    stall_every: float = 5.0
    lost: float = 0.0
    burst_every: float = 0.0
    """A burst of lost lines, 0.1 to 0.5 s; 0 is none."""


class Line(Struct):
    """One report: made at `at` s, of the time since `before`."""

    at: float
    before: float
    speeds: WheelSpeeds
    data: bytes


class Host:
    """The session under test, and what others would make of the same lines."""

    def __init__(self, case: Case, seed: int, seconds: float) -> None:
        self.case, self.seconds = case, seconds
        self.rng = rng = np.random.default_rng(seed)
        self.path = Path(rng, seconds)
        self.session = McuSession(McuConfig(), RATE)
        self.found = Odometry(OdometryConfig(), Kinematics(DriveConfig()))
        self.floor, self.by_arrival = Arcs(), Arcs()
        """The session's; with each line's true time; with the time between their arrivals, each
        line's speed since the last."""
        self.lines: list[Line] = []
        self.heard: list[Feedback] = []
        self.now = 0.0
        """When the last step was."""
        self._heard_ns = 0
        self._reported = 0.0
        self._stalls = _times(rng, seconds, case.stall_every, case.stall) if case.stall else []
        self._starts = [start for start, _ in self._stalls]
        every = case.burst_every
        starts = [start for start, _ in _times(rng, seconds, every, 0.0)] if every else []
        self._bursts = [(start, start + rng.uniform(0.1, 0.5)) for start in starts]
        self._phase = rng.uniform(0, LATENCY)

    # the microcontroller

    def report(self, at: float, nominal: float | None) -> Line:
        """The line that it makes at `at` of what the wheels did since the last one."""
        now, then = self.path.angles(at), self.path.angles(self._reported)
        dt = at - self._reported if nominal is None else nominal
        left, right = (round((a - b) / dt, 2) for a, b in zip(now, then, strict=True))
        speeds = WheelSpeeds(right, left, left, right)
        line = Line(at, self._reported, speeds, _encode(speeds))
        self._reported = at
        self.lines.append(line)
        self.floor.roll(left * dt, right * dt)
        return line

    # the way to the host

    def lost(self, line: Line) -> bool:
        """Nothing of it arrives."""
        gone = any(begin <= line.at < end for begin, end in self._bursts)
        return gone or self.rng.random() < self.case.lost

    def delivered(self, line: Line) -> float:
        """When its bytes are in the kernel."""
        at = line.at + len(line.data) * BYTE
        if self.case.adapter == "ftdi":
            return float(np.ceil((at - self._phase) / LATENCY) * LATENCY + self._phase)
        return at + self.rng.uniform(0, 0.001)

    # the host

    def awake(self, at: float) -> float:
        """When a process that wants to run at `at` does."""
        at += self.rng.exponential(SCHEDULER)
        i = bisect.bisect_right(self._starts, at) - 1
        if i >= 0 and at < self._stalls[i][1]:
            at = self._stalls[i][1] + self.rng.exponential(SCHEDULER)
        return at

    def ticks(self) -> Iterator[float]:
        """When the control periods' steps come; those that are missed are left out."""
        at = 0.0
        while True:
            at = max(self.awake((int(at * RATE + 1e-6) + 1) / RATE), at + 1e-6)
            yield at

    def tick(self, at: float) -> bool:
        """A period's step; whether a line leaves with it."""
        self.now = at
        now = _instant(at)
        self._update(now, ())
        return self.session.line(now.mono_ns, ROLLING) is not None

    def read(self, at: float, data: bytes) -> None:
        """What lies in the kernel is read, a piece at a time."""
        for start in range(0, len(data), PIECE):
            now = _instant(at + start / PIECE * 0.0002)
            self._update(now, (Received(now, data[start : start + PIECE]),))

    def _update(self, now: Instant, received: tuple[Received, ...]) -> None:
        for feedback in self.session.update(now, True, 1, received):
            self.heard.append(feedback)
            self.found.fold(feedback)
            since = (feedback.heard_ns - (self._heard_ns or feedback.heard_ns)) / NS_PER_S
            self._heard_ns = feedback.heard_ns
            speeds = feedback.speeds
            self.by_arrival.roll(speeds.front_left * since, speeds.front_right * since)

    # the end

    def errors(self) -> np.ndarray:
        """m and deg from the truth: of the session, of the floor, of arrival times."""
        truth = self._truth()
        rows = []
        for odometry in (self.found, self.floor, self.by_arrival):
            pose = odometry.pose
            turn = math.degrees(math.remainder(pose.yaw - truth.yaw, math.tau))
            rows.append((math.hypot(pose.x - truth.x, pose.y - truth.y), abs(turn)))
        return np.array(rows)

    def _truth(self) -> Pose:
        truth, (left, right) = Arcs(), (0.0, 0.0)
        end = self.lines[-1].at
        for at in (*np.arange(0.005, end, 0.005).tolist(), end):
            (was_left, was_right), (left, right) = (left, right), self.path.angles(at)
            truth.roll(left - was_left, right - was_right)
        return truth.pose


class Arcs:
    """Where a robot of the default size gets by the angles its sides roll, rad."""

    def __init__(self) -> None:
        self._path = way.Path()

    def roll(self, left: float, right: float) -> None:
        self._path.advance((right + left) / 2 * 0.05, (right - left) * 0.05 / 0.30)

    @property
    def pose(self) -> Pose:
        return self._path.pose


def _instant(at: float) -> Instant:
    ns = 10**12 + int(at * NS_PER_S)
    return Instant(ns, ns + WALL_NS)


def _times(
    rng: np.random.Generator, seconds: float, every: float, length: float
) -> list[tuple[float, float]]:
    """Begins and ends of what happens every so often, at no fixed phase."""
    starts = np.arange(every * 0.7, seconds - 1.0, every) + rng.uniform(0, every * 0.2)
    starts += rng.uniform(0, every * 0.1, len(starts))
    return [(start, start + length) for start in starts.tolist()]


def _encode(speeds: WheelSpeeds) -> bytes:
    tokens = [
        f"{letter}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
        for letter, speed in zip("abcd", speeds.as_tuple(), strict=True)
    ]
    return ", ".join(tokens).encode() + b"\r\n"


def drive(case: Case, seed: int, seconds: float) -> Host:
    """All of a drive, read to its end."""
    host = Host(case, seed, seconds)
    if case.prompted:
        _prompted(host)
    else:
        reporting(host)
    return host


def reporting(host: Host) -> None:
    """The MCU makes a line every period of its own clock, and divides by the nominal one."""
    arrivals: deque[tuple[float, bytes]] = deque()
    period = PERIOD * (1 + host.rng.uniform(-DRIFT, DRIFT))
    for k in range(1, int(host.seconds / period)):
        line = host.report(k * period, PERIOD)
        if not host.lost(line):
            arrivals.append((host.delivered(line), line.data))
    for tick in host.ticks():
        _read_until(host, arrivals, tick)
        if not arrivals:
            return
        host.tick(tick)


def _prompted(host: Host) -> None:
    """The MCU answers each line, 1 ms after it has come or later, and divides by the true time."""
    arrivals: deque[tuple[float, bytes]] = deque()
    free = last = 0.0
    for tick in host.ticks():
        _read_until(host, arrivals, tick)
        if tick > host.seconds:
            return
        if not host.tick(tick):
            continue
        made = max(
            tick + 0.0001 + 33 * BYTE + 0.001 + host.rng.uniform(0, host.case.thinking), free
        )
        line = host.report(made, None)
        free = made + len(line.data) * BYTE
        if not host.lost(line):
            last = max(host.delivered(line), last)
            arrivals.append((last, line.data))


def _read_until(host: Host, arrivals: deque[tuple[float, bytes]], tick: float) -> None:
    """What the host gets to read before its next step."""
    while arrivals and arrivals[0][0] < tick:
        at = max(host.awake(arrivals[0][0]), host.now)
        if at >= tick:
            return
        data = b""
        while arrivals and arrivals[0][0] <= at:
            data += arrivals.popleft()[1]
        host.read(at, data)
