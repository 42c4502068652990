"""The promise that the robot drives as told: on the curve of the command, also at its limits."""

from __future__ import annotations

from tests.simulate.promises import ZERO, BrokenError, Witness
from tests.simulate.roads import NS

SETTLED_NS = NS // 2
"""Speeds that stay the same for this time have reached their goal."""


class Course:
    """The speeds of the lines since they last changed, and the command that they follow."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._same: tuple[object, ...] = ()
        """The command, the wheel speeds and the time at which the limits were last changed."""
        self._since_ns = self._lines = 0

    def step(
        self, true_ns: int, wish: tuple[float, float] | None, wheels: tuple[float, ...], lines: int
    ) -> None:
        """Judge the last line of a step, which had this many, by the command that it follows."""
        witness = self._witness
        same = wish, wheels, witness.changed_ns
        if wish is None or same != self._same:
            self._same, self._since_ns, self._lines = same, true_ns, 0
            return
        self._lines += lines
        if not lines or true_ns - self._since_ns < SETTLED_NS:
            return
        enough = self._lines * witness.period_ns > 0.8 * (true_ns - self._since_ns)
        self._since_ns, self._lines = true_ns, 0
        if not enough or witness.unsure:
            return
        witness.counts["settled speeds"] += 1
        goal, got = witness.clamped(*wish, witness.limits), witness.twist(wheels)
        room = witness.radius * 0.02
        rooms = room, room / witness.half
        if any(abs(a - b) > r for a, b, r in zip(got, goal, rooms, strict=True)):
            raise BrokenError("the robot drives as told", true_ns, f"{got} for {goal} of {wish}")
        (v, w), (goal_v, goal_w) = got, goal
        error = 0.51 * (rooms[0] * abs(goal_w) + rooms[1] * abs(goal_v))
        if wheels != ZERO and abs(v * goal_w - w * goal_v) > error:
            raise BrokenError("the robot drives on the curve", true_ns, f"{got} for {goal}")
