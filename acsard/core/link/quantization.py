"""Detects the quantization of the reported speeds and recovers whole encoder counts from them.

If a wheel's speeds lie on a lattice (`lattice.py`), each speed is a whole number of counts. With
the firmware's period it is then an exact angle, so a line tells exactly how far the wheel turned.
The period by which a firmware divides is a round number near the mean period of its lines. It is
proven if it makes the counts per turn whole. Each wheel has an encoder of its own
(`wheel_counter.py`).

The counts are trusted while they agree with the times of the lines. If the firmware starts to
report in another way, or the port is reopened, learning starts over.
"""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.wheel_counter import WheelCounter

LOOK = 50
"""Lines from one check of the findings to the next."""

LONG = 100
"""Checks over which the mean period is taken."""

STRAYS = 4
"""Speeds off the lattice that end it. Each check forgives one, because 2 % may be damaged."""

ROUND_PERIOD = 0.006
"""Relative error of a period against its round number. A ceramic resonator has 0.5 %."""

APART_S, MOST_APART = 0.1, 5.0
"""Largest difference between the counts and the times of the lines: in s, or in periods if that is
more."""

KEPT = 0.98
"""Share of that difference that is kept with each line, because two clocks drift apart for ever."""

GLANCE, MISSING = 10, 0.6
"""Lines, and periods by which all of them were late. Then a line is missing that gap filling has
not counted."""

ALIKE = 3.0
"""Bound on a wheel's reported step, as a multiple of the second largest of the four. Random jumps
look like steps too, and only proven counts may be coarser than this."""

NOTHING = (0.0, 0.0, 0.0, 0.0)


class Snapping:
    """The quantization of all wheels, learned from every good line of one port."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start over: the board may be another one, or it reports in another way."""
        self._wheels = [WheelCounter() for _ in NOTHING]
        self._owing: list[int] = []
        self._reported, self._steps = NOTHING, NOTHING
        """rad/s. The step that each wheel reports, and the bounded step that is passed on."""
        self._time, self._lines = 0.0, 0
        self._period = self._apart = self._least = 0.0
        """Seconds. The period by which the firmware divides, 0 while unknown; the excess of the
        lines' times over the counts; the least excess in the present group of `GLANCE` lines."""

    def forgive(self) -> None:
        """Drop the corrections for past rounding, because the pose was reset."""
        for wheel in self._wheels:
            wheel.forgive()

    @property
    def counts(self) -> tuple[int, ...]:
        """Counts per turn found for each wheel's encoder, in `WHEELS` order; 0 if unknown."""
        return tuple([wheel.counts for wheel in self._wheels])

    def look(self, line: Feedback) -> Feedback:
        """Return the line with its counted angles, if its speeds show any, and its steps."""
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
        """Return the step of each wheel's speed, from its reports or its proven counts, rad/s."""
        most = ALIKE * sorted(reported)[2]
        a, b, c, d = (
            wheel.quantum or min(step, most)
            for wheel, step in zip(self._wheels, reported, strict=True)
        )
        return a, b, c, d

    def _counted(self, speeds: Motors, own: float) -> Motors | None:
        """Return how far each wheel turned in the `own` s of this line, rad, or None if unknown."""
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
            # The times of the lines correct the excess or shortfall of the counts.
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
        """Return the duration of missing lines before this one that no gap filling has counted, s.

        Return None if the times of the lines contradict the counts.
        """
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
        """Add the correction owed to one wheel. One wheel per line keeps every step short."""
        wheel, angles = self._owing.pop(), list(counted)
        angles[wheel] += self._wheels[wheel].owed(self._period)
        a, b, c, d = angles
        return a, b, c, d

    def _take_a_look(self) -> bool:
        """Return whether the wheels still report as before. If not, start over."""
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
        """Find the counts per turn and the period that explain the lattices."""
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
    """Return the periods, s, by which a firmware may divide if its lines are `mean` s apart."""
    near = (round(mean * 1000) / 1000, 1 / max(1, round(1 / mean)))
    return [period for period in near if abs(mean - period) <= ROUND_PERIOD * mean]
