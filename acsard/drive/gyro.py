"""The heading from a gyro, where there is one: the distance stays the wheels'.

Gyrodometry (Borenstein & Feng, Gyrodometry: a new method for combining data from gyros and
odometry in mobile robots, 1996): a gyro knows nothing of skidding wheels, wheels nothing of its
bias. The bias is what it says at rest (`gyro_bias.py`), its delay and the track it implies come
from comparing both (`gyro_match.py`). Until both have agreed in a turn the wheels tell every way,
which is made up for then: a gyro that says the opposite, degrees or nothing is named and not used
(`gyro_trial.py`). Silent, or out of all proportion to the wheels, it leaves them alone.

What has been handed out is remembered and not the time: whatever came late or was held over for a
moment is in the next line's turn, and no error of that kind adds up.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

from msgspec import Struct

from acsard.drive.gyro_bias import KNOWN_S, Bias
from acsard.drive.gyro_match import WINDOW_S, Match
from acsard.drive.gyro_trial import PROPORTIONS, Trial
from acsard.drive.learned_track import LEAST, Track
from acsard.mcu.promptest import Promptest
from acsard.values import NS_PER_S, Event, GyroDoes, GyroSample, GyroStatus, Level

REST_S = 0.2
"""s of four zeros until the robot stands."""

SILENT_NS = NS_PER_S // 5
"""A gyro of which nothing came for so long is silent; until then it turns on as it did."""

LATEST_NS = NS_PER_S // 4
"""A stamp that says more is of a clock that was set."""

DRIFT = 0.01
"""By which share the gyro's clock may go apart from ours."""

DELAYS_NS = (-NS_PER_S // 10, 3 * NS_PER_S // 10)
"""How much earlier or later than the wheels a gyro may tell."""

LEAST_DELAY_S = 0.002
"""Less is not worth moving it for."""

SLIP_S = 0.5
"""s after the last contradiction for which it slips on."""

MOST_SLIP_S = 5.0
"""s that wheels slip in one go; a gyro that contradicts them for longer is stuck, or no gyro."""

ENOUGH_BLOCKS = 20.0
"""Blocks of turning after which the proportion is believed."""

WORDS: dict[GyroDoes, str] = {
    "off": "",
    "waiting for rest": "the gyro's bias is not known yet: the robot must stand for "
    f"{REST_S + KNOWN_S:.1f} s",
    "used": "the heading is the gyro's",
    "silent": "the gyro is silent: the heading is the wheels' alone",
    "disagrees": "the wheels slip: the gyro says another turn than they do",
    "reversed": "not used: the gyro turns the other way than the wheels: check its mounting",
    "in degrees": "not used: the gyro reads 57 times too much: degrees per second, not radians",
    "dead": "not used: the gyro says no rate while the wheels turn the robot",
    "not believed": "the gyro turns out of all proportion to the wheels: does its z point up?",
}


class Turn(Struct, frozen=True, gc=False):
    """By how much the robot turned since the line before: rad, and its variance, rad2.

    How far the gyro's scale is off is no part of that: it does not average out (`uncertainty.py`).
    """

    angle: float
    variance: float
    rate: float
    """rad/s, what it says now, and its variance: the angle may hold what came late."""
    rate_variance: float
    wheels: float | None = None
    """rad the wheels would tell for this turn, skidding as they do."""
    slips: bool = False
    """The wheels do: they told another turn of late."""


class Heading(Protocol):
    """Who tells by how much the robot turned, beside its wheels: a `Gyro`."""

    owes: bool

    def turn(self, at_ns: int, dt: float, wheels: float, still: bool) -> Turn | None: ...

    def taken_back(self, turn: float) -> float: ...


class Gyro:
    """One gyro beside the wheels: `hear` its samples, then ask each line's `turn`."""

    def __init__(self) -> None:
        self._rest_s = self._since_rest_s = 0.0
        self._learned: Track | None = None
        """What the gyro before this one taught."""
        self.owes = False
        """The wheels told the turn of the last line, until the trial ends."""
        self._does: GyroDoes = "silent"
        self.events: list[Event] = []
        """What the last `turn` found worth a log line."""
        self._begin()

    def _begin(self) -> None:
        """Of this gyro nothing is known, neither bias nor delay nor which way it turns."""
        self._bias, self._match, self._trial = Bias(), Match(), Trial()
        self._heard: deque[tuple[int, GyroSample]] = deque(maxlen=256)
        """Samples of times that no line has reached yet."""
        self._promptest = Promptest(DRIFT)
        self._last: GyroSample | None = None
        self._delay_ns = 0
        self._told_ns: int | None = None
        """The time of the last sample that was taken."""
        self._rate = 0.0
        self._angle = self._given = 0.0
        """rad turned by all samples taken, and what of it was handed out."""
        self._variance = 0.0
        """rad2 of what was not handed out yet."""
        self._slip_s = self._slipped_s = 0.0
        self._noise = 0.0
        """Variance of the last sample."""
        self._hole = False
        """Since the last line, or in it, some of the turn was not heard."""
        self.forgive()

    @property
    def status(self) -> GyroStatus:
        """What it does now."""
        known, learned = self._bias.value if self._bias.known else None, self.learned
        track, deviation = (None, 0.0) if learned is None else (learned.share, learned.deviation)
        return GyroStatus(self._does, known, self._delay_ns / NS_PER_S, track, deviation)

    @property
    def learned(self) -> Track | None:
        """The effective track it implies; None until it has turned with the wheels for a while."""
        match = self._match
        if match.blocks < ENOUGH_BLOCKS or match.ratio <= 0.0:
            return self._learned
        return Track(1.0 / match.ratio, max(LEAST, match.spread / match.ratio))

    def hear(self, samples: tuple[GyroSample, ...]) -> None:
        """What came since the last step, in order."""
        for sample in samples:
            if sample.anew:
                self._learned = self.learned  # the wheels' and the floor's, whoever told it
                self._begin()
            self._hole |= len(self._heard) == self._heard.maxlen
            self._heard.append((self._time_of(sample), sample))

    def turn(self, at_ns: int, dt: float, wheels: float, still: bool) -> Turn | None:
        """What it turned until a line of the time `at_ns`; None when only the wheels can tell.

        `wheels` rad over `dt` s is what they say; `still` that all four stood. After a gap `dt` is
        0 and the turn is all that came about in it.
        """
        self.events, self.owes = [], False
        self._rest_s = self._rest_s + dt if still else 0.0
        resting = self._rest_s > REST_S
        self._take(at_ns, resting)
        ahead = SILENT_NS if self._told_ns is None else at_ns - self._told_ns
        silent = ahead - max(0, self._delay_ns) >= SILENT_NS
        held = 0.0 if resting or silent else self._rate * max(0, ahead) / NS_PER_S
        angle, variance = self._angle + held - self._given, self._variance
        self._given, self._variance = self._angle + held, 0.0
        # What is heard of a silence only after it the wheels have told: the line after is theirs.
        lost, self._hole = silent or self._hole, silent
        self._since_rest_s = 0.0 if resting else self._since_rest_s + dt
        variance += 2.0 * self._bias.variance * self._since_rest_s * dt  # it does not average out
        tried = False if lost else self._try(wheels, angle, variance, dt, resting)
        if not lost and self._bias.known and dt > 0.0 and not self._trial.open:
            self._compare(wheels, angle, dt)
        if resting:
            self._shift()
        self._judge(silent)
        if lost or tried or self._does not in ("used", "disagrees"):
            return None
        rolled = angle / max(PROPORTIONS[0], self._match.ratio)
        if not self._trial.open:
            angle, variance = angle + self._owed, variance + self._owed_variance
            self.forgive()
        noise = self._noise + self._bias.variance
        return Turn(angle, variance, self._rate, noise, rolled, self._does == "disagrees")

    def forgive(self) -> None:
        """Owe nothing: the pose was set, and what it was before is of no account."""
        self._owed = self._owed_variance = 0.0
        """rad by which it told more than the wheels while it was on trial: owed if it is proved."""

    def taken_back(self, turn: float) -> float:
        """Of lines that it `owes`, the wheels' turn has become another one, by so many rad.

        Returns the rad of that which it had put right before.
        """
        verdict = self._trial.verdict
        if verdict == "none yet":
            self._owed -= turn
        return turn if verdict == "good" else 0.0

    # samples

    def _time_of(self, sample: GyroSample) -> int:
        """When it was measured, by our clock and but for a constant: stamps come without jitter."""
        last, self._last = self._last, sample
        if last is None or sample.stamp_ns is None or last.stamp_ns is None:
            return sample.at_ns
        late = self._promptest.add(sample.at_ns - last.at_ns, sample.stamp_ns - last.stamp_ns)
        if late > LATEST_NS:
            self._promptest = Promptest(DRIFT)
            return sample.at_ns
        return sample.at_ns - max(0, int(late))

    def _take(self, until_ns: int, resting: bool) -> None:
        """Add up the samples of times until then; at rest they tell the bias."""
        bias, heard = self._bias, self._heard
        until_ns += self._delay_ns
        while heard and heard[0][0] <= until_ns:
            time_ns, sample = heard.popleft()
            time_ns -= self._delay_ns
            span_ns = SILENT_NS if self._told_ns is None else time_ns - self._told_ns
            self._hole |= span_ns >= SILENT_NS
            self._told_ns = time_ns if self._told_ns is None else max(time_ns, self._told_ns)
            passed = max(0, span_ns) / NS_PER_S
            span = passed if span_ns < SILENT_NS else 0.0
            bias.drift(passed)
            stands = resting and bias.rest(sample.rate, sample.variance, span)
            self._rate = 0.0 if stands else sample.rate - bias.value
            self._noise = max(bias.noise, sample.variance)
            self._angle += self._rate * span
            if not stands:
                self._variance += self._noise * span * span

    # beside the wheels

    def _try(self, wheels: float, angle: float, variance: float, dt: float, resting: bool) -> bool:
        """Until a turn has proved it: whether this line is one that the wheels tell.

        That is every one but at rest, where they would not see that somebody turns the robot.
        """
        trial, known = self._trial, self._bias.known
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
            self.forgive()
        return True

    def _compare(self, wheels: float, angle: float, dt: float) -> None:
        self._match.add(wheels, angle, dt, self._slip_s > 0.0)
        noise = 2.0 * self._bias.variance * WINDOW_S * WINDOW_S + self._bias.noise * WINDOW_S * dt
        if self._match.contradiction(noise):
            self._slip_s = SLIP_S
        else:
            self._slip_s = max(0.0, self._slip_s - dt)
        self._slipped_s = self._slipped_s + dt if self._slip_s > 0.0 else 0.0

    def _shift(self) -> None:
        """At rest, where it moves nothing, put the gyro's time right."""
        delay = self._match.delay()
        if delay is not None and abs(delay) >= LEAST_DELAY_S:
            earliest, latest = DELAYS_NS
            shifted = self._delay_ns + math.floor(delay * NS_PER_S)
            self._delay_ns = min(max(earliest, shifted), latest)

    def _judge(self, silent: bool) -> None:
        match, before, verdict = self._match, self._does, self._trial.verdict
        least, most = PROPORTIONS
        wrong = match.blocks >= ENOUGH_BLOCKS and not least <= match.ratio <= most
        if verdict != "none yet" and verdict != "good":
            self._does = verdict
        elif silent:
            self._does = "silent"
        elif not self._bias.known:
            self._does = "waiting for rest"
        elif wrong or self._slipped_s > MOST_SLIP_S:
            self._does = "not believed"
        else:
            self._does = "disagrees" if self._slip_s > 0.0 else "used"
        if self._does != before:
            good = self._does in ("used", "waiting for rest")
            level: Level = "info" if good else "warning"
            self.events.append(Event("gyro", WORDS[self._does], level, kind=self._does))
