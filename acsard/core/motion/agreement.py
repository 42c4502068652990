"""Decides whether a gyro turns as the wheels do, over blocks of 0.2 s.

A gyro is tested in its first turn. One in use is compared over some seconds, and contradicts the
wheels if the turns differ by 15 % and by more than both claim, or steadily while the robot turns to
and fro. It is tested again if it turns the other way, or by a ratio that no floor explains.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct, field

from acsard.core.config.settings import OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Metres, Rad, RadPerS, Seconds

# Motion of each side below which a robot rests: counts, or an angle of its wheels if the counts are
# unknown.
REST_COUNTS, REST_ANGLE = 2, 0.05

BLOCK_S, MAX_BLOCK = 0.2, 0.5  # s, or rad of difference: of the sums that are compared
# Old blocks count less: on straights after this time, and in turns after this angle.
STRAIGHT_MEMORY_S, TURN_MEMORY = 30.0, 10.0
SHARE = 0.15  # of a turn, by which gyro and wheels may differ on any floor after a calibration
# The heading claims a larger share, which may be the gyro's scale, beside a deviation.
UNCLAIMED_SHARE = 0.05
AGREES = 0.5  # deviations, below which a short comparison restarts: a new fault then shows at once
MARGIN = 0.02  # rad, standard deviation of the wheels' turn by encoder counts and vibration
MAX_DELAY_S = 0.05  # a gyro with this delay does not contradict the wheels
DEVIATIONS = 3.0  # of what both claim; more is a contradiction
DISAGREES_S = 5.0  # after a contradiction

# Of a bias that shows while the turns vary: blocks, share of their variance, rad/s of the gyro, and
# share by which tyres are unequal. Wheels slip alike in some blocks.
LEAST_BLOCKS, LEAST_SPREAD, STEADY_RATE, TYRES = 40.0, 0.1, 0.005, 0.003
SIMILAR_BLOCKS = 1.3

# True turn divided by the turn of the wheels, on any floor.
MIN_RATIO, MAX_RATIO = 0.25, 2.5
MIN_TURN_RATE = 0.1  # rad/s of the wheels; less may be a count, or unequal tyres on a straight
# Turns by the wheels, rad, that prove a gyro, and refute it. A gyro in use must prove itself again
# if it turns the other way, or by this angle more than the wheels on any floor. If it turns less,
# the wheels may spin on the spot.
PROVING_TURN, REFUTING_TURN, MAX_MORE = 0.1, 0.4, 0.3
MIN_DEGREES_RATIO, MAX_DEGREES_RATIO = 15.0, 150.0  # 57 without slip and errors

GyroVerdict = Literal["none yet", "good", "reversed", "in degrees", "dead", "not believed"]


class Claims(Struct, frozen=True, gc=False):
    """What the settings say about the turn of the wheels, and the motion of a side at rest."""

    per_metre: float
    per_radian: float
    rest: Metres
    half_track: Metres


def claims(odometry: OdometryConfig, kinematics: Kinematics, counts: int) -> Claims:
    rest = REST_COUNTS * math.tau / counts if counts else REST_ANGLE
    return Claims(
        odometry.yaw_variance_per_metre,
        odometry.yaw_variance_per_radian,
        rest * kinematics.radius,
        kinematics.track / 2,
    )


class Compared(Struct):
    """Sums of lines with turns by both, of which old ones count less."""

    wheels: Rad = 0.0
    gyro: Rad = 0.0
    turned: Rad = 0.0  # by the wheels, to either side
    way: Metres = 0.0
    seconds: Seconds = 0.0
    noise: float = 0.0  # of the gyro, rad2

    def add(self, block: Compared, share: float) -> None:
        self.wheels = share * self.wheels + block.wheels
        self.gyro = share * self.gyro + block.gyro
        self.turned = share * self.turned + abs(block.wheels)
        self.way = share * self.way + block.way
        self.seconds = share * self.seconds + block.seconds
        self.noise = share * self.noise + block.noise

    def difference(self, claims: Claims, bias_variance: float) -> tuple[Rad, Rad]:
        """Return the size of the difference of the turns, and the deviation that both claim."""
        variance = (
            MARGIN**2
            + claims.per_metre * self.way
            + claims.per_radian * self.turned
            + bias_variance * self.seconds**2
            + self.noise
        )
        return abs(self.gyro - self.wheels), math.sqrt(variance)


class Steady(Struct):
    """The part of the difference that does not turn with the wheels: a bias of the gyro.

    Least squares of the blocks' differences over their times and turns. What the turns of the
    wheels are wrong by, in proportion, is no bias, and the scatter shows how sure it is.
    """

    blocks: float = 0.0
    way: Metres = 0.0
    seconds: Seconds = 0.0
    tt: float = 0.0  # sums of products of time, turn of the wheels, and difference
    tw: float = 0.0
    ww: float = 0.0
    td: float = 0.0
    wd: float = 0.0
    dd: float = 0.0

    def add(self, block: Compared) -> None:
        t, w, d = block.seconds, block.wheels, block.gyro - block.wheels
        share = math.exp(-t / STRAIGHT_MEMORY_S)
        self.blocks = share * self.blocks + 1.0
        self.way, self.seconds = share * self.way + block.way, share * self.seconds + t
        self.tt, self.tw = share * self.tt + t * t, share * self.tw + t * w
        self.ww, self.td = share * self.ww + w * w, share * self.td + t * d
        self.wd, self.dd = share * self.wd + w * d, share * self.dd + d * d

    def bias(self, claims: Claims, bias_variance: float) -> RadPerS:
        """Return the bias if it contradicts what both claim, else 0."""
        spread = self.tt * self.ww - self.tw * self.tw
        if self.blocks < LEAST_BLOCKS or spread <= LEAST_SPREAD * self.tt * self.ww:
            return 0.0  # in a constant turn, a bias looks like a scale
        bias = (self.td * self.ww - self.wd * self.tw) / spread
        share = (self.wd * self.tt - self.td * self.tw) / spread
        rest = max(0.0, self.dd - bias * self.td - share * self.wd) / (self.blocks - 2.0)
        variance = SIMILAR_BLOCKS * rest * self.ww / spread + bias_variance
        tyres = TYRES * self.way / (2.0 * claims.half_track * self.seconds)
        most = DEVIATIONS * math.sqrt(variance + tyres * tyres) + STEADY_RATE
        return bias if abs(bias) > most else 0.0


class Agreement(Struct):
    verdict: GyroVerdict = "none yet"
    disagrees_s: Seconds = 0.0  # remaining
    block: Compared = field(default_factory=Compared)
    straight: Compared = field(default_factory=Compared)
    short: Compared = field(default_factory=Compared)  # turns; the test of a gyro, too
    long: Compared = field(default_factory=Compared)
    steady: Steady = field(default_factory=Steady)
    claimed: Rad = 0.0  # of the difference in `long`

    def forget(self) -> None:
        """Forget what was compared; the verdict stays."""
        self.block = Compared()
        self._forget_turns()

    def _forget_turns(self) -> None:
        self.straight, self.short, self.long = Compared(), Compared(), Compared()
        self.steady, self.claimed = Steady(), 0.0

    def add(
        self, wheels: Rad, gyro: Rad, way: Metres, dt: Seconds, noise: float
    ) -> Compared | None:
        """Add the turns of a line, and return the block that it ends."""
        block = self.block
        block.wheels += wheels
        block.gyro += gyro
        block.way += abs(way)
        block.seconds += dt
        block.noise += noise
        if block.seconds < BLOCK_S * 0.95 and abs(block.gyro - block.wheels) <= MAX_BLOCK:
            return None
        self.block = Compared()
        return block

    def test(self, block: Compared, known: bool) -> None:
        """Test a gyro that is not in use; `known`: its bias is."""
        trial = self.short
        if abs(block.wheels) < MIN_TURN_RATE * block.seconds or block.wheels * trial.wheels < 0.0:
            # On a straight, and as the robot begins to turn to the other side, the trial restarts.
            self.short = Compared()
            return
        trial.add(block, 1.0)
        ratio = trial.gyro / trial.wheels
        if MIN_RATIO <= ratio <= MAX_RATIO:
            if known and trial.turned >= PROVING_TURN:
                self.verdict = "good"
        elif trial.turned >= REFUTING_TURN:
            verdict, self.short = _named(ratio), Compared()
            if known or verdict == "in degrees":
                self.verdict = verdict

    def compare(self, block: Compared, claims: Claims, bias_variance: float) -> tuple[bool, Rad]:
        """Return whether the gyro contradicts the wheels now, and by how much the turn may err."""
        turned = abs(block.wheels)
        if turned < MIN_TURN_RATE * block.seconds:
            compared, lag = self.straight, 0.0
            compared.add(block, math.exp(-block.seconds / STRAIGHT_MEMORY_S))
        else:
            compared, lag = self.long, MAX_DELAY_S * turned / block.seconds
            keep = math.exp(-turned / TURN_MEMORY)
            compared.add(block, keep)
            self.claimed *= keep
            self.short.add(block, 1.0)
            off, std = self.short.difference(claims, bias_variance)
            share = SHARE * abs(self.short.wheels)
            if off <= max(AGREES * std, share):
                self.short = Compared()
            elif off > DEVIATIONS * std + lag:
                compared = self.short
        off, std = compared.difference(claims, bias_variance)
        size = abs(compared.wheels)
        contradiction, doubt = off > max(SHARE * size, DEVIATIONS * std + lag), 0.0
        self.steady.add(block)
        bias = self.steady.bias(claims, bias_variance)
        if self.disagrees_s > 0.0:
            doubt = block.gyro - block.wheels
        elif contradiction:
            doubt = compared.gyro - compared.wheels
        elif compared is self.long and off > max(UNCLAIMED_SHARE * size, std + lag):
            claim = max(-SHARE * size, min(compared.gyro - compared.wheels, SHARE * size))
            doubt = claim - self.claimed
            self.claimed = claim
        elif bias:
            doubt = bias * self.steady.seconds
        if contradiction:
            wheels, gyro = abs(compared.wheels), abs(compared.gyro)
            opposite = compared.gyro * compared.wheels < 0.0 and wheels > 2.0 * MARGIN
            if (opposite and gyro > MIN_RATIO * wheels) or gyro > MAX_RATIO * wheels + MAX_MORE:
                self.verdict = "none yet"
        if contradiction or bias:
            self.disagrees_s = DISAGREES_S if self.verdict == "good" else 0.0
            self._forget_turns()
        return contradiction or bias != 0.0, doubt


def _named(ratio: float) -> GyroVerdict:
    if MIN_DEGREES_RATIO <= abs(ratio) <= MAX_DEGREES_RATIO:
        return "in degrees"
    if -MAX_RATIO <= ratio <= -MIN_RATIO:
        return "reversed"
    return "dead" if abs(ratio) < MIN_RATIO else "not believed"
