"""Takes the heading from a gyro, if there is one. The distance still comes from the wheels.

The method is gyrodometry (Borenstein & Feng, Gyrodometry: a new method for combining data from
gyros and odometry in mobile robots, 1996): skidding wheels do not affect a gyro, and a gyro's bias
does not affect the wheels. The gyro's reading at rest is its bias (`gyro_bias.py`). A comparison of
gyro and wheels gives the ratio of their turns (`gyro_match.py`).

Until gyro and wheels have agreed in a turn, the heading comes from the wheels. After that turn, the
heading is corrected by the gyro's turn minus the wheels' turn up to then. A gyro that reads the
opposite sign, degrees or zero is reported and not used (`gyro_trial.py`). If a gyro is silent, or
if its rate does not match the wheels at all, the heading comes from the wheels.

A sample that arrives up to `SILENCE_TIMEOUT_NS` late is included in the turn of the next line, so
no turn is lost. While the samples are later than that, the wheels provide the turn, and a backlog
of samples changes nothing. Only stamps show how late samples are: without stamps, the daemon takes
a backlog for the present motion. If samples are missing, the turn in between becomes uncertain.

A sample whose rate jumps counts only if the next sample confirms the jump. A gyro that repeats one
rate exactly while the wheels stand still is assumed to hang. The wheels' turn then replaces the
turn that the gyro has measured since it began to repeat this rate. If gyro and wheels contradict
each other for so long that the gyro is not used any more, either of them may be right. The
difference of their turns is then added to the uncertainty of the heading.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.link.minimum_delay import MinimumDelay
from acsard.core.motion.gyro_bias import LEARNING_TIME_S, MAX_BIAS, Bias
from acsard.core.motion.gyro_match import WINDOW_S, Match
from acsard.core.motion.gyro_trial import TURN_RATIO_RANGE, Trial
from acsard.core.values import NS_PER_S, Event, GyroDoes, GyroSample, GyroStatus, Level

REST_S = 0.2
"""Time for which all four wheels must report zero speed before the robot counts as standing still,
s."""

SILENCE_TIMEOUT_NS = NS_PER_S // 5
"""Age of the gyro's last sample from which the gyro counts as silent, ns. Up to this age, the robot
is assumed to continue turning at the rate of this sample."""

MAX_EXTRA_DELAY_NS = NS_PER_S // 4
"""Largest normal excess of a sample's delay over the smallest delay of earlier samples, ns. A
larger excess shows that the network held the sample back, or that the clock of the sender was
set."""

STEADY_DELAY_NS, MAX_DELAY_FALL_NS = NS_PER_S, NS_PER_S // 50
"""A delay is large if it exceeds the smallest delay by more than `MAX_EXTRA_DELAY_NS`. If the
delays are large for `STEADY_DELAY_NS` and do not fall by more than `MAX_DELAY_FALL_NS`, the clock
of the sender was set. While the network delivers a backlog instead, the delays fall."""

MIN_SET_BACK_NS = NS_PER_S // 50
"""If a stamp is earlier than the previous stamp by more than this, ns, the clock of the sender was
set back. A smaller step may have another cause: a driver may swap two samples or measure their
times with some jitter."""

HOLE_PERIODS, PERIOD_GAIN = 1.5, 0.02
"""If the time between two samples exceeds `HOLE_PERIODS` sample periods, samples are assumed to be
missing. `PERIOD_GAIN` is the weight of a new sample in the mean sample period, so about the last
fifty samples count."""

CATCH_UP_SPEED = 1.5
"""Ratio that shows a backlog of samples after a silence of the gyro: the time that the new samples
cover, divided by the time of the feedback line. At a larger ratio, the gyro counts as silent until
its last sample is less than `HOLE_PERIODS` sample periods old."""

SLIP_S = 0.5
"""Time for which the wheels count as slipping after they last contradicted the gyro, s."""

MAX_SLIP_S = 5.0
"""Longest plausible slip, s. If gyro and wheels contradict each other for longer, the gyro is not
used until they agree again."""

MAX_JUMP = 2.0
"""Change of the rate from one sample to the next, rad/s, above which the next sample must confirm
it. At 100 samples per second, it is a change of 200 rad/s2: a defect on the wire, or a push. At 10
samples per second, it is a change of 20 rad/s2, which is more than the motors of a usual robot
cause."""

LOST_NS = NS_PER_S
"""Age of the gyro's last sample, ns, from which a contradiction between gyro and wheels remains
unresolved. The daemon can then no longer find out whether gyro or wheels were right."""

MAX_BIAS_STEP = 0.06
"""Largest change of the bias that is learned while a gyro at rest repeats one rate exactly, rad/s.
The limit applies to gyros that also repeat rates without a defect: coarse gyros, and simulated
gyros without noise. If such a gyro hangs at a rate that differs from the bias by less than this, it
looks like a gyro whose bias has changed."""

MAX_REPEATING, MIN_CHANCE = 0.6, 1e-6
"""A gyro that repeats one rate certainly hangs if both of these conditions hold. At rest, it
usually repeats less than the fraction `MAX_REPEATING` of its samples. The probability of the
present series of repetitions is below `MIN_CHANCE`."""

CONFIRMED_FRACTION = 0.5
"""Fraction of a jump of the rate that must remain in the next sample. After a push, friction slows
the robot down within some hundredths of a second. After a wrong sample, nothing of the jump
remains."""

FROZEN_S = 0.8
"""Time at rest after which a gyro that repeats one rate exactly is assumed to hang, s. The noise of
a gyro, and a hand that turns the robot, change the last digits of the rate within a few samples.
The time is shorter than `NEW_BIAS_TIME_S`, so that the rate of a gyro that hangs does not become
the bias first. A coarse gyro that rotates evenly with a robot at rest, for example on a turntable,
looks like a gyro that hangs."""

TRUSTED_BLOCKS = 20.0
"""Number of blocks of 0.1 s in which the robot must turn before the measured ratio of the gyro's
turn to the wheels' turn is used."""

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
    """Turn of the robot since the previous feedback line, measured by a gyro.

    If earlier turns of the gyro were in doubt, the value may instead be the wheels' turn with a
    correction of these earlier turns. `angle` is in rad, and `variance` is its variance, rad2. The
    variance does not include the error of the gyro's scale, which does not average out
    (`uncertainty.py`).
    """

    angle: float
    variance: float
    rate: float
    """Turn rate, rad/s: that of the gyro's last sample, or of the wheels if `angle` is the wheels'
    turn."""
    rate_variance: float
    wheels: float | None = None
    """Turn that wheels without a fault would report, rad. It is `angle` divided by the learned
    ratio of the gyro's turn to the wheels' turn."""
    slips: bool = False
    """Whether the turns according to wheels and gyro contradicted each other in the last `SLIP_S`
    s."""


class Gyro:
    """Computes the turns of the robot from the samples of one gyro.

    The caller passes samples to `add_samples`, and calls `turn` for each feedback line.
    """

    def __init__(self) -> None:
        self._rest_s = self._since_rest_s = 0.0
        self.owes = False
        """Whether the wheels provided the turn of the last line because the gyro is not proven. A
        gyro is proven when it has agreed with the wheels in a turn. Then the heading is corrected
        by the gyro's turn minus the wheels' turn."""
        self._does: GyroDoes = "silent"
        self.events: list[Event] = []
        """Log events of the last call of `turn`."""
        self._doubt = 0.0
        """Variance, rad2, that the next turn must add to the heading."""
        self._begin()

    def _begin(self) -> None:
        self._bias, self._match, self._trial = Bias(), Match(), Trial()
        self._heard: deque[tuple[int, GyroSample]] = deque(maxlen=256)
        """Samples that `turn` has not used yet, each with its monotonic time, ns (`_time_of`)."""
        self._promptest = MinimumDelay()
        self._late_since: tuple[int, float] | None = None
        """Arrival of the first sample with the present delay above `MAX_EXTRA_DELAY_NS`, and its
        delay, both in ns. It is None if the delay is smaller."""
        self._period_s = 0.0
        """Mean time between two samples, s; 0 before the second sample."""
        self._guessed = 0.0
        """The gyro's turn minus the wheels' turn in the lines since the last sample that was used,
        rad. In these lines, the robot is assumed to continue turning at the rate of this sample."""
        self._slipped_before = False
        """Whether gyro and wheels contradicted each other when the last used sample arrived."""
        self._last: GyroSample | None = None
        self._told_ns: int | None = None
        """Monotonic time of the last sample that was used, ns; None before the first sample."""
        self._rate = 0.0
        self._angle = self._given = 0.0
        """`_angle` is the turn according to all samples that were used, rad. `_given` is the turn
        that `turn` has returned so far, rad."""
        self._variance = 0.0
        """Variance of the part of `_angle` that `turn` has not returned yet, rad2."""
        self._slip_s = self._slipped_s = 0.0
        self._reading: float | None = None
        """Rate in the last sample that was used, rad/s, without a correction for the bias; None
        before the first sample."""
        self._repeated_s = self._rested_s = 0.0
        """`_repeated_s` is the time for which the gyro has repeated the rate `_reading` exactly, s.
        `_rested_s` is the part of this time in which the robot was at rest and the rate was not the
        bias, s."""
        self._frozen = False
        """Whether the gyro is assumed to hang, until its rate changes or becomes the bias."""
        self._repeats = 0
        """Number of successive samples that have repeated the rate of the sample before them."""
        self._usual = self._usual_repeats = 0
        """Numbers of samples that measured the bias at rest: all of them (`_usual`), and those that
        repeated the rate of the sample before them (`_usual_repeats`). Samples of a gyro that hangs
        do not count."""
        self._suspect: float | None = None
        """A rate that the gyro repeated at rest and that may be its new bias, rad/s, or None."""
        self._unsure = 0.0
        """Additional variance of the bias, rad2/s2, because `_suspect` may be the new bias."""
        self._noise = 0.0
        """Variance of the present turn rate, rad2/s2."""
        self._hole = False
        """Whether samples are missing since the last feedback line, or the gyro was silent at that
        line."""
        self._contradicted = 0.0
        """The gyro's turn minus the wheels' turn since their contradiction began, rad. The value
        contains only turns that `turn` has returned, and it is 0 without a contradiction."""
        self._forget_owed()
        self._forget_repeated()

    @property
    def status(self) -> GyroStatus:
        return GyroStatus(self._does, self._bias.value if self._bias.is_known else None)

    def add_samples(self, samples: tuple[GyroSample, ...]) -> None:
        """Store the `samples` that arrived since the last control step, in the order of arrival.

        A sample whose field `anew` is true is the first one of another gyro. The method then
        forgets all values that were learned from the earlier gyro. If
        the earlier gyro contradicted the wheels, the difference of their turns makes the heading
        more uncertain.
        """
        for sample in samples:
            if sample.anew:
                self._end_contradiction()
                self._drop_waiting_correction()
                self._begin()
            self._hole |= len(self._heard) == self._heard.maxlen
            self._heard.append((self._time_of(sample), sample))

    def turn(self, at_ns: int, dt: float, wheels: float, still: bool) -> Turn | None:
        """Return the turn of the robot since the previous feedback line, measured by the gyro.

        Return None if the wheels must provide the turn, for example because the gyro is silent or
        not proven. If earlier turns of the gyro are in doubt, the result is instead the wheels'
        turn, with a correction or an additional uncertainty for these earlier turns.

        Args:
            at_ns: Monotonic time of this line, ns.
            dt: Time since the previous line, s. It is 0 after a gap, but the result covers the gap.
            wheels: The turn in `dt` according to the wheels, rad.
            still: Whether all wheels that are not ignored report zero speed.
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
            # A sample that waits for the confirmation of its jump is not used yet, but the gyro is
            # not silent.
            age_ns = min(age_ns, at_ns - self._heard[0][0])
        # Samples that catch up after a silence have the rates of an earlier motion.
        passed_ns = 0 if told_ns is None or self._told_ns is None else self._told_ns - told_ns
        catches_up = self._does == "silent" and passed_ns > CATCH_UP_SPEED * dt * NS_PER_S
        limit_ns = HOLE_PERIODS * self._period_s * NS_PER_S if catches_up else SILENCE_TIMEOUT_NS
        silent = age_ns >= min(limit_ns, SILENCE_TIMEOUT_NS)
        prediction = 0.0 if resting or silent else self._rate * max(0, ahead) / NS_PER_S
        angle, variance = self._angle + prediction - self._given, self._variance
        self._given, self._variance = self._angle + prediction, 0.0
        # During a silence of the gyro, the wheels provide the turn. The samples that end the
        # silence cover the same turn again, so the wheels also provide the turn of the next line.
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
        """Drop the pending corrections of the heading, because a new pose was set.

        This includes the uncertainty that the next turn would add to the heading.
        """
        self._contradicted = self._doubt = self._guessed = 0.0
        self._forget_owed()
        self._forget_repeated()

    def _forget_owed(self) -> None:
        self._owed = self._owed_variance = 0.0
        """`_owed` is the pending correction of the heading: the gyro's turn minus the wheels' turn
        while the gyro was not proven, rad. It is added to the heading when the gyro is proven.
        `_owed_variance` is its variance, rad2."""

    def _forget_repeated(self) -> None:
        self._repeated = self._repeated_wheels = self._repeated_gaps = 0.0
        """Sums over the feedback lines since the rate of the gyro changed. The sums contain only
        lines for which `turn` has returned the gyro's turn.

        - `_repeated`: the gyro's turn minus the wheels' turn, rad.
        - `_repeated_wheels`: the wheels' turn, rad.
        - `_repeated_gaps`: the squares of the gyro's turns in gaps of the feedback, rad2.
        """

    def undo_recomputation(self, turn: float) -> float:
        """Return the angle that the caller must subtract from the heading, rad.

        Call this after the pose was recomputed over earlier feedback lines. `turn` is the change of
        the robot's turn by this recomputation, rad. Only the lines in which the gyro was not proven
        yet count (`owes`).

        - If the gyro is proven now, the heading was already corrected to the gyro's turn. The
          result is `turn`, so that the caller undoes the change.
        - If the test of the gyro goes on, the result is 0, and the pending correction of the
          heading changes by -`turn`.
        - If the gyro was refuted, the result is 0, and no correction is pending.
        """
        verdict = self._trial.verdict
        if verdict == "none yet":
            self._owed -= turn
        return turn if verdict == "good" else 0.0

    # Samples.

    def _time_of(self, sample: GyroSample) -> int:
        """Return the monotonic time at which `sample` would have arrived without jitter, ns.

        The samples of a backlog get the times at which they were measured. Even the last of them is
        then old, so the wheels provide the present turn.
        """
        last, self._last = self._last, sample
        if last is None or sample.stamp_ns is None or last.stamp_ns is None:
            return sample.at_ns
        late = self._promptest.add(sample.at_ns - last.at_ns, sample.stamp_ns - last.stamp_ns)
        was_set = self._is_late_for_good(late, sample.at_ns, last.at_ns)
        if was_set or last.stamp_ns - sample.stamp_ns > MIN_SET_BACK_NS:
            self._promptest, self._late_since = MinimumDelay(), None
            return sample.at_ns
        return sample.at_ns - max(0, int(late))

    def _is_late_for_good(self, late: float, at_ns: int, last_at_ns: int) -> bool:
        """Return whether the extra delay `late`, ns, is large and steady, because a clock was set.

        `at_ns` and `last_at_ns` are the arrival times of this sample and of the one before it, ns.
        """
        if late <= MAX_EXTRA_DELAY_NS:
            self._late_since = None
            return False
        since_ns, first = self._late_since or (at_ns, late)
        if late < first - MAX_DELAY_FALL_NS or at_ns - last_at_ns >= SILENCE_TIMEOUT_NS:
            since_ns, first = at_ns, late
        self._late_since = since_ns, first
        return at_ns - since_ns >= STEADY_DELAY_NS

    def _take(self, until_ns: int, resting: bool) -> None:
        """Process the samples until `until_ns`: learn the bias at rest, else add their turn."""
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
        """Whether the gyro has repeated its rate for so long that it must have a defect.

        If the gyro often repeats its rate without a defect, the repetitions prove nothing, and the
        value is always False.
        """
        share = (self._usual_repeats + 1) / (self._usual + 1)
        return share < MAX_REPEATING and share**self._repeats < MIN_CHANCE

    def _end_repetition(self) -> None:
        """Process the end of a repetition: the rate of the gyro has changed.

        If the gyro seems to have hung, its turns during the repetition make the heading more
        uncertain. If the repeated rate may be a new bias, the bias becomes more uncertain.
        """
        # The gyro may have hung while it contradicted the wheels. But a gyro without noise also
        # repeats its rate in an even turn with slipping wheels. Then the repetition begins with the
        # slip, and the wheels turn more than the robot.
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
        """Drop a correction that waits for the next line, and add it to the heading's uncertainty.

        A correction waits if the line that showed that the gyro hangs covers no known time.
        """
        if self._frozen:
            self._doubt += self._repeated * self._repeated + self._repeated_gaps

    # Comparison with the wheels.

    def _try(self, wheels: float, angle: float, variance: float, dt: float, resting: bool) -> bool:
        """Test a gyro that is not proven yet. Return whether the wheels must provide this turn.

        While the wheels rest, the gyro provides the turn, because a person may turn the robot.
        """
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
        """Record the turns of a feedback line, which are needed if the gyro later proves wrong.

        `angle` and `wheels` are the turns of the robot according to gyro and wheels, rad. `dt` is
        the time of the line, s. It is 0 after a gap, in which only the gyro has measured the turn.
        """
        off = angle - wheels
        self._repeated_gaps += 0.0 if dt > 0.0 else angle * angle
        self._repeated += off
        self._repeated_wheels += wheels
        self._guessed += off
        self._contradicted = self._contradicted + off if self._slip_s > 0.0 else 0.0

    def _end_contradiction(self) -> None:
        """Make the heading more uncertain by the difference between gyro and wheels.

        This is the difference of their turns since they began to contradict each other. Call this
        if the daemon can no longer find out whether the gyro or the wheels were right, for example
        because the gyro has been silent for `LOST_NS`.
        """
        self._doubt += self._contradicted * self._contradicted
        self._contradicted = 0.0

    def _doubted(self, wheels: float, dt: float, noise: float, lost: bool) -> Turn | None:
        """Return the wheels' turn, corrected for doubtful earlier turns of the gyro.

        Return None if no earlier turn is in doubt, or if `dt` is 0. Call this for a feedback line
        in which the wheels provide the turn. If the gyro hangs, the result contains a correction
        that replaces the gyro's earlier turns by the wheels' turns. In any case, the variance of
        the result contains the uncertainty of the earlier turns.

        Args:
            wheels: the turn according to the wheels, rad.
            dt: the time of the line, s; 0 after a gap.
            noise: the variance of the turn rate in the result, rad2/s2.
            lost: whether samples of the gyro are missing. A contradiction between gyro and wheels
                then does not end with this line, so it is not added to the uncertainty yet.
        """
        if dt <= 0.0:
            # This line gives no turn, so a correction for a gyro that hangs waits for the next one.
            if not lost and not self._frozen:
                self._end_contradiction()
            return None
        angle = 0.0
        if lost:
            # Samples are missing, so the wheels also give the turn since the sample before them,
            # unless they slipped already then.
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
