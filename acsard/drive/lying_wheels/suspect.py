"""Does one wheel of a side lie? Its sign, and what the command or a gyro says of it.

An encoder that lies does so in one of three ways: it is dead (says no turn), reversed (the other
wheel's turn the other way round) or stuck (says one and the same). A wheel with such a sign lies if
it is further off than the other one from what is known from elsewhere: the turn a gyro tells, else
the command, by which a healthy wheel is between what it is told and what a slow wheel would have
made of that by now. Without either nothing is known: who pushes a robot by hand may well turn one
wheel and not the other.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

LIE_S, LIE_LINES = 0.025, 2
"""s and lines for which it has to lie: three at 100 Hz, so that one spoilt reading is none."""

LIE_COUNTS, LIE_ANGLE = 3.5, 0.05
"""Counts and rad by which the other wheel must have turned on meanwhile."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 1.5, 0.01
"""Counts and rad by which even a slow wheel has left its speed: one that turns by its command
cannot have said one and the same all the time, and if the other one has followed, it is stuck."""

VOTE = 1 / 3
"""Share of what is between the two wheels by which it must be further off than the other one."""

HAND_S = 0.3
"""s of one and the same speed with nothing commanded that no hand can turn a wheel at."""

DEAD, REVERSED = 0.1, 0.3
"""Shares of the other wheel's turn: less is none, and so close to its opposite is that."""

STUCK = 0.3
"""Share of the faster wheel's turn by which one is off that says the same: less is slip beside a
wheel that goes at a steady speed."""

Lie = Literal["dead", "reversed", "stuck"]

WORDS: dict[Lie, str] = {
    "dead": "says it stands while the other wheel of its side turns",
    "reversed": "says the opposite of the other wheel of its side",
    "stuck": "says one and the same speed",
}


class Known(Struct, frozen=True):
    """What is known of one side's turning in one line beside its wheels, rad; None is nothing."""

    slow: float
    """A wheel's that follows its command slowly."""
    command: float
    """A wheel's that follows at once."""
    commanded: bool
    """There is a command, and no slow one."""
    gyro: float | None


class _Ballot:
    """How far both wheels turned, and how far one can have that tells the truth, rad."""

    def __init__(self) -> None:
        self._own = self._other = self._low = self._high = 0.0

    def add(self, own: float, other: float, low: float, high: float) -> None:
        """Of one line."""
        self._own += own
        self._other += other
        self._low += low
        self._high += high

    @property
    def apart(self) -> float:
        """rad between the two."""
        return abs(self._own - self._other)

    @property
    def vote(self) -> float:
        """From 1, that all of it is the suspect's, to -1, that it is the other one's."""
        return (self._off(self._own) - self._off(self._other)) / (self.apart or 1.0)

    @property
    def share(self) -> float:
        """What is between the two of what the faster one turned."""
        return self.apart / (max(abs(self._own), abs(self._other)) or 1.0)

    def _off(self, turned: float) -> float:
        return max(self._low - turned, turned - self._high, 0.0)


class Suspect:
    """One wheel that has the sign of a lie, line after line."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Nothing is suspicious about it."""
        self.lie: Lie | None = None
        self._lines = 0
        self._seconds = self._apart = 0.0
        self._command, self._gyro = _Ballot(), _Ballot()
        self._first: float | None = None
        """rad/s of a slow wheel when it was first looked at, and rad that it went since beyond
        that."""
        self._followed = 0.0

    def looks(self, own: float, other: float, same: bool, dt: float, count: float) -> bool:
        """Whether it does, after a line of `dt` s: rad of both wheels, and of an encoder's count.

        `same` if it says the very speed of the line before.
        """
        lie = self._sign(own, other, same, count)
        if lie != self.lie:
            self.forget()
            self.lie = lie
        self._lines += 1
        self._seconds += dt
        self._apart += other - own
        return lie is not None

    def _sign(self, own: float, other: float, same: bool, count: float) -> Lie | None:
        """The one it had, as long as it has it; through zero and at rest all of them look alike."""
        if self.lie == "stuck" and same:
            return "stuck"
        if reverses(own, other, count) or (self.lie == "reversed" and own * other == 0.0):
            return "reversed"
        if stands(own, other):
            return "dead"
        return "stuck" if same else None

    def compare(self, own: float, other: float, dt: float, known: Known) -> None:
        """What else is known in that line."""
        if known.commanded:
            low, high = min(known.slow, known.command), max(known.slow, known.command)
            self._command.add(own, other, low, high)
            slow = known.slow / dt
            self._first = slow if self._first is None else self._first
            self._followed += (slow - self._first) * dt
        if known.gyro is not None:
            self._gyro.add(own, other, known.gyro, known.gyro)

    def lies(self, count: float) -> bool:
        """It does, and not the other one; `count` rad is what an encoder's count is worth."""
        enough = LIE_COUNTS * count + LIE_ANGLE
        if self._lines < LIE_LINES or self._seconds < LIE_S or abs(self._apart) < enough:
            return False
        if self._gyro.apart >= enough and abs(self._gyro.vote) >= VOTE:
            return self._gyro.vote > 0.0 and self._plain(self._gyro)
        if self.lie == "stuck" and self._ignores(count):
            return True
        if self._command.apart >= enough:
            return self._command.vote >= VOTE and self._plain(self._command)
        nothing = self._first is None
        return self.lie == "stuck" and nothing and self._seconds >= HAND_S

    def _plain(self, ballot: _Ballot) -> bool:
        """They are so far apart that who goes at a steady speed cannot just have another tyre."""
        return self.lie != "stuck" or ballot.share >= STUCK

    def _ignores(self, count: float) -> bool:
        """The command has changed, and the other wheel went that way."""
        enough = FOLLOWED_COUNTS * count + FOLLOWED_ANGLE
        return abs(self._followed) >= enough and self._followed * self._apart > 0.0


def stands(own: float, other: float) -> bool:
    """A wheel that says it does, or nearly, of two that turned so far."""
    return own == 0.0 or abs(own) <= DEAD * abs(other)


def reverses(own: float, other: float, count: float) -> bool:
    """It says the opposite of the other one, but for encoder counts."""
    return own * other < 0.0 and abs(own + other) <= REVERSED * abs(other) + LIE_COUNTS * count


def has_lied(lie: Lie, own: float, other: float, now: float) -> bool:
    """Whether a line of before may belong to the same lie: speeds, and what it says now."""
    if lie == "reversed":
        return own * other < 0.0
    return stands(own, other) if lie == "dead" else own == now
