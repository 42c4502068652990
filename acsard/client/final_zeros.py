"""Decides how long a sender repeats the zero that ends its drive.

A few are not enough: after a stall of the network or the daemon, all commands arrive within 1 ms,
and the daemon accepts the oldest, maybe a speed, and drops the others as too fast. So the zero is
repeated until the `state` shows that it has arrived. Then the sender must be silent, because zeros
keep others from driving. This module is pure.
"""

from __future__ import annotations

import math

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, NEVER_DRIVING_MODES
from acsard.client.follower import SETTLED_S
from acsard.core.messages.schema import RobotState
from acsard.core.values import Seconds

STANDSTILL = 0.01, 0.02  # m/s and rad/s

# Longest repetition by a program that ends. The robot usually shows within 0.6 s that it has
# stopped; the rest is for a hiccup of the network or a stall of the daemon.
MAX_END_S = 2.0


class FinalZeros:
    """Says whether a sender must repeat its zero. All times are on one monotonic clock, s."""

    def __init__(self, source: str, sender: str) -> None:
        self._source, self._sender = source, sender
        # Last speed; since when all states show that this sender no longer drives, or inf.
        self._drove, self._stopped_since = -math.inf, math.inf

    def drove(self, now: Seconds) -> None:
        """Record that the sender sends a speed."""
        self._drove, self._stopped_since = now, math.inf

    def received(self, state: RobotState, now: Seconds) -> None:
        """Process a state."""
        if not self._has_stopped(state):
            self._stopped_since = math.inf
        elif self._stopped_since == math.inf:
            self._stopped_since = now
        elif now - self._stopped_since >= SETTLED_S:
            # The first of these states may be older than the last speed. This state is not.
            self._drove = -math.inf

    def wanted(self, now: Seconds) -> bool:
        """Return whether a sender that does not drive must send a zero.

        The result is False after the longest timeout of a source, when the robot follows no speed
        of it.
        """
        return now - self._drove < MAX_SOURCE_TIMEOUT_S

    def _has_stopped(self, state: RobotState) -> bool:
        if state.mode in NEVER_DRIVING_MODES:
            return True
        # While the network holds the commands, the robot may rest because the last speed has not
        # arrived yet. So the daemon must also have accepted a command just now.
        ages = [entry.age for entry in state.sources if entry.name == self._source]
        if not any(age is not None and age <= SETTLED_S for age in ages):
            return False
        if state.source != self._source or state.sender not in ("", self._sender):
            return True
        # A robot without a measured speed counts as standing still.
        return (
            abs(state.linear or 0.0) < STANDSTILL[0] and abs(state.angular or 0.0) < STANDSTILL[1]
        )
