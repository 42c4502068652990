"""Takes the heading from a gyro, if there is one. The distance still comes from the wheels.

In gyrodometry (Borenstein & Feng, Gyrodometry: a new method for combining data from gyros and
odometry in mobile robots, 1996), skidding does not affect a gyro, nor its bias the wheels. The
reading at rest is the bias (`gyro_bias.py`), and a comparison gives the ratio of the turns
(`gyro_match.py`). Until gyro and wheels have agreed in a turn (`gyro_trial.py`), the heading is the
wheels'; then it is corrected by the difference so far. A gyro that is silent or does not match at
all is not used.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.link.minimum_delay import MinimumDelay
from acsard.core.motion.gyro_bias import LEARNING_TIME_S, MAX_BIAS, Bias
from acsard.core.motion.gyro_match import WINDOW_S, Match
from acsard.core.motion.gyro_trial import TURN_RATIO_RANGE, Trial
from acsard.core.values import NS_PER_S, Event, GyroDoes, GyroSample, GyroStatus, Level, Ns

REST_S = 0.2  # of zero speeds of all wheels, after which the robot counts as resting

# Age of the last sample of a silent gyro. Until then, the robot is assumed to turn at its rate.
SILENCE_TIMEOUT_NS = NS_PER_S // 5

# A delay this far above the least one shows a slow network, or a sender's clock that was set.
MAX_EXTRA_DELAY_NS = NS_PER_S // 4

# A clock was set if such delays last for the first one and fall by less than the second one. The
# delays of a backlog fall.
STEADY_DELAY_NS, MAX_DELAY_FALL_NS = NS_PER_S, NS_PER_S // 50

# A stamp this far before the previous one shows a clock that was set back, not swapped samples.
MIN_SET_BACK_NS = NS_PER_S // 50

# Samples are missing after this number of periods without one. `PERIOD_GAIN`: weight of a new
# sample in the mean period.
HOLE_PERIODS, PERIOD_GAIN = 1.5, 0.02

# New samples that cover more time than their line, by this ratio, are a backlog after a silence.
CATCH_UP_SPEED = 1.5

SLIP_S = 0.5  # after they contradicted the gyro, the wheels count as slipping

MAX_SLIP_S = 5.0  # longer than this, the gyro is not used until gyro and wheels agree again

# A larger change of the rate, rad/s, must be confirmed by the next sample. At 100 Hz it is 200
# rad/s2, a defect or a push; at 10 Hz it is 20 rad/s2, more than usual motors cause.
MAX_JUMP = 2.0

# With a last sample this old, nobody can tell whether gyro or wheels were right.
LOST_NS = NS_PER_S

# Largest change of the bias, rad/s, that is learned from one exact rate at rest: coarse gyros and
# simulated ones repeat rates. A gyro that hangs this close to the bias is not noticed.
MAX_BIAS_STEP = 0.06

# A gyro that repeats one rate certainly hangs if at rest it usually repeats less than the first
# fraction of its samples, and if such a series has a probability below the second.
MAX_REPEATING, MIN_CHANCE = 0.6, 1e-6

# Fraction of a jump that must remain in the next sample: a push lasts for hundredths of a second.
CONFIRMED_FRACTION = 0.5

# A gyro that repeats one exact rate at rest for this time hangs, as noise changes the last digits.
# It is less than `NEW_BIAS_TIME_S`, or the rate would become the bias first.
FROZEN_S = 0.8

TRUSTED_BLOCKS = 20.0  # of 0.1 s with a turn, after which the ratio of the turns is used

STATUS_TEXTS: dict[GyroDoes, str] = {
    "off": "",
    "waiting for rest": "the gyro's bias is not known yet: the robot must stand for "
    f"{REST_S + LEARNING_TIME_S:.1f} s",
    "waiting for turn": "the heading comes from the wheels until the gyro has agreed with them in "
    "a turn",
    "used": "the heading comes from the gyro",
    "silent": "the gyro is silent: the heading comes from the wheels",
    "disagrees": "the wheels seem to slip: the gyro measures a different turn than the wheels",
    "reversed": "the gyro is not used, because it reports a left turn of the robot as a right "
    "turn: check how the gyro is mounted",
    "in degrees": "the gyro is not used, because its rate is 57 times too high: it sends degrees "
    "per second, and must send radians per second",
    "dead": "the gyro is not used, because it measures no turn while the wheels turn the robot: "
    "check the gyro",
    "not believed": "the gyro is not used, because its rate does not match the wheels at all: does "
    "its z axis point up, and does its rate change?",
}


class Turn(Struct, frozen=True, gc=False):
    """The turn since the previous line by a gyro (or the wheels, with a correction), rad.

    `variance`, rad2, is without the error of the gyro's scale, which does not average out
    (`uncertainty.py`).
    """

    angle: float
    variance: float
    rate: float  # rad/s, of the last sample or of the wheels
    rate_variance: float
    wheels: float | None = None  # rad of wheels without a fault, by the learned ratio
    slips: bool = False  # the wheels contradicted the gyro within `SLIP_S`


class Gyro:
    """Computes the turns of the robot from the samples of one gyro.

    `turn` includes samples up to `SILENCE_TIMEOUT_NS` late, so no turn is lost. While they are
    later, the wheels provide it, and a backlog (shown only by stamps) changes nothing. Missing
    samples make the turn uncertain. If a gyro hangs, the wheels' turn replaces its since then.
    After a contradiction that ends with the gyro unused, the difference is uncertainty.
    """

    def __init__(self) -> None:
        self._rest_s = self._since_rest_s = 0.0
        self.owes = False  # the wheels gave the last turn; the heading will be corrected
        self._does: GyroDoes = "silent"
        self.events: list[Event] = []  # of the last `turn`
        self._doubt = 0.0  # variance that the next turn must add, rad2
        self._begin()

    def _begin(self) -> None:
        self._bias, self._match, self._trial = Bias(), Match(), Trial()
        self._heard: deque[tuple[int, GyroSample]] = deque(maxlen=256)  # unused, with `_time_of`
        self._promptest = MinimumDelay()
        self._late_since: tuple[int, float] | None = None  # arrival and first delay, ns
        self._period_s = 0.0  # mean; 0 before the second sample
        # Gyro's minus wheels' turn since the last used sample, whose rate is assumed to go on, rad.
        self._guessed = 0.0
        self._slipped_before = False  # contradiction at the last used sample
        self._last: GyroSample | None = None
        self._told_ns: Ns | None = None  # last used sample
        self._rate = 0.0
        self._angle = self._given = 0.0  # rad by all used samples, and returned by `turn`
        self._variance = 0.0  # of the rest of `_angle`, rad2
        self._slip_s = self._slipped_s = 0.0
        self._reading: float | None = None  # rate of the last used sample, rad/s with the bias
        # Exact repetition of `_reading`; and of it, at rest and not the bias.
        self._repeated_s = self._rested_s = 0.0
        self._frozen = False  # the gyro hangs, until its rate changes or becomes the bias
        self._repeats = 0  # successive repetitions
        # Samples of the bias at rest, and repetitions among them, while the gyro does not hang.
        self._usual = self._usual_repeats = 0
        # Rate that was repeated at rest and may be the new bias, rad/s.
        self._suspect: float | None = None
        self._unsure = 0.0  # variance of the bias by `_suspect`, rad2/s2
        self._noise = 0.0  # variance of the present turn rate, rad2/s2
        self._hole = False  # samples are missing since the last line, or it found the gyro silent
        self._contradicted = 0.0  # gyro's minus wheels' turn since the contradiction began, rad
        self._forget_owed()
        self._forget_repeated()

    @property
    def status(self) -> GyroStatus:
        return GyroStatus(self._does, self._bias.value if self._bias.is_known else None)

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Store samples in the order of arrival; one with `anew` (another gyro) resets all."""
        for sample in samples:
            if sample.anew:
                self._end_contradiction()
                self._drop_waiting_correction()
                self._begin()
            self._hole |= len(self._heard) == self._heard.maxlen
            self._heard.append((self._time_of(sample), sample))

    def turn(self, at_ns: Ns, dt: float, wheels: float, still: bool) -> Turn | None:
        """Return the gyro's turn since the previous line, `wheels` being the wheels', rad.

        Return None if the wheels must provide it. After doubtful turns, the result is the wheels'
        turn with a correction. `dt` is 0 after a gap, which the result covers. `still` says that
        all wheels in use report zero.
        """
        self.events, self.owes = [], False
        self._rest_s = self._rest_s + dt if still else 0.0
        resting = self._rest_s > REST_S
        told_ns = self._told_ns
        self._take(at_ns, resting)
        if self._told_ns != told_ns and not self._hole:
            self._guessed, self._slipped_before = 0.0, self._slip_s > 0.0
        ahead = SILENCE_TIMEOUT_NS if self._told_ns is None else at_ns - self._told_ns
        age_ns = ahead
        if self._heard and self._told_ns is not None:
            # A sample that waits for the confirmation of its jump is not used, but not silent.
            age_ns = min(age_ns, at_ns - self._heard[0][0])
        # Samples that catch up after a silence have the rates of an earlier motion.
        passed_ns = 0 if told_ns is None or self._told_ns is None else self._told_ns - told_ns
        catches_up = self._does == "silent" and passed_ns > CATCH_UP_SPEED * dt * NS_PER_S
        limit_ns = HOLE_PERIODS * self._period_s * NS_PER_S if catches_up else SILENCE_TIMEOUT_NS
        silent = age_ns >= min(limit_ns, SILENCE_TIMEOUT_NS)
        prediction = 0.0 if resting or silent else self._rate * max(0, ahead) / NS_PER_S
        angle, variance = self._angle + prediction - self._given, self._variance
        self._given, self._variance = self._angle + prediction, 0.0
        # The samples that end a silence cover the same turn again, so the wheels also provide the
        # turn of the next line.
        lost, self._hole = silent or self._hole, silent
        self._since_rest_s = 0.0 if resting else self._since_rest_s + dt
        # The error of the bias is the same in each line, so it does not average out.
        bias_variance = self._bias.variance + self._unsure
        variance += 2.0 * bias_variance * self._since_rest_s * dt
        tried = False if lost else self._try(wheels, angle, variance, dt, resting)
        if not lost and self._bias.is_known and dt > 0.0 and not self._trial.open:
            self._compare(wheels, angle, dt)
        # While the robot rests, a rate that is only the bias counts as 0.
        if resting and self._rested_s >= FROZEN_S and self._rate != 0.0:
            self._frozen = True
        self._judge(silent)
        ratio = max(TURN_RATIO_RANGE[0], self._match.ratio)
        noise = self._noise + self._bias.variance
        if age_ns >= LOST_NS:
            self._end_contradiction()
        if lost or tried or self._does not in ("used", "disagrees", "waiting for turn"):
            return self._doubted(ratio * wheels, dt, noise, lost)
        self._sum_up(angle, ratio * wheels, dt)
        rolled = angle / ratio
        if not self._trial.open:
            angle, variance = angle + self._owed, variance + self._owed_variance
            self._forget_owed()
        variance, self._doubt = variance + self._doubt, 0.0
        return Turn(angle, variance, self._rate, noise, rolled, self._does == "disagrees")

    def drop_corrections(self) -> None:
        """Drop pending corrections of the heading and its uncertainty: a new pose was set."""
        self._contradicted = self._doubt = self._guessed = 0.0
        self._forget_owed()
        self._forget_repeated()

    def _forget_owed(self) -> None:
        # Pending correction, rad, for when the gyro is proven, and its variance, rad2.
        self._owed = self._owed_variance = 0.0

    def _forget_repeated(self) -> None:
        # Since the rate changed, over lines with the gyro's turn: gyro's minus wheels' turn and
        # wheels' turn, rad; squared turns in gaps, rad2.
        self._repeated = self._repeated_wheels = self._repeated_gaps = 0.0

    def undo_recomputation(self, turn: float) -> float:
        """Return the angle to subtract from the heading after a recomputation without a wheel.

        `turn` is its change in lines with `owes`, rad. A proven gyro has corrected the heading
        already, so the result is `turn`. On trial, the pending correction changes by -`turn`. A
        refuted gyro has none.
        """
        verdict = self._trial.verdict
        if verdict == "none yet":
            self._owed -= turn
        return turn if verdict == "good" else 0.0

    # Samples.

    def _time_of(self, sample: GyroSample) -> int:
        # A backlog gets the times of measurement, so the wheels provide the present turn.
        last, self._last = self._last, sample
        if last is None or sample.stamp_ns is None or last.stamp_ns is None:
            return sample.at_ns
        late = self._promptest.add(sample.at_ns - last.at_ns, sample.stamp_ns - last.stamp_ns)
        was_set = self._is_late_for_good(late, sample.at_ns, last.at_ns)
        if was_set or last.stamp_ns - sample.stamp_ns > MIN_SET_BACK_NS:
            self._promptest, self._late_since = MinimumDelay(), None
            return sample.at_ns
        return sample.at_ns - max(0, int(late))

    def _is_late_for_good(self, late: float, at_ns: Ns, last_at_ns: Ns) -> bool:
        if late <= MAX_EXTRA_DELAY_NS:
            self._late_since = None
            return False
        since_ns, first = self._late_since or (at_ns, late)
        if late < first - MAX_DELAY_FALL_NS or at_ns - last_at_ns >= SILENCE_TIMEOUT_NS:
            since_ns, first = at_ns, late
        self._late_since = since_ns, first
        return at_ns - since_ns >= STEADY_DELAY_NS

    def _take(self, until_ns: Ns, resting: bool) -> None:
        bias, samples = self._bias, self._heard
        while samples and samples[0][0] <= until_ns:
            jump = 0.0 if self._reading is None else samples[0][1].rate - self._reading
            if abs(jump) > MAX_JUMP:
                if len(samples) == 1:
                    break
                remaining = jump + samples[1][1].rate - samples[0][1].rate
                if remaining / jump < CONFIRMED_FRACTION:
                    samples.popleft()
                    continue
            time_ns, sample = samples.popleft()
            span_ns = SILENCE_TIMEOUT_NS if self._told_ns is None else time_ns - self._told_ns
            self._hole |= span_ns >= SILENCE_TIMEOUT_NS
            self._told_ns = time_ns if self._told_ns is None else max(time_ns, self._told_ns)
            passed = max(0, span_ns) / NS_PER_S
            span = passed if span_ns < SILENCE_TIMEOUT_NS else 0.0
            self._repeated_s += span
            same = sample.rate == self._reading
            step = 0.0 if self._reading is None else sample.rate - self._reading
            if not same:
                self._end_repetition()
                self._reading = sample.rate
            self._repeats += same
            bias.drift(passed)
            new = abs(sample.rate - bias.value) < MAX_BIAS_STEP or sample.rate == self._suspect
            learns = not self._frozen or (new and not self._hangs)
            stands = resting and learns and bias.update_at_rest(sample.rate, sample.variance, span)
            if stands:
                self._unsure, self._rested_s, self._frozen = 0.0, 0.0, False
                if not self._hangs:
                    self._usual += 1
                    self._usual_repeats += same
            self._rate = 0.0 if stands else sample.rate - bias.value
            self._rested_s += span if resting and same and not stands else 0.0
            self._noise = max(bias.noise, sample.variance)
            self._angle += self._rate * span
            if not stands:
                self._variance += self._noise * span * span
                if span > HOLE_PERIODS * self._period_s > 0.0:
                    # Samples are missing, so the rate may have changed at any time in this span.
                    self._variance += step * step / 3.0 * span * span
            self._period_s += PERIOD_GAIN * (span - self._period_s) if self._period_s else span

    @property
    def _hangs(self) -> bool:
        share = (self._usual_repeats + 1) / (self._usual + 1)
        return share < MAX_REPEATING and share**self._repeats < MIN_CHANCE

    def _end_repetition(self) -> None:
        # A gyro without noise also repeats its rate in an even turn with slipping wheels. Then the
        # repetition begins with the slip, and the wheels turn more than the robot.
        gyro = self._repeated + self._repeated_wheels
        before = self._repeated_s >= self._slipped_s + SLIP_S
        hung = before or self._hangs or abs(gyro) > abs(self._repeated_wheels)
        # At the start of a turn, a slow gyro contradicts the wheels for a shorter time.
        if hung and self._repeated_s >= FROZEN_S and self._slipped_s >= SLIP_S:
            self._end_contradiction()
        suspect = self._reading if self._frozen and not self._hangs else None
        if suspect is not None and abs(suspect) <= MAX_BIAS:
            # Perhaps the gyro did not hang, but its bias has changed.
            off = suspect - self._bias.value
            self._unsure, self._suspect = off * off, suspect
        self._drop_waiting_correction()
        self._repeated_s, self._rested_s, self._repeats, self._frozen = 0.0, 0.0, 0, False
        self._forget_repeated()

    def _drop_waiting_correction(self) -> None:
        # It waits if the line that showed the hanging gyro covers no known time.
        if self._frozen:
            self._doubt += self._repeated * self._repeated + self._repeated_gaps

    # Comparison with the wheels.

    def _try(self, wheels: float, angle: float, variance: float, dt: float, resting: bool) -> bool:
        # At rest the gyro provides the turn, because a person may turn the robot.
        trial, known = self._trial, self._bias.is_known
        if not trial.open or resting:
            return False
        if dt > 0.0:
            trial.add(wheels, angle, dt, known)
        if not trial.open:
            return False
        if known and trial.verdict == "none yet":
            self._owed += angle - wheels
            self._owed_variance += variance
            self.owes = True
        else:
            self._forget_owed()
        return True

    def _compare(self, wheels: float, angle: float, dt: float) -> None:
        self._match.add(wheels, angle, dt, self._slip_s > 0.0)
        noise = 2.0 * self._bias.variance * WINDOW_S * WINDOW_S + self._bias.noise * WINDOW_S * dt
        if self._match.contradiction(noise):
            self._slip_s = SLIP_S
        else:
            self._slip_s = max(0.0, self._slip_s - dt)
        self._slipped_s = self._slipped_s + dt if self._slip_s > 0.0 else 0.0

    def _sum_up(self, angle: float, wheels: float, dt: float) -> None:
        # `dt` is 0 after a gap, which only the gyro has measured.
        off = angle - wheels
        self._repeated_gaps += 0.0 if dt > 0.0 else angle * angle
        self._repeated += off
        self._repeated_wheels += wheels
        self._guessed += off
        self._contradicted = self._contradicted + off if self._slip_s > 0.0 else 0.0

    def _end_contradiction(self) -> None:
        # Nobody can tell whether gyro or wheels were right.
        self._doubt += self._contradicted * self._contradicted
        self._contradicted = 0.0

    def _doubted(self, wheels: float, dt: float, noise: float, lost: bool) -> Turn | None:
        # The wheels' turn with a correction, and the uncertainty of earlier turns.
        if dt <= 0.0:
            # This line gives no turn, so a correction for a gyro that hangs waits for the next one.
            if not lost and not self._frozen:
                self._end_contradiction()
            return None
        angle = 0.0
        if lost:
            # The wheels also give the turn since the sample before, unless they slipped then.
            self._doubt += self._guessed * self._guessed
            if not self._slipped_before:
                angle, self._contradicted, self._slip_s = -self._guessed, 0.0, 0.0
            self._guessed = 0.0
        if self._frozen:
            # The wheels give the turn since the gyro hangs, except in a gap of the feedback.
            angle, self._contradicted = -self._repeated, 0.0
            deviation = self._match.deviation * self._repeated_wheels
            self._doubt += deviation * deviation + self._repeated_gaps
            self._forget_repeated()
        if not lost:
            self._end_contradiction()
        if angle == 0.0 and self._doubt == 0.0:
            return None
        variance, self._doubt = self._doubt, 0.0
        return Turn(wheels + angle, variance, wheels / dt, noise)

    def _judge(self, silent: bool) -> None:
        match, before, verdict = self._match, self._does, self._trial.verdict
        least, most = TURN_RATIO_RANGE
        wrong = match.blocks >= TRUSTED_BLOCKS and not least <= match.ratio <= most
        if verdict != "none yet" and verdict != "good":
            self._does = verdict
        elif silent:
            self._does = "silent"
        elif not self._bias.is_known:
            self._does = "waiting for rest"
        elif wrong or self._frozen or self._slipped_s > MAX_SLIP_S:
            self._does = "not believed"
        elif self._trial.open:
            self._does = "waiting for turn"
        else:
            self._does = "disagrees" if self._slip_s > 0.0 else "used"
        # The text of "waiting for turn" announces the change to "used", so no event reports it.
        if self._does != before and (before, self._does) != ("waiting for turn", "used"):
            good = self._does in ("used", "waiting for rest", "waiting for turn")
            level: Level = "info" if good else "warning"
            self.events.append(Event("gyro", STATUS_TEXTS[self._does], level, kind=self._does))
