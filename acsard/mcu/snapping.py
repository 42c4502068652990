"""What coarse encoders do to the reported speeds, and whole counts where these show them.

Where a wheel's speeds lie on a lattice (`lattice.py`) each is a whole number of counts, and by the
firmware's period an angle without rounding: a line says exactly how far the wheel turned in it. The
period that a firmware divides by is a round one near that of its lines; that it makes whole counts
a turn proves it. Each wheel has an encoder of its own (`wheel_counter.py`).

The counts are trusted as long as they and the lines' times say the same: a firmware that reports
otherwise than it did is learned anew, and so is one behind a port opened again.
"""

from __future__ import annotations

from msgspec.structs import replace

from acsard.mcu.codec import Motors
from acsard.mcu.feedback import Feedback
from acsard.mcu.wheel_counter import WheelCounter

LOOK = 50
"""Lines from one look at what was found, and what still holds, to the next."""

LONG = 100
"""Looks over which the mean period is taken."""

STRAYS = 4
"""Speeds off the lattice that end it, of which each look forgets one: 2 % may be damaged."""

ROUND_PERIOD = 0.006
"""By which share a period may be off its round number: a ceramic resonator has 0.5 %."""

APART_S, MOST_APART = 0.1, 5.0
"""s, and periods where that is more, by which counts and the lines' times may say otherwise."""

KEPT = 0.98
"""Share of that kept with each line: two clocks go apart for ever."""

GLANCE, MISSING = 10, 0.6
"""Lines all of which came so many periods late: one is missing that nobody has bridged."""

ALIKE = 3.0
"""How much further than the second coarsest of four encoders one may step by what it reports: what
jumps at random shows steps too, and only proven counts may be so much coarser."""

NOTHING = (0.0, 0.0, 0.0, 0.0)


class Snapping:
    """Looks at every good line of one port."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Another MCU may be there, or the same one may report otherwise."""
        self._wheels = [WheelCounter() for _ in NOTHING]
        self._owing: list[int] = []
        self._reported, self._steps = NOTHING, NOTHING
        """rad/s; how far each wheel's reports step, and what is made of that."""
        self._time, self._lines = 0.0, 0
        self._period = self._apart = self._least = 0.0
        """s; what the firmware divides by, 0 while unknown; how much more the lines' times say,
        and the least of that in this glance."""

    def forgive(self) -> None:
        """What rounding has cost until now is of a pose that counts no more."""
        for wheel in self._wheels:
            wheel.forgive()

    @property
    def counts(self) -> tuple[int, ...]:
        """Counts per turn found of each wheel's encoder, in `WHEELS` order; 0 is not found."""
        return tuple([wheel.counts for wheel in self._wheels])

    def look(self, line: Feedback) -> Feedback:
        """The line with what its counts are, where it shows them, and how far they make it step."""
        own, speeds, counted = line.dt - line.bridged, line.speeds.as_tuple(), None
        if line.turned is None and own > 0.0:
            counted = self._counted(speeds, own)
        a, b, c, d = self._wheels
        if counted is None:
            a.steps.add(speeds[0])
            b.steps.add(speeds[1])
            c.steps.add(speeds[2])
            d.steps.add(speeds[3])
        reported = a.steps.size, b.steps.size, c.steps.size, d.steps.size
        if reported != self._reported:
            self._reported, self._steps = reported, self._bounded(reported)
        return replace(line, counted=counted, steps=self._steps)

    def _bounded(self, reported: Motors) -> Motors:
        """How far the wheels' speeds step, of what they report and what is proven, rad/s."""
        most = ALIKE * sorted(reported)[2]
        a, b, c, d = (
            wheel.quantum or min(step, most)
            for wheel, step in zip(self._wheels, reported, strict=True)
        )
        return a, b, c, d

    def _counted(self, speeds: Motors, own: float) -> Motors | None:
        """How far each wheel turned in the `own` s of this line, rad; None: nothing is known."""
        self._lines, self._time = self._lines + 1, self._time + own
        if not self._lines % LOOK and not self._take_a_look():
            return None
        if self._wheels[self._lines % len(self._wheels)].go_on():
            self._settle()
        wheels, period = self._wheels, self._period
        if not period:
            for wheel, speed in zip(wheels, speeds, strict=True):
                wheel.learn(speed)
            return None
        missing = self._missing(own)
        if missing is None:
            # What the counts have said too much or too little is settled by the lines' times.
            settled = self._apart + period
            self.forget()
            front_right, front_left, rear_left, rear_right = (s * settled for s in speeds)
            return front_right, front_left, rear_left, rear_right
        a, b, c, d = wheels
        counted = (
            a.turned(speeds[0], own, missing),
            b.turned(speeds[1], own, missing),
            c.turned(speeds[2], own, missing),
            d.turned(speeds[3], own, missing),
        )
        return self._made_good(counted) if self._owing else counted

    def _missing(self, own: float) -> float | None:
        """s of lines that nobody has bridged, which are missing before this one; None: the lines'
        times say otherwise than the counts."""
        period = self._period
        apart = self._apart = self._apart * KEPT + own - period
        if abs(apart) > max(APART_S, MOST_APART * period):
            return None
        if apart < self._least:
            self._least = apart
        if self._lines % GLANCE:
            return 0.0
        least, self._least = self._least, apart
        missing = round(least / period) * period if least > MISSING * period else 0.0
        self._apart -= missing
        return missing

    def _made_good(self, counted: Motors) -> Motors:
        """These angles and what one wheel is owed: one a line, so that none takes long."""
        wheel, angles = self._owing.pop(), list(counted)
        angles[wheel] += self._wheels[wheel].owed(self._period)
        a, b, c, d = angles
        return a, b, c, d

    def _take_a_look(self) -> bool:
        """Whether the wheels still report as they did."""
        wheels = self._wheels
        if any(wheel.off > STRAYS for wheel in wheels):
            self.forget()
            return False
        for wheel in wheels:
            wheel.off = max(0, wheel.off - 1)
        self._settle()
        if self._lines >= LONG * LOOK:
            self._time, self._lines = 0.0, 0
        return True

    def _settle(self) -> None:
        """Find what counts, and what period, the lattices are made of."""
        found = [i for i, w in enumerate(self._wheels) if w.lattice and not w.counts]
        if not found or self._lines < LOOK:
            return
        for period in [self._period] if self._period else _round(self._time / self._lines):
            shown = [i for i in found if self._wheels[i].show(period)]
            self._owing += shown
            if shown:
                self._period, self._reported = period, NOTHING
                return


def _round(mean: float) -> list[float]:
    """The periods in s that a firmware may divide by whose lines are `mean` s apart."""
    near = (round(mean * 1000) / 1000, 1 / max(1, round(1 / mean)))
    return [period for period in near if abs(mean - period) <= ROUND_PERIOD * mean]
