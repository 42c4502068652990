"""The neutral-first rule for one sender: whether it may drive, decided by the commands that it has
sent.

Only a zero, which is a command to rest, arms a sender. Silence alone never does. An armed sender
stays armed until `require_neutral` is called.

- If no other program shares the sender's identity, a zero arms the sender at once, even directly
  after speeds.
- Several programs may share an identity (a bridge, a plain key). Then a zero arms the identity only
  if no speed follows for `commands.neutral_pause`. Further zeros and silence do not restart this
  time. Without the pause, the zero of one program would arm another program that never stopped.

This module holds one sender's last command, and whether the sender is armed. `arbiter.py` decides
which sender is followed and when a sender must be armed again. `freshness.py` decides whether a
command counts.
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
        """Monotonic arrival, ns, of a zero of a shared identity after which no speed has arrived
        yet; None without one."""
        self._proven_zero_ns: int | None = None
        self.name = ""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Arrival of the last command that counted since `require_neutral`, ns; None without
        one."""
        self.came_ns = 0
        """Arrival of the command that ended the sender's last silence, ns. The arbiter prefers the
        sender that came first."""
        self.zeros_ns: int | None = None
        """Arrival of the first zero since the last speed, ns; None if a speed came last."""
        self.ros = False
        """Whether the last command came from ROS, whose tools send no zero by themselves."""
        self.shared = False
        """Whether several programs may share this identity."""
        self.noticed_ns = 0
        """Arrival of the last message, ns, even if that message did not count."""
        self._doubted_ns: int | None = None
        self.doubt: Verdict = "unproven"
        """The verdict on the stamp of the last command that did not count."""

    def use(self, timeout_ns: int, pause_ns: int) -> None:
        """Apply this command timeout and this `commands.neutral_pause`, both in ns, from now on."""
        self._timeout_ns, self._pause_ns = timeout_ns, pause_ns

    def live(self, now_ns: int) -> bool:
        """Return whether the last command is not older than the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def doubtful(self, now_ns: int) -> bool:
        """Return whether recent commands do not count because of their stamps."""
        return self._doubted_ns is not None and now_ns - self._doubted_ns <= self._timeout_ns

    def armed(self, now_ns: int) -> bool:
        """Return whether the sender may drive."""
        self._settle(now_ns)
        return self._armed

    def require_neutral(self) -> None:
        """Forget the last command, and require a zero again if the neutral-first rule is on."""
        self.arrived_ns = self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def unlearn(self) -> None:
        """Undo the arming by zeros whose stamps were never proven.

        Such zeros may come from a backlog.
        """
        self._armed, self._zero_ns = self._proven_armed, self._proven_zero_ns

    def notice(self, at_ns: int) -> None:
        """Record a message that does not count, but that may have been a speed.

        `at_ns` is its monotonic time of arrival, ns.
        """
        self._settle(at_ns)
        self._zero_ns = self._proven_zero_ns = None
        self.noticed_ns = at_ns

    def missed(self) -> None:
        """Record that unread messages of this sender were lost. Each may have been a speed."""
        self._zero_ns = self._proven_zero_ns = None

    def refuse(self, command: Command, why: Verdict) -> None:
        """Record a command that does not count, with the verdict `why` on its stamp."""
        self.notice(command.arrived_ns)
        self._doubt(command, why)

    def take(self, command: Command, since_ns: int, verdict: Verdict = "fresh") -> None:
        """Accept a command that counts, or that will count once the clock of its stamps is proven.

        A zero that arrived before `since_ns`, the time of the last `require_neutral`, does not arm
        the sender. A zero of an unproven clock arms the sender as soon as that clock is proven,
        unless `unlearn` is called before that.
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
                # When this zero arms the sender, an earlier speed must not count. With a shared
                # identity, another program may have sent it, and the source keeps its priority.
                if command.shared:
                    self.twist = REST
                else:
                    self.arrived_ns = None
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
        """Arm a shared identity if no speed has followed its zero for `commands.neutral_pause`."""
        if self._zero_ns is not None and now_ns - self._zero_ns >= self._pause_ns:
            self._armed = True
            if self._proven_zero_ns == self._zero_ns:
                self._proven_armed = True


def is_zero(command: Command) -> bool:
    """Return whether the command asks for rest. Wheel speeds that cancel out are not rest."""
    return command.twist == REST and not command.cancelled
