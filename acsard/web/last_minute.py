"""Stores the plotted values of the last minute, for a page that has just been opened.

The commanded speeds arrive on the key `cmd_vel_out`, usually a hundred times a second. So the
server receives them only while a viewer is subscribed to that key. All other values come from the
key `state`. This module is pure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from msgspec import Struct

from acsard.core.messages.schema import RobotState, Twist
from acsard.core.values import NS_PER_S, WHEELS, Ns

MINUTE_NS = 60 * NS_PER_S

# About one pixel of a plot on a phone.
STEP_NS = NS_PER_S // 5

# A state may become the next row this early.
MAX_EARLY_NS = STEP_NS // 4

MAX_ROWS = MINUTE_NS // (STEP_NS - MAX_EARLY_NS)

MEASURED_COUNT = 2 + len(WHEELS)

# Measured speeds, commanded twist (2), lateness (2) and voltage (1).
ROW_LENGTH = MEASURED_COUNT + 5

# A plotted line, oldest first; None where the value is unknown.
Column = Sequence[float | None]


class Plotted(Struct, frozen=True):
    """The values to plot: a column for each plotted line, and a row for each moment.

    There are about five rows a second. All columns have the same length as `age`.
    """

    age: Sequence[int]  # ms
    linear: Column  # m/s; None without feedback from the board
    angular: Column  # rad/s, positive to the left
    wished_linear: Column  # after the limits; known only while a viewer follows `cmd_vel_out`
    wished_angular: Column
    wheels: Sequence[Column]  # rad/s: front right, front left, rear left, rear right
    late_p99: Column  # ms, of the minute before the row
    late_max: Column
    volts: Column  # None if the board does not report it


class Minute:
    """The plotted values of the last minute, in the time of one monotonic clock."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, list[float | None]]] = deque(maxlen=MAX_ROWS)

    def due(self, at_ns: Ns) -> bool:
        return not self._rows or at_ns - self._rows[-1][0] >= STEP_NS - MAX_EARLY_NS

    def add(self, at_ns: Ns, state: RobotState, wished: Twist | None) -> None:
        """Append a row for a state of the time `at_ns`; `wished` is the twist after the limits."""
        measured: list[float | None] = [state.linear, state.angular, *state.wheels[: len(WHEELS)]]
        if len(measured) != MEASURED_COUNT:
            measured = [None] * MEASURED_COUNT
        twist = [wished.linear.x, wished.angular.z] if wished else [None, None]
        figure = state.latencies.get("period_lateness")
        late = figure.last_minute if figure else None
        lateness = [late.p99 * 1e-3, late.max * 1e-3] if late else [None, None]
        volts = state.battery.volts if state.battery else None
        row = [*measured, *twist, *lateness, volts]
        self._rows.append((at_ns, [None if value is None else round(value, 3) for value in row]))

    def plotted(self, now_ns: Ns) -> Plotted:
        """Return the last minute before `now_ns` as columns."""
        rows = [row for row in self._rows if now_ns - row[0] <= MINUTE_NS]
        columns = [[values[n] for _, values in rows] for n in range(ROW_LENGTH)]
        linear, angular, *wheels, wished_linear, wished_angular, late_p99, late_max, volts = columns
        age = [(now_ns - at_ns) // 1_000_000 for at_ns, _ in rows]
        return Plotted(
            age, linear, angular, wished_linear, wished_angular, wheels, late_p99, late_max, volts
        )
