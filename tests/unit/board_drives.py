"""Random drives, the lines that an MCU makes from them, and the times at which a host reads them.

The tests compare the pose of the session under test with that of the encoders' counts. The seed
determines all random numbers.
"""

from __future__ import annotations

import binascii
import bisect
import math
from collections import deque
from collections.abc import Iterator
from typing import Literal

import numpy as np
from msgspec import Struct

from acsard.core.config.settings import McuConfig
from acsard.core.link.feedback import Feedback
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.session import McuSession
from acsard.core.values import NS_PER_S, Instant, Pose, Received, WheelSpeeds
from tests.unit.odometer import Odometer, arc

RATE = 100.0
PERIOD, DRIFT = 0.01, 2e-4
"""Report period, s, and largest relative drift of an MCU's clock."""

LEAST_WINDOW = 0.004
"""Time, s, in which the firmware counts before it computes new speeds."""

BYTE = 10 / 115200
"""Time of one byte on the wire, s."""

LATENCY, SCHEDULER = 0.016, 0.0003
"""Time for which an FTDI adapter holds bytes back, and mean wait of a process for its core, s."""

PIECE = 1024
"""Bytes that one read takes."""

ROLLING = WheelSpeeds(1.0, 1.0, 1.0, 1.0)

GRID = 0.001
"""Time between the points of a path, s."""

RIPPLE = 0.03
"""Variation of each side's speed from report to report, rad/s."""

AT_REST = 1500
"""Points of a path before which nothing moves, because a robot stands while its link starts.

The robot also stands at the end, so that lines still on their way do not matter.
"""

WALL_NS = 1_800_000_000 * NS_PER_S

Adapter = Literal["acm", "ftdi"]


class Path:
    """Wheel angles of both sides over time in a drive with turns and stops."""

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
        """Return the angles of the left and right wheels at time `at` in s, rad."""
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
    """Return a speed that changes at `rate` towards random targets.

    A sixth of the targets are zero.
    """
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
    """Properties of the connection between MCU and host. Times are in s, shares are from 0 to 1."""

    adapter: Adapter = "acm"
    prompted: bool = False
    """Whether the MCU answers the host's lines.

    Each answer covers the time since the last one. Otherwise the MCU reports by its own clock.
    """
    thinking: float = 0.0002
    """Largest difference between the times of two answers, s."""
    stall: float = 0.0
    stall_every: float = 5.0
    lost: float = 0.0
    burst_every: float = 0.0
    """Mean time between bursts of 0.1 to 0.5 s of lost lines, s; 0 means that there are none."""
    counts: int = 0
    """Counts per turn of the encoders; 0 means that they have no steps."""
    checked: bool = False
    """Whether commands and replies have a number and a checksum, and replies the counts, too."""


class Line(Struct):
    """One report of mean speeds from `before` to `at`. The MCU makes it at `at`. Times are in s."""

    at: float
    before: float
    speeds: WheelSpeeds
    data: bytes


class Host:
    """The session under test, its pose, and the pose from the encoders' counts."""

    def __init__(self, case: Case, seed: int, seconds: float) -> None:
        self.case, self.seconds = case, seconds
        self.rng = rng = np.random.default_rng(seed)
        self.path = Path(rng, seconds)
        mcu = McuConfig(
            reply_period=0.0 if case.prompted else PERIOD,
            encoder_counts=case.counts,
            link_check="on" if case.checked else "off",
        )
        self.setup, self.session = LinkSetup.of(mcu, RATE), McuSession()
        self.found = Odometer(counts=case.counts)
        self.counter = Arcs()  # the pose from the encoders' counts; `found` is the session's
        self.lines: list[Line] = []
        self.heard: list[Feedback] = []
        self.now = 0.0
        """Time of the last step, s."""
        self._reported = 0.0
        self._wheels = self._turned(0.0)
        self._stalls = _times(rng, seconds, case.stall_every, case.stall) if case.stall else []
        self._starts = [start for start, _ in self._stalls]
        every = case.burst_every
        starts = [start for start, _ in _times(rng, seconds, every, 0.0)] if every else []
        self._bursts = [(start, start + rng.uniform(0.1, 0.5)) for start in starts]
        self._phase = rng.uniform(0, LATENCY)

    # the microcontroller

    def report(self, at: float, nominal: float | None, command: bytes = b"") -> Line:
        """Make the MCU's next line at time `at`, s, with the mean speeds since its last line.

        If that was less than `LEAST_WINDOW` ago, the line repeats its speeds.
        """
        if at - self._reported < LEAST_WINDOW and self.lines:
            speeds = self.lines[-1].speeds
            data = self._encoded(speeds, self._reported, self._wheels, command)
            self.lines.append(Line(at, self._reported, speeds, data))
            return self.lines[-1]
        then, now = self._wheels, self._turned(at)
        self._wheels = now
        dt = at - self._reported if nominal is None else nominal
        a, b, c, d = (after - before for after, before in zip(now, then, strict=True))
        speeds = WheelSpeeds(*(round(angle / dt, 2) for angle in (a, b, c, d)))
        line = Line(at, self._reported, speeds, self._encoded(speeds, at, now, command))
        self._reported = at
        self.lines.append(line)
        self.counter.roll((b + c) / 2, (a + d) / 2)
        return line

    def _turned(self, at: float) -> tuple[float, ...]:
        """Return the angles of the wheels a to d by their encoders, rad."""
        left, right = self.path.angles(at)
        wheels = right, left, left, right
        if not self.case.counts:
            return wheels
        step = math.tau / self.case.counts
        # The edges of the encoders are not at the same angles.
        edges = zip(wheels, (0.0, 0.6, 0.1, 0.4), strict=True)
        return tuple(math.floor(angle / step + edge) * step for angle, edge in edges)

    def _encoded(
        self, speeds: WheelSpeeds, at: float, wheels: tuple[float, ...], command: bytes
    ) -> bytes:
        data = _encode(speeds)
        if b"#" not in command:
            return data
        number, counts = int(command[command.index(b"#") + 1 :][:2], 16), self.case.counts
        line = b"%b#%02X" % (data.strip(), number)
        if counts:
            fields = [
                int(at * 1000),
                *(round(angle * counts / math.tau) for angle in wheels),
            ]
            line += b"@" + b"".join(b"%04X" % (field % 65536) for field in fields)
        return b"%b*%04X\r\n" % (line, binascii.crc_hqx(line, 0))

    # the path to the host

    def lost(self, line: Line) -> bool:
        """Return whether the connection loses this line completely."""
        in_burst = any(begin <= line.at < end for begin, end in self._bursts)
        return in_burst or self.rng.random() < self.case.lost

    def delivered(self, line: Line) -> float:
        """Return the time at which the kernel has the line's bytes."""
        at = line.at + len(line.data) * BYTE
        if self.case.adapter == "ftdi":
            return float(np.ceil((at - self._phase) / LATENCY) * LATENCY + self._phase)
        return at + self.rng.uniform(0, 0.001)

    # the host

    def awake(self, at: float) -> float:
        """Return the time at which a process that is due at `at` really runs."""
        at += self.rng.exponential(SCHEDULER)
        i = bisect.bisect_right(self._starts, at) - 1
        if i >= 0 and at < self._stalls[i][1]:
            at = self._stalls[i][1] + self.rng.exponential(SCHEDULER)
        return at

    def ticks(self) -> Iterator[float]:
        """Yield the times of the control steps, s. A step that a stall prevents has no time."""
        at = 0.0
        while True:
            at = max(self.awake((int(at * RATE + 1e-6) + 1) / RATE), at + 1e-6)
            yield at

    def tick(self, at: float) -> bytes | None:
        """Run one control step, and return the line that the host sends in it."""
        self.now = at
        now = _instant(at)
        self._update(now, ())
        line = self.session.line(self.setup, now.mono_ns, ROLLING)
        self.session.sent(self.setup, now.mono_ns, was_written=True)
        return line

    def read(self, at: float, data: bytes) -> None:
        """Let the host read these bytes piece by piece, as an adapter delivers them."""
        for start in range(0, len(data), PIECE):
            now = _instant(at + start / PIECE * 0.0002)
            self._update(now, (Received(now, data[start : start + PIECE]),))

    def _update(self, now: Instant, received: tuple[Received, ...]) -> None:
        for feedback in self.session.update(self.setup, now, True, 1, received):
            self.heard.append(feedback)
            self.found.fold(feedback)


class Arcs:
    """The pose of a robot of default size, computed from the angles that its sides roll, rad."""

    def __init__(self) -> None:
        self.pose = Pose()

    def roll(self, left: float, right: float) -> None:
        self.pose = arc(self.pose, (right + left) / 2 * 0.05, (right - left) * 0.05 / 0.30)


def _instant(at: float) -> Instant:
    ns = 10**12 + int(at * NS_PER_S)
    return Instant(ns, ns + WALL_NS)


def _times(
    rng: np.random.Generator, seconds: float, every: float, length: float
) -> list[tuple[float, float]]:
    """Return random start and end times, s, of a disturbance that recurs about every `every` s."""
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
    """Simulate a whole drive and return its host."""
    host = Host(case, seed, seconds)
    if case.prompted:
        _prompted(host)
    else:
        reporting(host)
    return host


def reporting(host: Host) -> None:
    """Simulate a free-running MCU, which makes a line in every period of its own clock.

    The MCU divides the counts by the nominal period.
    """
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
    """Simulate a prompted MCU, which answers each line after 1 ms or more.

    The MCU divides the counts by the true time since its last line.
    """
    arrivals: deque[tuple[float, bytes]] = deque()
    free = last = 0.0
    for tick in host.ticks():
        _read_until(host, arrivals, tick)
        if tick > host.seconds:
            return
        command = host.tick(tick)
        if command is None or command.startswith(b"?"):
            continue
        made = max(
            tick + 0.0001 + 33 * BYTE + 0.001 + host.rng.uniform(0, host.case.thinking), free
        )
        line = host.report(made, None, command)
        free = made + len(line.data) * BYTE
        if not host.lost(line):
            last = max(host.delivered(line), last)
            arrivals.append((last, line.data))


def _read_until(host: Host, arrivals: deque[tuple[float, bytes]], tick: float) -> None:
    """Read everything that the host can read before its next step."""
    while arrivals and arrivals[0][0] < tick:
        at = max(host.awake(arrivals[0][0]), host.now)
        if at >= tick:
            return
        data = b""
        while arrivals and arrivals[0][0] <= at:
            data += arrivals.popleft()[1]
        host.read(at, data)


def print_row(name: str, goal: str, result: str) -> None:
    """Print one row of a table of results."""
    print(f"\n{name:46} goal {goal:38} found {result}", end="")
