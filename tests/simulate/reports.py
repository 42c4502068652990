"""Compares the robot's reports about itself with the true events.

The lines on the wire do not show which of several commands the robot follows. They also do not show
the speed in `state` while the board is silent.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from typing import Any

from tests.simulate.ages import MARGIN_NS
from tests.simulate.promises import BrokenError
from tests.simulate.roads import NS, Message, Sample, stable

KEPT = 15_000
"""Commands that are remembered: those of the longest timeout, 10 s, at 400 Hz by three senders."""

REFUSED_AS = {
    "garbage": "malformed", "not a number": "not_finite", "delete": "not_a_put",
    "wildcard": "wildcard", "huge": "too_big", "stranger": "unknown_source",
    "fields": "wrong_shape",
}  # fmt: skip
"""The reason by which each kind of junk is counted."""

ECHO_LINES, ECHO_NS = 40, 3 * NS // 2
"""Lines and time after a change of speed, after which an echo must be known: two windows of half a
second, the question and its return."""

ECHO_WAY = 0.5
"""Way, m, by which the pose may be wrong until an echo beside a board is known."""


class Reports:
    """The commands that arrived at one daemon, by arrival time, and the newest followed ones."""

    def __init__(self) -> None:
        self._arrived: dict[int, tuple[str, int] | None] = {}
        """Clock and number of the command that arrived at this monotonic time of the robot. None
        if several did, or if the order of its clock says nothing."""
        self._order: deque[int] = deque()
        self._followed: dict[str, int] = {}
        """The highest number that the robot has followed, by clock."""
        self._junk: Counter[str] = Counter()
        """Junk that arrived, by the reason for which it is refused."""

    def command(
        self, sender: dict[str, Any], message: Message, sample: Sample, arrived_ns: int, loose: bool
    ) -> None:
        """Record a command. `loose` is true if other senders use the same clock."""
        if message.junk in REFUSED_AS:
            # A twist on a key of wheel speeds is wrong in two ways.
            twice_wrong = message.junk in ("fields", "garbage") and "wheel_cmd/" in sample.key
            self._junk["unreadable" if twice_wrong else REFUSED_AS[message.junk]] += 1
        known = None
        if sample.clock and stable(sender) and not (loose or sender["churn"]):
            known = sample.clock, message.number
        if arrived_ns in self._arrived:
            known = None
        else:
            self._order.append(arrived_ns)
        self._arrived[arrived_ns] = known
        while len(self._order) > KEPT:
            del self._arrived[self._order.popleft()]

    def follows(self, at_ns: int, followed_ns: int) -> str:
        """Check that the robot does not follow an older command after a newer one.

        Returns the command's clock, or "" if its messages have no certain order.
        """
        known = self._arrived.get(followed_ns)
        if known is None:
            return ""
        clock, number = known
        newest = self._followed.get(clock, number)
        if number < newest:
            raise BrokenError(
                "no older command after a newer one", at_ns,
                f"number {number} of {clock} is followed after number {newest}",
            )  # fmt: skip
        self._followed[clock] = number
        return clock

    def judge_junk(self, at_ns: int, state: dict[str, Any], dropped: int) -> None:
        """Compare the counters of refused messages with the messages that arrived.

        The daemon never read `dropped` of them.
        """
        for reason in REFUSED_AS.values():
            expected, counted = self._junk[reason], state["counters"].get(f"command_{reason}", 0)
            most = expected
            if reason in ("malformed", "wrong_shape"):
                most += self._junk["unreadable"]
            if not expected - dropped <= counted <= most:
                text = f"{expected} arrived, {counted} are counted as {reason}"
                raise BrokenError("every bad command is counted by its reason", at_ns, text)


def judge_state(at_ns: int, state: dict[str, Any], fed_ns: int, quiet_ns: int) -> None:
    """Check that `state` has no speeds if the board has been silent since `fed_ns` for too long."""
    speeds = state["linear"], state["angular"], state["wheels"]
    if at_ns - fed_ns > quiet_ns + 2 * MARGIN_NS and speeds != (None, None, []):
        raise BrokenError(
            "state has no speed of a silent board", at_ns,
            f"last heard {fed_ns / NS:.3f} s, and state says {speeds}",
        )  # fmt: skip


def judge_pose(
    at_ns: int, state: dict[str, Any], pose: tuple[float, float, float], fed_ns: int, quiet_ns: int
) -> None:
    """Check that the pose in `state` does not change while the board is silent."""
    position = state["x"], state["y"], state["yaw"]
    moved = max(abs(a - b) for a, b in zip(position, pose, strict=True))
    if at_ns - fed_ns > quiet_ns + 2 * MARGIN_NS and moved > 1e-6:
        text = f"last heard {fed_ns / NS:.3f} s; the pose was {pose}, and state says {position}"
        raise BrokenError("the pose of a silent board stays", at_ns, text)


def judge_counts(at_ns: int, state: dict[str, Any], expected: int) -> None:
    """Check that the sum of the counters equals `expected`, the number of commands that arrived.

    `command_displaced` is left out, because it counts steps and not commands.
    """
    counters = {n: v for n, v in state["counters"].items() if n != "command_displaced"}
    counted = counters.get("commands", 0) + counters.get("commands_of_new_senders", 0)
    counted += sum(n for name, n in counters.items() if name.startswith("command_"))
    if counted != expected:
        text = f"{expected} arrived, {counted} are counted: {counters}"
        raise BrokenError("every command is counted", at_ns, text)


class _Changes:
    """The first change of speed in the lines that the daemon receives back as echoes."""

    def __init__(self) -> None:
        self.on = False
        self._last: tuple[float, ...]
        self._changed_ns: int | None
        self.restart()

    def begin(self) -> None:
        """Note that from now on the daemon receives its own lines."""
        self.on = True
        self.restart()

    def restart(self) -> None:
        """Restart, because the daemon started or opened its port again."""
        self._lines, self._changed_ns = 0, None
        self._last = ()

    def take(self, at_ns: int, wheels: tuple[float, ...]) -> bool:
        """Add a line. Return whether the daemon must have recognised the echo by now."""
        if not self.on:
            return False
        if self._last and wheels != self._last and self._changed_ns is None:
            self._changed_ns = at_ns
        self._last = wheels
        self._lines += self._changed_ns is not None
        return self._lines > ECHO_LINES and at_ns - (self._changed_ns or 0) > ECHO_NS

    @property
    def text(self) -> str:
        return f"{self._lines} lines after a change of speed were an echo"


class Echo(_Changes):
    """The lines while TX is joined to RX and no board answers."""

    def line(self, at_ns: int, wheels: tuple[float, ...]) -> None:
        """Check that the daemon stops driving soon after a change of speed has shown the echo."""
        if self.take(at_ns, wheels) and any(wheels):
            raise BrokenError("an echo is no board", at_ns, self.text)


class HalfDuplex(_Changes):
    """The lines and the pose while the daemon receives its own lines beside those of the board.

    The pose then includes a part of the commanded motion, even if the robot drives at other speeds.
    The daemon must notice that.
    """

    def restart(self) -> None:
        """Restart, because the daemon started or opened its port again."""
        super().restart()
        self._known = False
        self._way = 0.0
        self._before: tuple[float, ...] | None = None

    def line(self, at_ns: int, wheels: tuple[float, ...]) -> None:
        """Add a line that went to the board."""
        self._known |= self.take(at_ns, wheels)

    def see(self, at_ns: int, mode: str, pose: tuple[float, ...], true: tuple[float, ...]) -> None:
        """Judge a step: compare the pose's distance with the true one since the echo began.

        Both tuples begin with x and y in m.
        """
        before, self._before = self._before, (*pose[:2], *true[:2])
        if before is None:
            return
        moved = math.hypot(pose[0] - before[0], pose[1] - before[1])
        self._way += moved - math.hypot(true[0] - before[2], true[1] - before[3])
        if self._known and mode == "driving" and abs(self._way) > ECHO_WAY:
            text = f"{self.text}, and the pose has driven {self._way:.2f} m too far"
            raise BrokenError("an echo beside a board is seen", at_ns, text)
