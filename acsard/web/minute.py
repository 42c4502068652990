"""What the plots show, of the last minute, for a page that has just been opened; pure.

All but what is wished is in the state, which comes anyway. What is wished comes a hundred times a
second, and only while somebody looks: for nobody it is not subscribed to.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from msgspec import Struct

from acsard.messages.schema import RobotState, Twist
from acsard.values import NS_PER_S, WHEELS

LASTS_NS = 60 * NS_PER_S

STEP_NS = NS_PER_S // 5
"""A phone's plot has a pixel for so long."""

EARLY_NS = STEP_NS // 4
"""Whoever looks looks a little early or late."""

ROWS = LASTS_NS // (STEP_NS - EARLY_NS)
"""At most."""

MEASURED = 2 + len(WHEELS)

WIDTH = MEASURED + 4
"""Of a row: what was measured, what was wished, and lateness."""

MS = 1e-3

Column = Sequence[float | None]
"""Oldest first; None where it is not known."""


class Plotted(Struct, frozen=True):
    """A column for each line of the plots, as long as `age`; thinned to five rows a second."""

    age: Sequence[int]
    """ms"""
    linear: Column
    """m/s, as the rest of the twists; measured, which without the board nobody does."""
    angular: Column
    """rad/s"""
    wished_linear: Column
    """After limits; known only while somebody follows `cmd_vel_out` here."""
    wished_angular: Column
    wheels: Sequence[Column]
    """rad/s: front right, front left, rear left, rear right."""
    late_p99: Column
    """ms, over the minute before, as the most of it."""
    late_max: Column


class Minute:
    """Rows of the last minute, by a monotonic clock."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, list[float | None]]] = deque(maxlen=ROWS)

    def due(self, at_ns: int) -> bool:
        """There is room for a row of then."""
        return not self._rows or at_ns - self._rows[-1][0] >= STEP_NS - EARLY_NS

    def add(self, at_ns: int, state: RobotState, wished: Twist | None) -> None:
        """The robot says so; `wished` is None where nobody heard what is."""
        measured: list[float | None] = [state.linear, state.angular, *state.wheels[: len(WHEELS)]]
        if len(measured) != MEASURED:
            measured = [None] * MEASURED
        twist = [wished.linear.x, wished.angular.z] if wished else [None, None]
        figure = state.figures.get("period_lateness")
        late = figure.last_minute if figure else None
        lateness = [late.p99 * MS, late.max * MS] if late else [None, None]
        row = [*measured, *twist, *lateness]
        self._rows.append((at_ns, [None if one is None else round(one, 3) for one in row]))

    def plotted(self, now_ns: int) -> Plotted:
        """What is left of it now."""
        rows = [row for row in self._rows if now_ns - row[0] <= LASTS_NS]
        columns = [[values[n] for _, values in rows] for n in range(WIDTH)]
        linear, angular, *wheels, wished_linear, wished_angular, late_p99, late_max = columns
        age = [(now_ns - at_ns) // 1_000_000 for at_ns, _ in rows]
        return Plotted(
            age, linear, angular, wished_linear, wished_angular, wheels, late_p99, late_max
        )
