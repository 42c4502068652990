"""The state of one wheel: its speeds, the evidence about it, its rest and its warning."""

from __future__ import annotations

from msgspec import Struct, field

from acsard.core.codes import Code, joined, reason
from acsard.core.motion.obedience import AGREEMENT, REACTION, Bounds, Obedience
from acsard.core.motion.sides import Block, Side
from acsard.core.motion.standstill import COMMANDED
from acsard.core.values import Rad, RadPerS, Seconds

# Beyond the evidence for a fault, of the largest speed: by so much may the motion be earlier or
# later than a delay.
TIMING_S = 0.2
AGREED_NOISE = 0.1  # of the noise of a smoothed speed: it may be the rest of one count

REST_S, REST_ANGLE = 0.5, 0.02  # at least, without a command: the wheel rests

# Times the largest output of the limiter, and rad and counts rolled beyond that, both of them: a
# sound wheel shows up to a count more than it turned.
TOO_FAST, TOO_FAST_S, TOO_FAST_ANGLE, TOO_FAST_COUNTS = 1.2, 1.0, 0.3, 2.5
ROUNDING = 0.006  # rad/s, of a reported speed
JITTER_S = 0.004  # of the times of lines


class Wheel(Struct):
    command: RadPerS = 0.0
    speed: RadPerS = 0.0  # smoothed
    expected: RadPerS = 0.0  # smoothed alike
    turned: Rad = 0.0  # since the last step
    sure: Rad = 0.0  # the same, but not within a count: at its edge, a wheel shows it to and fro
    sure_speed: RadPerS = 0.0  # smoothed
    play: Rad = 0.0  # how far the wheel may turn back within a count
    agrees: bool = True
    obedience: Obedience = field(default_factory=Obedience)
    rolled: Rad = 0.0  # either way, while it is faster or slower than expected
    due: Rad = 0.0  # what was due meanwhile
    timing: Rad = 0.0  # by which a sound wheel may be earlier or later than expected
    rested: bool = True  # and was not commanded since then
    rest_s: Seconds = 0.0
    rest_angle: Rad = 0.0
    fast_s: Seconds = 0.0  # faster than the limiter allows
    fast_angle: Rad = 0.0  # rolled beyond that
    latched: bool = False  # by a fault, until it is cleared
    reported: RadPerS = 0.0  # in the last line
    same_s: Seconds = 0.0  # for which it repeats this speed
    warning: Code | None = None

    def add(self, angle: Rad, speed: RadPerS, command: RadPerS, block: Block, moves: bool) -> None:
        """Add its part of a block. The robot `moves` by its commands."""
        s, self.command = block.s, command
        self.turned += angle
        play = self.play + angle
        self.play = min(max(play, 0.0), block.unit)
        self.sure += play - self.play
        if moves:
            self.end_rest()
        if not -COMMANDED < command < COMMANDED:
            self.rest_s = self.rest_angle = 0.0
        elif not self.rested:
            self.rest(angle, block)
        slack = ROUNDING * s + JITTER_S * abs(speed)
        if speed == self.reported != 0.0 and abs(angle - speed * s) < slack:
            self.same_s += s
        else:
            self.same_s, self.reported = 0.0, speed

    def end_rest(self) -> None:
        """The robot moves by its commands: a side that stands meanwhile is commanded to."""
        if self.rested:
            self.obedience.forget()
            self.rested, self.rest_s, self.rest_angle = False, 0.0, 0.0

    def rest(self, angle: Rad, block: Block) -> None:
        """Add a block without a command."""
        self.rest_angle += angle
        self.rest_s += block.s
        if abs(self.rest_angle) > 1.01 * block.unit + REST_ANGLE:
            self.rest_s = self.rest_angle = 0.0
        elif self.rest_s >= block.rest:
            self.rested, self.rest_s, self.rest_angle = True, 0.0, 0.0
            self.obedience.forget()

    def follow(
        self, side: Side, s: Seconds, share: float, noise: RadPerS, bounds: list[Bounds], least: Rad
    ) -> None:
        """End a step of `s` seconds, with `bounds` of the smoothed speeds and their `noise`."""
        obedience, angle, largest = self.obedience, self.turned, side.due.most
        speed = self.speed = self.speed + (angle - self.speed * s) * share
        self.expected = side.smooth[-1]
        turns = speed if speed > 0.0 else -speed
        self.timing = TIMING_S * max(largest, turns)
        # Faster than the limiter allows; a wheel that slows down may have been faster before.
        sure = self.sure_speed = self.sure_speed + (self.sure - self.sure_speed * s) * share
        rolls = sure if sure > 0.0 else -sure
        slows = min(0.0, rolls + noise - abs(obedience.speeds[-1]))
        fast = self.fast_angle + (rolls + REACTION * slows - TOO_FAST * largest) * s
        if fast > 0.0 and not -COMMANDED < self.command < COMMANDED:
            self.fast_s, self.fast_angle = self.fast_s + s, fast
        else:
            self.fast_s = self.fast_angle = 0.0
        obedience.add(sure, turns, bounds, s, least + self.timing)
        difference = abs(speed - self.expected)
        agrees = difference <= AGREEMENT * max(turns, abs(self.expected))
        self.agrees = agrees or difference < AGREED_NOISE * noise

    def too_fast(self, largest: RadPerS, count: Rad) -> bool:
        """Whether it has been faster than the limiter allows for long enough."""
        enough = max(TOO_FAST_ANGLE, TOO_FAST_COUNTS * count)
        fast = self.fast_s >= TOO_FAST_S and self.fast_angle >= enough
        return fast and abs(self.sure_speed) > TOO_FAST * largest

    def pace(self, count: Rad, s: Seconds) -> Code | None:
        """Return its warning after a step of `s` seconds."""
        slow, beyond = min(self.obedience.slow), min(self.obedience.fast)
        if slow or beyond:
            self.rolled += abs(self.turned)
            self.due += abs(self.expected) * s
        else:
            self.rolled = self.due = 0.0
        if -COMMANDED < self.command < COMMANDED:
            return self.warning
        if beyond >= count + self.timing:
            return self.warning or "wheel_fast"
        if slow >= count + self.timing:
            stands = abs(self.speed) < AGREEMENT * abs(self.command)
            return "wheel_blocked" if stands else self.warning or "wheel_slow"
        return None if self.agrees and not slow and not beyond else self.warning

    def stand(self) -> None:
        """Smooth the speed from rest."""
        self.speed = self.sure_speed = 0.0
        self.obedience.speeds = [0.0] * len(self.obedience.speeds)

    def forget(self) -> None:
        """Another fault needs new evidence."""
        self.obedience.forget()
        self.fast_s = self.fast_angle = 0.0

    def text(self, name: str) -> str:
        """Return the words of its warning."""
        assert self.warning is not None
        share = self.rolled / self.due if self.due else 0.0
        return joined(reason(self.warning, wheel=name, share=f"{share:.0%}")).text
