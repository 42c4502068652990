"""Random drives, the lines that an MCU makes from them, and the times at which a host reads them.

The tests compare the pose of the session under test with that of the encoders' counts. No motor is
simulated: the path is given at each instant, so that an error of a pose is one of the link's times
only. The seed determines all random numbers. Times are in s.
"""

from __future__ import annotations

import binascii
import bisect
import math
from collections import deque
from collections.abc import Iterator
from statistics import fmean
from typing import Literal

import numpy as np
from msgspec import Struct

from acsard.core.config.settings import McuConfig, WheelMap
from acsard.core.link.feedback import Line
from acsard.core.link.link_output import QUESTION_LINE, Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.session import McuSession
from acsard.core.values import AT_REST, NS_PER_S, Instant, Pose, Received, WheelSpeeds
from tests.unit.odometer import Odometer, arc

RATE, PERIOD = 100.0, 0.01
DRIFT = 2e-4  # largest relative drift of an MCU's clock
LEAST_WINDOW = 0.004  # in which the firmware counts before it computes new speeds
BYTE = 10 / 115200  # time of one byte on the wire
LATENCY = 0.016  # for which an FTDI adapter holds bytes back
SCHEDULER = 0.0003  # mean wait of a process for its core
PIECE = 1024  # bytes that one read takes
ROLLING = WheelSpeeds(1.0, 1.0, 1.0, 1.0)
GRID = 0.001  # time between the points of a path
RIPPLE = 0.03  # variation of each side's speed from report to report, rad/s
# The robot stands while its link starts, and at the end, so that lines still on their way do not
# matter.
AT_REST_S = 1.5
WALL_NS = 1_800_000_000 * NS_PER_S

Adapter = Literal["acm", "ftdi"]


class Case(Struct, frozen=True):
    """Properties of the connection between MCU and host. Shares are from 0 to 1.

    A prompted MCU answers the host's lines, at times that differ by `thinking`. Each answer covers
    the time since the last one. Otherwise the MCU reports by its own clock. `counts` are those of a
    turn; 0 means that the encoders have no steps. On a `checked` link, commands and replies have a
    number and a checksum, and replies have the counts, too.
    """

    adapter: Adapter = "acm"
    prompted: bool = False
    thinking: float = 0.0002
    stall: float = 0.0
    stall_every: float = 5.0
    lost: float = 0.0
    counts: int = 0
    checked: bool = False
    wheels: WheelMap = WheelMap()


def _path(rng: np.random.Generator, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the wheel angles of the left and right side in a drive with turns and stops."""
    count = int((seconds + 2.0) / GRID)
    linear = _ramped(rng, count, 0.6, 1.0)
    angular = _ramped(rng, count, -1.0, 4.0)
    sides = []
    for side in (-1, 1):
        # No wheel turns so evenly that two decimals always round it the same way.
        ripple = np.repeat(rng.normal(0, RIPPLE, count // 10 + 1), 10)[:count]
        speeds = (linear + side * angular * 0.15) / 0.05 + ripple
        speeds[: int(AT_REST_S / GRID)] = speeds[int((seconds - 1.0) / GRID) :] = 0.0
        sides.append(np.concatenate([[0.0], np.cumsum(speeds) * GRID]))
    return sides[0], sides[1]


def _ramped(rng: np.random.Generator, count: int, lowest: float, rate: float) -> np.ndarray:
    """Return a speed that changes at `rate` towards targets up to 1, of which a sixth are zero."""
    targets = np.empty(0)
    while len(targets) < count:
        target = 0.0 if rng.random() < 1 / 6 else rng.uniform(lowest, 1.0)
        targets = np.concatenate([targets, np.full(int(rng.uniform(0.8, 4.0) / GRID), target)])
    speeds, speed = np.empty(count), 0.0
    for i, target in enumerate(targets[:count].tolist()):
        speed += min(max(target - speed, -rate * GRID), rate * GRID)
        speeds[i] = speed
    return speeds


class Host:
    """The session under test, its pose, and the pose from the encoders' counts.

    `made` has the time of each line's sample, `heard` the feedback of the session.
    """

    def __init__(self, case: Case, seed: int, seconds: float) -> None:
        self.case, self.seconds = case, seconds
        self.rng = rng = np.random.default_rng(seed)
        self.left, self.right = _path(rng, seconds)
        mcu = McuConfig(
            reply_period=0.0 if case.prompted else PERIOD,
            encoder_counts=case.counts,
            link_check="on" if case.checked else "off",
            wheels=case.wheels,
        )
        self.setup, self.session, self.out = LinkSetup.of(mcu, RATE), McuSession(), Output()
        self.found = Odometer(counts=case.counts, wheels=case.wheels)
        self.counted = Pose()
        self.made: list[float] = []
        self.heard: list[Line] = []
        self.now = self._reported = 0.0  # times of the last step, and of the last new speeds
        self._wheels = self._turned(0.0)
        self._speeds = (0.0,) * len(self._wheels)
        starts = np.arange(case.stall_every * 0.7, seconds - 1.0, case.stall_every)
        starts += rng.uniform(0, case.stall_every * 0.1, len(starts))
        self._stalls: list[float] = starts.tolist() if case.stall else []
        self._phase = rng.uniform(0, LATENCY)

    # the microcontroller

    def report(self, at: float, nominal: float | None, command: bytes = b"") -> bytes:
        """Return the MCU's next line, with the mean speeds since its last line.

        If that was less than `LEAST_WINDOW` ago, the line repeats its speeds.
        """
        self.made.append(at)
        if at - self._reported >= LEAST_WINDOW:
            then, now = self._wheels, self._turned(at)
            dt = at - self._reported if nominal is None else nominal
            angles = [after - before for after, before in zip(now, then, strict=True)]
            self._wheels, self._reported = now, at
            self._speeds = tuple([round(angle / dt, 2) for angle in angles])
            right, left = fmean(angles[0::3]) * 0.05, fmean(angles[1:3]) * 0.05
            self.counted = arc(self.counted, (right + left) / 2, (right - left) / 0.30)
        data = ", ".join(
            f"{letter}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
            for letter, speed in self._by_letter(self._speeds)
        ).encode()
        if b"#" in command:
            data += b"#" + command[command.index(b"#") + 1 :][:2]
            if counts := self.case.counts:
                turns = [round(a * counts / math.tau) for _, a in self._by_letter(self._wheels)]
                fields = [int(self._reported * 1000), *turns]
                data += b"@" + b"".join(b"%04X" % (field % 65536) for field in fields)
            data += b"*%04X" % binascii.crc_hqx(data, 0)
        return data + b"\r\n"

    def _by_letter(self, wheels: tuple[float, ...]) -> list[tuple[str, float]]:
        motors = [motor[1] for motor in self.case.wheels.motors]
        return sorted(zip(motors, wheels, strict=True))

    def _turned(self, at: float) -> tuple[float, ...]:
        """Return the angles of the wheels by their encoders, rad, in the order of their names."""
        i = int(at / GRID)
        share = at / GRID - i
        left, right = (
            float(side[i] + (side[i + 1] - side[i]) * share) for side in (self.left, self.right)
        )
        wheels = (right, left, left, right)[: len(self.case.wheels.names)]
        if not self.case.counts:
            return wheels
        per_turn = self.case.counts
        # The edges of the encoders are not at the same angles.
        edges = zip(wheels, (0.0, 0.6, 0.1, 0.4), strict=False)
        return tuple(
            math.floor(angle / math.tau * per_turn + edge) * math.tau / per_turn
            for angle, edge in edges
        )

    # the path to the host

    def delivered(self, at: float, data: bytes) -> float | None:
        """Return when the kernel has the bytes of a line, or None if the connection loses it."""
        if self.rng.random() < self.case.lost:
            return None
        at += len(data) * BYTE
        if self.case.adapter == "ftdi":
            return float(np.ceil((at - self._phase) / LATENCY) * LATENCY + self._phase)
        return at + self.rng.uniform(0, 0.001)

    # the host

    def awake(self, at: float) -> float:
        """Return the time at which a process that is due at `at` really runs."""
        at += self.rng.exponential(SCHEDULER)
        i = bisect.bisect_right(self._stalls, at) - 1
        if i >= 0 and at < self._stalls[i] + self.case.stall:
            at = self._stalls[i] + self.case.stall + self.rng.exponential(SCHEDULER)
        return at

    def ticks(self) -> Iterator[float]:
        """Yield the times of the control steps. A step that a stall prevents has no time."""
        at = 0.0
        while True:
            at = max(self.awake((int(at * RATE + 1e-6) + 1) / RATE), at + 1e-6)
            yield at

    def tick(self, at: float) -> bytes | None:
        """Run one control step, and return the line that the host sends in it."""
        self.now = at
        now = _instant(at)
        self._update(now, ())
        session, out, now_ns = self.session, self.out, now.mono_ns
        line = session.line(self.setup, out, now_ns, ROLLING)
        if line is not None:
            silent = session.silent(now_ns)
            out.wrote(self.setup, line, now_ns, now_ns, AT_REST, ROLLING, silent=silent, trip=False)
        if line == QUESTION_LINE:
            session.asks(now_ns)
        return line

    def read(self, arrivals: deque[tuple[float, bytes]], tick: float) -> None:
        """Read, piece by piece, everything that the host can read before its next step."""
        while arrivals and arrivals[0][0] < tick:
            at = max(self.awake(arrivals[0][0]), self.now)
            if at >= tick:
                return
            data = b""
            while arrivals and arrivals[0][0] <= at:
                data += arrivals.popleft()[1]
            for start in range(0, len(data), PIECE):
                now = _instant(at + start / PIECE * 0.0002)
                self._update(now, (Received(now, data[start : start + PIECE]),))

    def _update(self, now: Instant, received: tuple[Received, ...]) -> None:
        self.session.steps.begin(self.setup, now.mono_ns)
        for feedback in self.session.update(self.setup, self.out, now, True, 1, received):
            self.heard.append(feedback)
            self.found.fold(feedback)


def _instant(at: float) -> Instant:
    ns = 10**12 + int(at * NS_PER_S)
    return Instant(ns, ns + WALL_NS)


def drive(case: Case, seed: int, seconds: float) -> Host:
    """Simulate a whole drive and return its host."""
    host = Host(case, seed, seconds)
    (_prompted if case.prompted else _reporting)(host)
    return host


def _reporting(host: Host) -> None:
    """Simulate an MCU that makes a line in every period of its own clock.

    The MCU divides the counts by the nominal period.
    """
    arrivals: deque[tuple[float, bytes]] = deque()
    period = PERIOD * (1 + host.rng.uniform(-DRIFT, DRIFT))
    for k in range(1, int(host.seconds / period)):
        data = host.report(k * period, PERIOD)
        if (came := host.delivered(k * period, data)) is not None:
            arrivals.append((came, data))
    for tick in host.ticks():
        host.read(arrivals, tick)
        if not arrivals:
            return
        host.tick(tick)


def _prompted(host: Host) -> None:
    """Simulate an MCU that answers each line after 1 ms or more.

    The MCU divides the counts by the true time since its last line.
    """
    arrivals: deque[tuple[float, bytes]] = deque()
    free = last = 0.0
    for tick in host.ticks():
        host.read(arrivals, tick)
        if tick > host.seconds:
            return
        command = host.tick(tick)
        if command is None or command.startswith(b"?"):
            continue
        thinking = 0.0011 + host.rng.uniform(0, host.case.thinking)
        made = max(tick + 33 * BYTE + thinking, free)
        data = host.report(made, None, command)
        free = made + len(data) * BYTE
        if (came := host.delivered(made, data)) is not None:
            last = max(came, last)
            arrivals.append((last, data))
