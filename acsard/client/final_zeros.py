"""Decides how long a sender repeats the zero that ends its drive.

A few zeros are not enough. If the network or the daemon stands still for a moment, all commands of
this time arrive within 1 ms. The daemon accepts the oldest one, which may be a speed, and drops the
others, because they come too fast. So a sender repeats the zero until the robot's `state` shows
that the robot has received it. The sender must then be silent, because repeated zeros keep other
senders from driving.

This module is pure: times and states come in as arguments.
"""

from __future__ import annotations

import math

from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, NEVER_DRIVING_MODES
from acsard.client.follower import SETTLED_S
from acsard.core.messages.schema import RobotState

STANDSTILL = 0.01, 0.02
"""Linear speed, m/s, and turn rate, rad/s, below which the robot counts as standing still."""

MAX_END_S = 2.0
"""Longest time for which a program that ends repeats its zero, s. The robot usually shows within
0.6 s that it has stopped. The rest of the time lets a hiccup of the network or a stall of the
daemon end."""


class FinalZeros:
    """Says whether a sender must repeat its zero. All times are on one monotonic clock, s.

    Args:
        source: the command source of the sender's commands.
        sender: the public name of the sender.
    """

    def __init__(self, source: str, sender: str) -> None:
        self._source, self._sender = source, sender
        self._drove, self._stopped_since = -math.inf, math.inf
        """`_drove` is the time of the last nonzero command, s. `_stopped_since` is the time since
        which all states have shown that this sender no longer drives the robot, s. It is infinite
        if the newest state does not show that."""

    def drove(self, now: float) -> None:
        """Record that the sender sends a nonzero command at the time `now`, s."""
        self._drove, self._stopped_since = now, math.inf

    def received(self, state: RobotState, now: float) -> None:
        """Process a state that arrived at the time `now`, s."""
        if not self._has_stopped(state):
            self._stopped_since = math.inf
        elif self._stopped_since == math.inf:
            self._stopped_since = now
        elif now - self._stopped_since >= SETTLED_S:
            # The first of these states may be older than the last speed. This state is not.
            self._drove = -math.inf

    def wanted(self, now: float) -> bool:
        """Return whether a sender that does not drive must send a zero at the time `now`, s.

        The result is False after the longest timeout of a source, because the robot then follows
        no speed of this sender.
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
