"""Decides by the neutral-first rule whether one sender may drive the robot.

A sender may drive if it is armed. Only a zero, which is a command to rest, arms a sender. Silence
does not. The sender stays armed until `require_neutral`, `disarm` or `unlearn` is called.

- If no other program shares the sender's identity, a zero arms the sender immediately, even
  directly after speeds.
- Programs without a sender id and without a GID may share an identity. A zero arms a shared
  identity only if no speed of any shared identity of the source follows for
  `commands.neutral_pause`. Further zeros and silence do not restart this time. Without the pause,
  the zero of one program would arm another program that never stopped.
- While the daemon stands still, it receives no speeds. Therefore the time of a stall does not count
  towards the pause.
- One program without a sender id may have several shared identities in turn, because its identity
  depends on the Zenoh session that stamps its commands. Therefore a speed of one shared identity
  cancels the zeros of all shared identities.

A sender is present while it takes part in the choice of the arbiter. It is present while it is
live, which means that its last accepted command is not older than the timeout of its source. Two
events must not end its presence: a stall of the daemon, and doubtful stamps, for example because
the sender's clock was set. Otherwise a sender that holds the robot still would lose the robot to a
sender of speeds. After these events, the sender stays present for at most `PLACE_NS` after its last
accepted command.
"""

from __future__ import annotations

from acsard.core.motion.emergency_stop import EXCUSE_NS
from acsard.core.motion.freshness import LONGEST_PROOF_NS, Verdict
from acsard.core.values import REST, Command

PLACE_NS = 2 * LONGEST_PROOF_NS
"""Longest time after its last accepted command for which a sender takes part in the choice of the
arbiter, ns. It is also the longest time for which an unarmed sender keeps control of the robot
after its clock was set. A proof of the clock ends within this time, even if the proof has the
longest duration and restarts with its second half."""


class Sender:
    """One sender of a source: its last command, and whether it is armed."""

    def __init__(self, timeout_ns: int, pause_ns: int, neutral_first: bool) -> None:
        self.use(timeout_ns, pause_ns)
        self._neutral_first = neutral_first
        self._armed = self._proven_armed = not neutral_first
        self._zero_ns: int | None = None
        """Monotonic time of arrival of the zero after which `commands.neutral_pause` runs, ns.

        None if there is no such zero or `cancel_zero` has followed it. Only a shared identity needs
        this value.
        """
        self._proven_zero_ns: int | None = None
        self.name = ""
        self._stamp_ns: int | None = None
        """Stamp of the last accepted command, ns, or None."""
        self._number: int | None = None
        """Sequence number of the last accepted command, or None."""
        self._ended: Command | None = None
        """The last zero that ended a speed although the zero's stamp kept it from being accepted,
        or None. An older speed that arrives after this zero must not move the robot again."""
        self.clock = ""
        """Name of the clock that stamped the last command that was not refused."""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Monotonic time of arrival of the last accepted command, ns; None if none was accepted
        since `require_neutral`."""
        self._present_ns = 0
        """Monotonic time of arrival of the last command for which the sender counts as present, ns.
        A stall of the daemon moves this time to the end of the stall."""
        self.came_ns = 0
        """Monotonic time of arrival of the command that ended the sender's last silence, ns."""
        self.zeros_ns: int | None = None
        """Monotonic time since which the sender has sent only zeros, without falling silent, ns;
        None if its last command was a speed."""
        self.speeds_ns: int | None = None
        """Monotonic time since which the sender has sent only speeds, without falling silent, ns;
        None if its last command was a zero."""
        self.disarmed_ns: int | None = None
        """Monotonic time at which `disarm` last disarmed the sender, ns, or None."""
        self.ros = False
        """Whether the last command came from ROS. ROS tools do not send a zero by themselves."""
        self.shared = False
        """Whether several programs may share this identity."""
        self.noticed_ns = 0
        """Monotonic time of arrival of the last message, ns, even if that message was refused."""
        self._doubted_ns: int | None = None
        self.doubt: Verdict = "unproven"
        """The verdict on the last command whose stamp kept it from being accepted."""

    def use(self, timeout_ns: int, pause_ns: int) -> None:
        """Apply this command timeout and this `commands.neutral_pause`, both in ns, from now on."""
        self._timeout_ns, self._pause_ns = timeout_ns, pause_ns

    def live(self, now_ns: int) -> bool:
        """Return whether the last accepted command is not older than the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def present(self, now_ns: int) -> bool:
        """Return whether the sender takes part in the choice of the arbiter.

        It does while it is live. It also does in two other cases, for at most `PLACE_NS` after its
        last accepted command: while it goes on sending commands with doubtful stamps, without a
        silence longer than the timeout, and for one timeout after a stall of the daemon.
        """
        arrived_ns, timeout_ns = self.arrived_ns, self._timeout_ns
        return arrived_ns is not None and (
            now_ns - arrived_ns <= timeout_ns
            or (now_ns - self._present_ns <= timeout_ns and now_ns - arrived_ns <= PLACE_NS)
        )

    def rank(self, now_ns: int) -> tuple[bool, int]:
        """Return the sort key of the sender among senders whose sources have equal priorities.

        Live senders come before senders that are not live. Otherwise, the sender that began to send
        first comes first. Within one source, however, armed senders always come before unarmed
        ones.
        """
        return not self.live(now_ns), self.came_ns

    def doubtful(self, now_ns: int) -> bool:
        """Return whether the stamp of a recent command kept the command from being accepted."""
        return self._doubted_ns is not None and now_ns - self._doubted_ns <= self._timeout_ns

    def armed(self, now_ns: int) -> bool:
        """Return whether the sender has sent the zero that lets it drive."""
        if self._zero_ns is not None:
            self._settle(now_ns)
        return self._armed

    def require_neutral(self) -> None:
        """Forget the last command. The sender must send a zero again before it drives the robot.

        If the neutral-first rule is off, the sender stays armed and need not send a zero.
        """
        self.arrived_ns = self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def disarm(self, now_ns: int) -> None:
        """Disarm the sender because its clock was set. It must send a zero again before it drives.

        It still takes part in the choice of the arbiter. If the neutral-first rule is off, the
        sender stays armed.
        """
        if self.armed(now_ns):
            self.disarmed_ns = now_ns
        self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def holds(self, now_ns: int) -> bool:
        """Return whether the sender may keep control of the robot if it has control already.

        It may if it takes part in the choice (`present`) and one of these conditions holds: it is
        armed, `disarm` disarmed it at most `PLACE_NS` ago, or `commands.neutral_pause` runs after
        its zero.
        """
        just_set = self.disarmed_ns is not None and now_ns - self.disarmed_ns <= PLACE_NS
        waits = just_set or self._zero_ns is not None
        return self.present(now_ns) and (waits or self.armed(now_ns))

    def unlearn(self) -> None:
        """Undo the effect of zeros with unproven stamps. The network may have delayed them."""
        self._armed, self._zero_ns = self._proven_armed, self._proven_zero_ns

    def resume(self, before_ns: int, now_ns: int) -> None:
        """Continue after the daemon stood still from `before_ns` to `now_ns` (monotonic times).

        The bus may deliver the commands of that time only after this step. Therefore the sender
        stays present for one timeout more, at most until `PLACE_NS` after its last accepted
        command. A running `commands.neutral_pause` does not advance during the stall, and lasts for
        at least `EXCUSE_NS` after it.
        """
        if self.present(before_ns):
            self._present_ns = now_ns
        self._settle(before_ns)
        if not self._armed and self._zero_ns is not None:
            rest_ns = max(self._zero_ns + self._pause_ns - before_ns, EXCUSE_NS)
            proven = self._proven_zero_ns is not None
            self._zero_ns = now_ns + rest_ns - self._pause_ns
            self._proven_zero_ns = self._zero_ns if proven else None

    def cancel_zero(self, at_ns: int) -> None:
        """Record that a program with a shared identity may have sent a speed.

        `at_ns` is the monotonic time of the speed. If this sender's identity is shared, and
        `commands.neutral_pause` after its zero was not over at that time, the zero no longer arms
        the sender.
        """
        self._settle(at_ns)
        self._zero_ns = self._proven_zero_ns = None

    def refuse(self, command: Command, why: Verdict) -> None:
        """Record a command that was refused because of its stamp. `why` is the verdict on it."""
        self.noticed_ns = command.arrived_ns
        self._doubt(command, why)

    def take(
        self, command: Command, since_ns: int, verdict: Verdict = "fresh", watched_ns: int = 0
    ) -> None:
        """Process a command that was not refused. `verdict` is the verdict on its stamp.

        If the command is a speed of a shared identity, the caller must first call `cancel_zero` of
        each sender of the source.

        A command from an unproven clock ("first", "unproven") does not drive the robot yet, but a
        zero with such a verdict arms the sender until `unlearn`. A zero that arrived before the
        monotonic time `since_ns` does not arm the sender (see `Arbiter.require_neutral`).
        `watched_ns` is the monotonic time at which the daemon's last stall ended.
        `commands.neutral_pause` does not begin before that time.
        """
        now_ns, zero = command.arrived_ns, is_zero(command)
        self._settle(now_ns)
        self.noticed_ns, self.shared, self.clock = now_ns, command.shared, command.clock
        unarmed = not self._armed
        if zero and now_ns >= since_ns:
            if not command.shared:
                self._armed = True
            elif self._zero_ns is None:
                self._zero_ns = max(now_ns, watched_ns)
        if verdict in ("first", "unproven"):
            if zero and unarmed:
                # When this zero arms the sender, an earlier speed must not drive the robot.
                self.twist = REST
            self._doubt(command, verdict)
            return
        self._proven_armed, self._proven_zero_ns = self._armed, self._zero_ns
        present = self.present(now_ns)
        if not present:
            self.came_ns = now_ns
        self._tell_apart(zero, now_ns, present)
        self.ros, self.name = command.ros, command.sender
        self.twist, self._doubted_ns = command.twist, None
        self.arrived_ns = self._present_ns = now_ns
        self._stamp_ns, self._number = command.stamp_ns, command.sequence
        if self._ended is not None:
            if self._overtaken(command, self._ended):
                self.twist = REST
            else:
                self._ended = None

    def _tell_apart(self, zero: bool, now_ns: int, present: bool) -> None:
        """Record since when the sender has sent only zeros, or only speeds.

        `zero` is true if the command that arrives at `now_ns` is a zero. `present` is false if this
        command ends a silence of the sender.
        """
        since_ns = self.zeros_ns if zero else self.speeds_ns
        if since_ns is None or not present:
            since_ns = now_ns
        self.zeros_ns, self.speeds_ns = (since_ns, None) if zero else (None, since_ns)

    def _overtaken(self, command: Command, zero: Command) -> bool:
        """Return whether this command was sent before `zero` but arrived after it.

        The network delays an accepted command by at most about the timeout. If the stamp of `zero`
        is later by more than that, this stamp was wrong, and must not keep the robot at rest.
        """
        if command.stamp_ns is None or zero.stamp_ns is None or command.clock != zero.clock:
            return False
        return 0 < zero.stamp_ns - command.stamp_ns <= self._timeout_ns

    def _doubt(self, command: Command, why: Verdict) -> None:
        if is_zero(command) and (
            _later(command.stamp_ns, self._stamp_ns) or _later(command.sequence, self._number)
        ):
            # The sender does not want its last speed any more, however late this zero may be.
            self.twist, self._ended = REST, command
        present = self.present(command.arrived_ns)
        if present:
            self._present_ns = command.arrived_ns
        self._tell_apart(is_zero(command), command.arrived_ns, present)
        self._doubted_ns, self.doubt, self.ros = command.arrived_ns, why, command.ros

    def _settle(self, now_ns: int) -> None:
        """Arm a shared identity if `commands.neutral_pause` is over after its zero."""
        if self._zero_ns is not None and now_ns - self._zero_ns >= self._pause_ns:
            self._armed = True
            if self._proven_zero_ns == self._zero_ns:
                self._proven_armed = True


def _later(mark: int | None, last: int | None) -> bool:
    """Return whether a stamp or a sequence number is higher than `last`; False if one is None."""
    return mark is not None and last is not None and mark > last


def is_zero(command: Command) -> bool:
    """Return whether the command asks for rest.

    A motion that the robot cannot perform, such as a sideways speed, does not ask for rest, even
    though its `twist` is zero (see `Command.cancelled`).
    """
    return command.twist == REST and not command.cancelled
