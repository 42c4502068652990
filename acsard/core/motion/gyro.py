"""Takes the heading from a gyro while the gyro is fresh and agrees with the wheels.

Only the bias is learned, while the robot rests. The wheels give the heading until the gyro has
turned as they do (`agreement.py`), while it is silent, and if it hangs, from the first sample on
that it repeated. If the two turns contradict each other, the gyro is used and their difference
becomes uncertainty of the heading, because wheels may slip.
"""

from __future__ import annotations

import math
from typing import cast, get_args

from msgspec import Struct, field

from acsard.core.codes import Reason, joined, reason
from acsard.core.motion.agreement import MARGIN, MAX_DELAY_S, Agreement, Claims, Compared
from acsard.core.tables.pose_codes import GyroCode
from acsard.core.values import (
    NS_PER_S,
    Event,
    GyroDoes,
    GyroSample,
    GyroStatus,
    Level,
    Metres,
    Ns,
    Rad,
    RadPerS,
    Seconds,
)

# Rest is a zero command and a motion of each side below `Claims.rest`: encoders that stand on an
# edge and filters that never reach zero rest.
REST_S = 0.2

# At rest, until a bias is known: without a higher rate (rad/s), which is a person who turns the
# robot, or a gyro whose noise makes it useless.
LEARNING_TIME_S, LEARNING_SAMPLES, MAX_BIAS = 0.5, 20, 0.2
BIAS_RANDOM_WALK = 1e-4  # of a cheap gyro with temperature, rad/s per square root of a second
MIN_NOISE = 1e-5  # rad/s of a sample: a coarse gyro may repeat one value
NOISE_GAIN = 0.02  # of the noise, about fifty samples
SCATTER_GAIN = 0.1  # of the samples' own noise, in motion, too
MAX_DEVIATIONS = 5.0  # standard deviations of a sample at rest from the bias
VIBRATION = 0.01  # rad/s, in addition

SILENCE_TIMEOUT_NS = NS_PER_S // 5  # until then the robot is assumed to turn at the last rate
MAX_EXTRA_DELAY_NS = NS_PER_S // 4  # above the least one; a later sample says nothing of now
MAX_RISE = 1e-3  # of the least delay: two clocks drift
# A clock was set if samples stay late for this time and their delays do not fall by more.
CLOCK_SET_NS, MAX_DELAY_FALL_NS = NS_PER_S, NS_PER_S // 50
MAX_SWAPPED_NS = NS_PER_S // 50  # between the stamps of two samples in the wrong order

# A larger change of the rate, rad/s, must be confirmed by the next sample, by half at least.
MAX_JUMP, CONFIRMED = 0.5, 0.5

# A gyro hangs if it repeats one exact rate for this time, although at rest it repeats less than
# this share of its samples, so that such a series has less than this probability.
HANG_S, MAX_REPEATING, MIN_CHANCE = 0.5, 0.6, 1e-6

STATUS: dict[GyroDoes, Reason] = {
    does: reason(
        cast("GyroCode", f"gyro_{does.replace(' ', '_')}"),
        seconds=REST_S + LEARNING_TIME_S,
        samples=LEARNING_SAMPLES,
        most=MAX_BIAS,
    )
    for does in get_args(GyroDoes)
    if does != "off"
}


class Turn(Struct, frozen=True, gc=False):
    """The turn since the previous line, by the gyro or by the wheels with a correction."""

    angle: Rad
    variance: float  # rad2, without the error of the gyro's scale
    rate: RadPerS
    rate_variance: float  # rad2/s2
    trusted: Rad | None = None  # the angle, if the wheels agree with it
    slips: bool = False
    doubt: Rad = 0.0  # by which gyro and wheels differ: does not average out


class Bias(Struct):
    """Reading of the gyro at rest, rad/s, with its variance and that of one sample.

    The first estimate is a mean. Then a scalar Kalman filter follows a random walk.
    """

    value: RadPerS = 0.0
    variance: float = MAX_BIAS**2
    noise: float = 0.0
    rested_s: Seconds = 0.0
    samples: int = 0
    shared: float = 0.0  # covariance of the turns up to now with this error, rad2/s

    @property
    def is_known(self) -> bool:
        return self.rested_s >= LEARNING_TIME_S and self.samples >= LEARNING_SAMPLES

    def follow(self, rate: RadPerS, variance: float, scatter: float, span: Seconds) -> bool:
        """Learn from a sample at rest. Return False if it shows a turn."""
        if not self.is_known:
            return self._average(rate, variance, span)
        error, noise = rate - self.value, max(self.noise, variance, MIN_NOISE**2)
        if abs(error) > MAX_DEVIATIONS * math.sqrt(noise + self.variance) + VIBRATION:
            return False
        gain = self.variance / (self.variance + max(noise, scatter))
        self.value += gain * error
        self.variance *= 1.0 - gain
        self.shared *= 1.0 - gain
        self.noise += NOISE_GAIN * ((1.0 - gain) * error * error - self.noise)
        return True

    def _average(self, rate: RadPerS, variance: float, span: Seconds) -> bool:
        if abs(rate) > MAX_BIAS:
            self.rested_s, self.samples = 0.0, 0
            return False
        self.rested_s += span
        self.samples += 1
        error = rate - self.value
        self.value += error / self.samples
        self.noise += (error * (rate - self.value) - self.noise) / self.samples
        self.variance = max(self.noise, variance, MIN_NOISE**2) / self.samples
        return True


class Gyro(Struct):
    """The turns of the robot by the samples of one gyro."""

    does: GyroDoes = "silent"
    reported: GyroDoes = "silent"
    bias: Bias = field(default_factory=Bias)
    used: bool = False  # for the last line

    last: GyroSample | None = None  # in use
    jumped: GyroSample | None = None  # waits for a confirmation of its jump
    heard_ns: Ns | None = None  # last prompt sample
    newest: GyroSample | None = None  # late ones, too
    newest_ns: Ns = 0  # time of the newest one, by its stamp if it has one
    sampled_ns: Ns = 0  # of the sample in use
    least_ns: Ns | None = None  # delay of the stamps
    late_since_ns: Ns | None = None
    late_ns: Ns = 0  # delay then

    rate: RadPerS = 0.0  # now
    step: RadPerS = 0.0  # to the last sample from the one before
    scatter: float = 0.0  # of the samples, rad2/s2
    turned: Rad = 0.0  # by all samples
    given: Rad = 0.0  # of `turned`, with the assumed turn since the last sample
    variance: float = 0.0  # of the rest of `turned`
    # Gyro's minus wheels' turn in lines since the last sample, and since the rate changed.
    since_sample: Rad = 0.0
    since_change: Rad = 0.0

    repeats: int = 0
    repeated_s: Seconds = 0.0
    usual: int = 0  # samples at rest while the gyro did not hang
    usual_repeats: int = 0  # of them
    hangs: bool = False

    rest_s: Seconds = 0.0
    rest_turn: Rad = 0.0  # since the rest began
    rest_way: Metres = 0.0
    since_rest_s: Seconds = 0.0

    agreement: Agreement = field(default_factory=Agreement)
    learn_again: bool = False  # the bias, at the next rest: it may have changed
    doubt: Rad = 0.0  # for the next turn

    @property
    def status(self) -> GyroStatus:
        return GyroStatus(self.does, self.bias.value if self.bias.is_known else None)

    def event(self) -> Event | None:
        """Return an event if the status has changed since the last one."""
        before, does = self.reported, self.does
        self.reported = does
        # The text of "waiting for turn" announces the change to "used".
        if does in (before, "off") or (before, does) == ("waiting for turn", "used"):
            return None
        why = STATUS[does]
        level: Level = "info" if why.level == "ok" else "warning"
        return Event("gyro", joined(why).text, level, kind=does, code=why.code)

    def forget_doubt(self) -> None:
        """Forget the uncertainty of turns before now: a new pose was set."""
        self.doubt = self.since_sample = self.since_change = 0.0
        self.agreement.forget()

    # Samples.

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Use samples in the order of arrival. One with `anew` is the first of another gyro."""
        for sample in samples:
            if sample.anew:
                self._begin()
            if not self._is_prompt(sample):
                continue
            self.heard_ns = sample.at_ns
            last, jumped, self.jumped = self.last, self.jumped, None
            if last is not None and jumped is not None:
                jump = jumped.rate - last.rate
                if (sample.rate - last.rate) / jump >= CONFIRMED:
                    self._use(jumped)
                    last = jumped
            if last is not None and abs(sample.rate - last.rate) > MAX_JUMP:
                self.jumped = sample
            else:
                self._use(sample)

    def _begin(self) -> None:
        new = Gyro(self.does, self.reported, used=self.used, doubt=self.doubt)
        new.given = new.turned = self.given
        for name in self.__struct_fields__:
            setattr(self, name, getattr(new, name))

    def _is_prompt(self, sample: GyroSample) -> bool:
        newest, self.newest, stamp_ns, at_ns = self.newest, sample, sample.stamp_ns, sample.at_ns
        self.newest_ns = at_ns
        if stamp_ns is None or newest is None or newest.stamp_ns is None or self.least_ns is None:
            self.least_ns = None if stamp_ns is None else at_ns - stamp_ns
            return True
        delay_ns, passed_ns = at_ns - stamp_ns, at_ns - newest.at_ns
        back_ns = newest.stamp_ns - stamp_ns
        if 0 < back_ns <= MAX_SWAPPED_NS:
            return False
        self.least_ns = min(delay_ns, self.least_ns + int(MAX_RISE * passed_ns))
        # After a silence, the wheels have measured what a backlog of samples says.
        silent = self.heard_ns is None or at_ns - self.heard_ns >= SILENCE_TIMEOUT_NS
        limit_ns = MAX_DELAY_S * NS_PER_S if silent else MAX_EXTRA_DELAY_NS
        if delay_ns - self.least_ns > limit_ns and back_ns <= 0:
            falls = delay_ns < self.late_ns - MAX_DELAY_FALL_NS
            if self.late_since_ns is None or falls or passed_ns >= SILENCE_TIMEOUT_NS:
                self.late_since_ns, self.late_ns = at_ns, delay_ns
            if at_ns - self.late_since_ns < CLOCK_SET_NS:
                return False
            back_ns = MAX_DELAY_FALL_NS
        if back_ns > 0:  # the clock was set
            self.least_ns = delay_ns
        self.newest_ns, self.late_since_ns = at_ns + self.least_ns - delay_ns, None
        return True

    def _use(self, sample: GyroSample) -> None:
        last, self.last, bias, self.sampled_ns = self.last, sample, self.bias, self.newest_ns
        span = 0.0 if last is None else _span(last, sample)
        if last is None or sample.at_ns - last.at_ns >= SILENCE_TIMEOUT_NS:
            # The turn was assumed, or the wheels gave it.
            rate, span = sample.rate - bias.value, 0.0
            self.variance += ((rate - self.rate) * SILENCE_TIMEOUT_NS / NS_PER_S) ** 2 / 4
            self.turned, self.rate = self.given, rate
        if last is not None:
            self._follow_repetition(sample.rate == last.rate, span)
        # Two steps one after the other have the covariance -n by white noise of the variance n.
        step_before, self.step = self.step, 0.0 if last is None else sample.rate - last.rate
        self.scatter -= SCATTER_GAIN * (self.step * step_before + self.scatter)
        bias.variance += BIAS_RANDOM_WALK * BIAS_RANDOM_WALK * span
        stands = self.rest_s > REST_S and not self.hangs
        was, is_known = bias.value, bias.is_known
        if stands and self.learn_again:
            bias.variance, self.learn_again = (MAX_BIAS / 4) ** 2, False
        stands = stands and bias.follow(sample.rate, sample.variance, self.scatter, span)
        if stands and is_known and abs(bias.value - was) > VIBRATION:
            # Nobody knows when the bias changed.
            self.doubt += (bias.value - was) * self.since_rest_s
        before, self.rate = self.rate, 0.0 if stands else sample.rate - bias.value
        if self.repeated_s >= HANG_S and self.rest_s > REST_S and abs(self.rate) > MAX_BIAS:
            self.hangs = True  # no person turns a robot so evenly
        if stands:
            self.since_rest_s = 0.0
        self.turned += (before + self.rate) / 2 * span
        noise = max(bias.noise, sample.variance, self.scatter) + (self.rate - before) ** 2 / 12
        self.variance += noise * span * span
        self.since_sample = 0.0

    def _follow_repetition(self, same: bool, span: Seconds) -> None:
        if same:
            self.repeats += 1
            self.repeated_s += span
            if self.repeated_s >= HANG_S:
                share = (self.usual_repeats + 1) / (self.usual + 1)
                self.hangs |= share < MAX_REPEATING and share**self.repeats < MIN_CHANCE
            return
        if self.rate == 0.0 and not self.hangs:
            self.usual += 1 + self.repeats
            self.usual_repeats += self.repeats
        self.repeats, self.repeated_s, self.hangs, self.since_change = 0, 0.0, False, 0.0

    # Lines.

    def turn(
        self, at_ns: Ns, dt: Seconds, wheels: Rad, way: Metres, idle: bool, claims: Claims
    ) -> Turn | None:
        """Return the turn since the previous line, or None if the wheels must provide it.

        `wheels` and `way` are the wheels' turn and distance; `dt` is 0 after a gap, in which they
        are not known. `idle`: rest was commanded since the previous line.
        """
        self._follow_rest(dt, wheels, way, idle, claims)
        last, heard_ns = self.last, self.heard_ns
        silent = last is None or heard_ns is None or at_ns - heard_ns >= SILENCE_TIMEOUT_NS
        ahead_ns = 0 if last is None else min(at_ns - self.sampled_ns, SILENCE_TIMEOUT_NS)
        total = self.turned + self.rate * ahead_ns / NS_PER_S
        angle, self.given = total - self.given, total
        known = self.bias.is_known
        agreement = self.agreement
        if dt > 0.0 and not (silent or self.hangs):
            block = agreement.add(wheels, angle, way, dt, self.variance)
            if block is not None:
                self._compare(block, claims, known)
        agreement.disagrees_s = max(0.0, agreement.disagrees_s - dt)
        self._decide_use(silent, known)
        if self.does not in ("used", "disagrees"):
            return self._wheels(dt, wheels, claims)
        if not self.used and dt > 0.0:
            # The first samples may be of the time before, in which the wheels gave the turn.
            self.used, self.variance = True, (MAX_DELAY_S * self.rate) ** 2
            return None
        self.used = True
        if dt > 0.0:
            self.since_sample += angle - wheels
            self.since_change += angle - wheels
        # The error of the bias is the same in each line, and nearly the same after a rest.
        bias = self.bias
        variance = self.variance + 2.0 * bias.shared * dt
        if self.rate:
            bias.shared += bias.variance * dt
        rate_variance, disagrees = bias.noise + bias.variance, agreement.disagrees_s > 0.0
        if disagrees and dt > 0.0:
            rate_variance += ((angle - wheels) / dt) ** 2
        doubt, self.doubt, self.variance = self.doubt, 0.0, 0.0
        trusted = None if disagrees else angle
        return Turn(angle, variance, self.rate, rate_variance, trusted, disagrees, doubt)

    def _wheels(self, dt: Seconds, wheels: Rad, claims: Claims) -> Turn | None:
        self.variance = 0.0
        if dt <= 0.0 or not (self.used or self.doubt):
            return None
        # The gyro has given the turn since its last good sample, and the wheels measured it.
        off = 0.0
        if self.used:
            off = self.since_change if self.hangs else self.since_sample
        self.used, self.since_sample, self.since_change = False, 0.0, 0.0
        doubt, self.doubt = self.doubt, 0.0
        if not (off or doubt):
            return None
        variance = claims.per_radian * abs(off) + claims.per_radian * abs(wheels)
        return Turn(wheels - off, variance, wheels / dt, MARGIN**2, doubt=doubt)

    def _follow_rest(
        self, dt: Seconds, wheels: Rad, way: Metres, idle: bool, claims: Claims
    ) -> None:
        self.rest_turn += wheels
        self.rest_way += way
        self.rest_s += dt
        self.since_rest_s += dt
        moved = abs(self.rest_way) + claims.half_track * abs(self.rest_turn)
        if not idle or moved > claims.rest:
            self.rest_s = self.rest_turn = self.rest_way = 0.0

    def _compare(self, block: Compared, claims: Claims, known: bool) -> None:
        agreement = self.agreement
        if agreement.verdict != "good":
            agreement.test(block, known)
            return
        if self.rest_s > REST_S and abs(block.gyro) >= MAX_BIAS * block.seconds:
            return  # a person turns the robot, which the wheels do not measure
        contradiction, doubt = agreement.compare(block, claims, self.bias.variance)
        self.learn_again |= contradiction
        self.doubt += doubt

    def _decide_use(self, silent: bool, known: bool) -> None:
        verdict = self.agreement.verdict
        if verdict != "none yet" and verdict != "good":
            self.does = verdict
        elif silent:
            self.does = "silent"
        elif self.hangs:
            self.does = "hangs"
        elif not known:
            self.does = "waiting for rest"
        elif verdict == "none yet":
            self.does = "waiting for turn"
        else:
            self.does = "disagrees" if self.agreement.disagrees_s > 0.0 else "used"


def _span(last: GyroSample, sample: GyroSample) -> Seconds:
    # By stamps, if they advance: arrivals jitter.
    if sample.stamp_ns is not None and last.stamp_ns is not None:
        span_ns = sample.stamp_ns - last.stamp_ns
        if 0 < span_ns < SILENCE_TIMEOUT_NS:
            return span_ns / NS_PER_S
    span_ns = sample.at_ns - last.at_ns
    return span_ns / NS_PER_S if span_ns < SILENCE_TIMEOUT_NS else 0.0
