"""The promise that no stuck motor runs on under a moving stick, or while the link flickers.

A wheel whose motor keeps its speed must be a latched fault before it has rolled `MOST_M` further
than it was commanded, or less far, under any pattern of commands. Its way counts while the mean of
its speed differs from that of the commands, because a stuck motor whose speed is the mean of the
commands cannot be told from a slow one. If it differs little, `state` must name the wheel at least.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS

MOST_M = 4.0

MEAN_NS, DIFFERS = 5 * NS, 0.5
"""Time of both means, and the share of the commanded one by which they certainly differ."""

SURELY_DIFFERS = 0.65
"""The same share from which on a warning is not enough. A stick dips to 0 for 0.4 s of each 0.95 s,
and the motors keep its largest speed: 59 % more than the mean, and not faster than any delay
allows."""

Ways = tuple[float, float]
"""The way of a wheel and its commanded way, rad."""


class _Wheel:
    """A wheel whose motor keeps its speed."""

    def __init__(self, angle: float) -> None:
        self.angle = angle
        self.excess = 0.0  # its way minus the commanded one, rad
        self.ways: deque[tuple[int, Ways]] = deque()
        self.sums = 0.0, 0.0  # of these ways


class Excess:
    """Compares the true ways of stuck wheels with those that the lines on the wire command."""

    def __init__(self, witness: Witness, state: Callable[[], dict[str, Any]]) -> None:
        self._witness, self._state = witness, state
        self._step_ns = 0
        self._wheels: dict[int, _Wheel] = {}
        """By place, while their motors are stuck and no fault is latched."""
        self._turns = 0.0  # the last command of a wheel that grew or fell
        self._command = 0.0

    def count(self) -> None:
        """Count how often the commands turn from forward to back, or from slow to fast."""
        command = self._witness.last[0]
        change = command - self._command
        self._command = command
        if change * self._turns < 0.0:
            self._witness.counts["commands that turn"] += 1
        self._turns = change or self._turns

    def forget(self) -> None:
        """Begin anew, because no motor is stuck, or because its fault is latched."""
        self._wheels.clear()

    def see(self, at_ns: int, angles: Sequence[float], latched: bool, quiet_ns: int) -> None:
        """Judge a step.

        Args:
            at_ns: Time of this step.
            angles: The true angle of each wheel, rad, in the order of the commands.
            latched: A fault is latched.
            quiet_ns: Until then something else happened, such as a stall or an unplugging.
        """
        witness, passed_ns = self._witness, at_ns - self._step_ns
        self._step_ns = at_ns
        stuck = {values[0] for name, values in witness.lies if name == "runaway"}
        if latched or at_ns - quiet_ns < NS or not stuck:
            self.forget()
            return
        for place, angle in enumerate(angles):
            if witness.motors[place][0] not in stuck:
                self._wheels.pop(place, None)
                continue
            wheel = self._wheels.get(place)
            if wheel is None:
                self._wheels[place] = _Wheel(angle)
                continue
            ways = angle - wheel.angle, witness.last[place] * passed_ns / NS
            wheel.angle = angle
            self._add(wheel, at_ns, ways)
            metres = abs(wheel.excess) * witness.radius
            witness.counts["largest excess mm"] = max(
                witness.counts["largest excess mm"], int(1000 * metres)
            )
            if metres > MOST_M and not self._named(place, wheel):
                text = f"wheel {place} has rolled {metres:.2f} m more or less than commanded"
                raise BrokenError("a wheel that does not obey is found", at_ns, text)

    def _named(self, place: int, wheel: _Wheel) -> bool:
        true, commanded = wheel.sums
        if abs(true - commanded) > SURELY_DIFFERS * abs(commanded):
            return False
        return f"{self._witness.names[place]} wheel" in self._state()["wheel_fault"]

    def _add(self, wheel: _Wheel, at_ns: int, ways: Ways) -> None:
        self._witness.counts["stuck wheels"] += 1
        wheel.ways.append((at_ns, ways))
        true, commanded = wheel.sums[0] + ways[0], wheel.sums[1] + ways[1]
        while wheel.ways[0][0] < at_ns - MEAN_NS:
            _, old = wheel.ways.popleft()
            true, commanded = true - old[0], commanded - old[1]
        wheel.sums = true, commanded
        if abs(true - commanded) > DIFFERS * abs(commanded):
            wheel.excess += ways[0] - ways[1]
        else:
            wheel.excess = 0.0
