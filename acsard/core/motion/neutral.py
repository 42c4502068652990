"""The neutral-first rule for one sender: whether it may drive, by what it has sent.

A sender is armed by a zero, never by a pause, and it stays armed until arming is asked for again:

- A zero of a sender with an identity of its own arms it at once, also right behind its speeds.
- Several programs may share an identity (a bridge, a plain key). Then a zero arms it when no speed
  has followed for `commands.neutral_pause`. Further zeros and silence change nothing. Otherwise the
  zero of one program would release another one that never stopped.

This module holds one sender's last command and its arming. `arbiter.py` decides which sender is
followed and asks for arming again. `freshness.py` decides whether a command counts.
"""

from __future__ import annotations

from acsard.core.motion.freshness import Verdict
from acsard.core.values import REST, Command


class Sender:
    """One sender of a source. Two programs are two senders if their identities differ."""

    def __init__(self, timeout_ns: int, pause_ns: int, neutral_first: bool) -> None:
        self.use(timeout_ns, pause_ns)
        self._neutral_first = neutral_first
        self._armed = self._proven_armed = not neutral_first
        self._zero_ns: int | None = None
        """Arrival of the zero of a shared identity that no speed has followed yet."""
        self._proven_zero_ns: int | None = None
        self.name = ""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Arrival of the last command that counted since arming was last asked for."""
        self.came_ns = 0
        """Arrival of the first command after the sender was last silent: the first sender wins."""
        self.zeros_ns: int | None = None
        """Arrival of the first zero since the last speed, or None if the last was a speed."""
        self.ros = False
        """The last command came from ROS."""
        self.shared = False
        """Several programs may share this identity."""
        self.noticed_ns = 0
        """Arrival of the last message, whether it counted or not."""
        self._doubted_ns: int | None = None
        self.doubt: Verdict = "unproven"
        """Why the last command that did not count was refused by its stamp."""

    def use(self, timeout_ns: int, pause_ns: int) -> None:
        """Apply this command timeout and this `commands.neutral_pause` from now on."""
        self._timeout_ns, self._pause_ns = timeout_ns, pause_ns

    def live(self, now_ns: int) -> bool:
        """Return whether the last command is no older than the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def doubtful(self, now_ns: int) -> bool:
        """Return whether its stamps are the reason that its commands do not count now."""
        return self._doubted_ns is not None and now_ns - self._doubted_ns <= self._timeout_ns

    def armed(self, now_ns: int) -> bool:
        """Return whether the sender may drive."""
        self._settle(now_ns)
        return self._armed

    def require_neutral(self) -> None:
        """Forget the last command and ask for a zero again."""
        self.arrived_ns = self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def unlearn(self) -> None:
        """Forget the zeros whose stamps were never proven: they may come from a backlog."""
        self._armed, self._zero_ns = self._proven_armed, self._proven_zero_ns

    def notice(self, at_ns: int) -> None:
        """Take note of a message that does not count: it may have been a speed."""
        self._settle(at_ns)
        self._zero_ns = self._proven_zero_ns = None
        self.noticed_ns = at_ns

    def missed(self) -> None:
        """Take note of messages that were lost unread: each may have been a speed."""
        self._zero_ns = self._proven_zero_ns = None

    def refuse(self, command: Command, why: Verdict) -> None:
        """Take note of a command that is stale."""
        self.notice(command.arrived_ns)
        self._doubt(command, why)

    def take(self, command: Command, since_ns: int, verdict: Verdict = "fresh") -> None:
        """Take a command that counts, or that will count once its clock is proven.

        A zero that arrived before `since_ns`, when arming was last asked for, does not arm.
        A zero of an unproven clock arms once that clock is proven, unless `unlearn` comes first.
        """
        now_ns, zero = command.arrived_ns, is_zero(command)
        self._settle(now_ns)
        self.noticed_ns, self.shared = now_ns, command.shared
        unarmed = not self._armed
        if not zero:
            self._zero_ns = self._proven_zero_ns = None
        elif now_ns >= since_ns and not command.shared:
            self._armed = True
        elif now_ns >= since_ns and self._zero_ns is None:
            self._zero_ns = now_ns
        if verdict in ("first", "unproven"):
            if zero and unarmed:
                self.arrived_ns = None  # a speed before the zero that arms must not count by it
            self._doubt(command, verdict)
            return
        self._proven_armed, self._proven_zero_ns = self._armed, self._zero_ns
        live = self.live(now_ns)
        if not live:
            self.came_ns = now_ns
        if not zero:
            self.zeros_ns = None
        elif self.zeros_ns is None or not live:
            self.zeros_ns = now_ns
        self.ros, self.name = command.ros, command.sender
        self.twist, self.arrived_ns, self._doubted_ns = command.twist, now_ns, None

    def _doubt(self, command: Command, why: Verdict) -> None:
        self._doubted_ns, self.doubt, self.ros = command.arrived_ns, why, command.ros

    def _settle(self, now_ns: int) -> None:
        """Arm a shared identity if no speed has followed its zero for the pause."""
        if self._zero_ns is not None and now_ns - self._zero_ns >= self._pause_ns:
            self._armed = True
            if self._proven_zero_ns == self._zero_ns:
                self._proven_armed = True


def is_zero(command: Command) -> bool:
    """Return whether the command asks for rest. Wheel speeds that cancel out are not rest."""
    return command.twist == REST and not command.cancelled
