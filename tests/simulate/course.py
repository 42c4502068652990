"""The promise that the robot drives with the commanded speeds.

At its limits it drives slower on the same curve. It reaches the speeds in the time that the
configured limits allow.
"""

from __future__ import annotations

from tests.simulate.promises import LATE_NS, ZERO, BrokenError, Witness
from tests.simulate.roads import NS

SETTLED_NS = NS // 2
"""Speeds that stay the same for this time have reached their goal."""


class Course:
    """Compares the wheel speeds on the wire with the command that the robot follows."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._same: tuple[object, ...] = ()
        """The command, the wheel speeds and the time at which the limits were last changed."""
        self._since_ns = self._lines = 0
        self._goal: tuple[object, ...] = ()
        """The command, and the times at which the limits and the mode were last changed."""
        self._from_ns = self._line_ns = 0
        """Time of the line from which the ramp to this command began, and of the last line."""
        self._from: tuple[float, ...] = ZERO
        """The wheel speeds of the first of these lines."""
        self._reached: tuple[float, ...] | None = None
        """The wheel speeds at the end of the ramp."""

    def step(
        self, true_ns: int, wish: tuple[float, float] | None, wheels: tuple[float, ...], lines: int
    ) -> None:
        """Judge the last line of a step.

        Args:
            true_ns: True time of the step.
            wish: The speeds of the command that the robot follows, or None if they are unknown.
            wheels: The wheel speeds of the line.
            lines: Number of complete lines in the step.
        """
        witness = self._witness
        if lines:
            self._ramp(true_ns, wish, wheels)
        same = wish, wheels, witness.changed_ns
        if wish is None or same != self._same:
            self._same, self._since_ns, self._lines = same, true_ns, 0
            return
        self._lines += lines
        if not lines or true_ns - self._since_ns < SETTLED_NS:
            return
        enough = self._lines * witness.period_ns > 0.8 * (true_ns - self._since_ns)
        self._since_ns, self._lines = true_ns, 0
        if not enough:
            return
        witness.counts["settled speeds"] += 1
        goal, twist = witness.clamped(*wish, witness.limits), witness.twist(wheels)
        room = witness.radius * 0.02
        rooms = room, room / witness.half
        if any(abs(a - b) > r for a, b, r in zip(twist, goal, rooms, strict=True)):
            raise BrokenError("the robot drives as told", true_ns, f"{twist} for {goal} of {wish}")
        (v, w), (goal_v, goal_w) = twist, goal
        error = 0.51 * (rooms[0] * abs(goal_w) + rooms[1] * abs(goal_v))
        if wheels != ZERO and abs(v * goal_w - w * goal_v) > error:
            raise BrokenError("the robot drives on the curve", true_ns, f"{twist} for {goal}")

    def _begin(self, goal: tuple[object, ...], true_ns: int, wheels: tuple[float, ...]) -> None:
        """Expect a new ramp from these wheel speeds to the goal."""
        self._goal, self._from_ns, self._from, self._reached = goal, true_ns, wheels, None

    def _ramp(
        self, true_ns: int, wish: tuple[float, float] | None, wheels: tuple[float, ...]
    ) -> None:
        """Check that the ramp to a command does not take too long."""
        witness = self._witness
        late_ns, self._line_ns = true_ns - self._line_ns, true_ns
        goal, limits = (wish, witness.changed_ns, witness.mode_ns), witness.limits
        # A speed changes by that much time at most from one line to the next.
        late = late_ns > max(NS // 20, 3 * witness.period_ns // 2)
        if wish is None or late or goal != self._goal:
            self._begin(goal, true_ns, wheels)
            return
        if wheels == self._reached:
            return
        if max(map(abs, wheels)) > limits["wheel_speed"] - 0.1:
            self._begin(goal, true_ns, wheels)
            return
        seconds, due = (true_ns - self._from_ns - LATE_NS - witness.period_ns) / NS, 0.0
        if seconds <= 0.0:
            return
        room, twist = witness.radius * 0.02, witness.twist(wheels)
        rooms, aims = (room, room / witness.half), witness.clamped(*wish, limits)
        if all(abs(a - b) <= r for a, b, r in zip(twist, aims, rooms, strict=True)):
            self._reached = wheels
            return
        begun = witness.twist(self._from)
        for name, old, new in zip(("linear", "angular"), begun, aims, strict=True):
            up, down = limits[f"{name}_acceleration"], limits[f"{name}_deceleration"]
            if old * new < 0.0:
                due = max(due, abs(old) / down + abs(new) / up)
            else:
                due = max(due, abs(new - old) / (up if abs(new) > abs(old) else down))
        if "linear_jerk" in limits or seconds <= due:
            return
        raise BrokenError(
            "a ramp ends in time", true_ns,
            f"{twist} for {aims} of {wish}, on a ramp from {begun} at {self._from_ns / NS:.3f} s",
        )  # fmt: skip
