"""Applies the neutral-first rule to one sender: only an armed sender may drive the robot.

Only a zero, which is a command to rest, arms a sender. Silence does not. The sender stays armed
until `require_neutral`, `disarm` or `unlearn` is called. A zero usually arms its sender
immediately. If several programs may share the sender's identity, the zero arms this identity only
after `commands.neutral_pause`. In this time, a speed from any shared identity of the same source
cancels the zero.

A sender is live while its last accepted command is not older than the timeout of its source. A
sender is present while the arbiter may choose it. Every live sender is present. After a stall of
the daemon, or while the stamps of a sender are doubtful, the sender stays present for at most
`CANDIDATE_NS` after its last accepted command. Without this extra time, a sender that keeps the
robot at rest with zeros would lose control to another sender that sends speeds.
"""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.motion.emergency_stop import CATCH_UP_NS
from acsard.core.motion.freshness import MAX_JITTER_NS, MAX_PROOF_NS, Verdict
from acsard.core.values import REST, Command

# Programs without a sender id and without a GID may share an identity. These rules apply to them:
#
# - The zero of one program must not arm another program that never stopped. Therefore a zero arms a
#   shared identity only after `commands.neutral_pause` without a speed. Further zeros and silence
#   do not restart this time.
# - While the daemon stands still, it receives no speeds. Therefore the time of a stall does not
#   count towards the pause.
# - One program without a sender id may have several shared identities in turn, because its identity
#   depends on the Zenoh session that stamps its commands. Therefore a speed of one shared identity
#   cancels the zeros of all shared identities of the source.

CANDIDATE_NS = 2 * MAX_PROOF_NS
"""Longest time for which a sender that is not live still takes part in the choice of the arbiter,
ns. The time starts with the sender's last accepted command. An unarmed sender keeps control of the
robot for at most this time after its clock was set. A proof of the clock (see `freshness.py`) ends
within this time, even if the proof has the longest duration and restarts with its second half."""


class Sender:
    """One sender of a command source: its last command, and whether it is armed."""

    def __init__(self, timeout_ns: int, pause_ns: int, neutral_first: bool) -> None:
        self.use(timeout_ns, pause_ns)
        self._neutral_first = neutral_first
        self._armed = self._proven_armed = not neutral_first
        self._zero_ns: int | None = None
        """Monotonic time of arrival of the zero command that will arm the sender, ns; None without
        such a zero. Only a sender whose identity several programs may share uses it: this sender is
        armed when `commands.neutral_pause` has passed since the zero."""
        self._proven_zero_ns: int | None = None
        self.name = ""
        self._stamp_ns: int | None = None
        """Stamp of the last accepted command, ns, or None."""
        self._number: int | None = None
        """Sequence number of the last accepted command, or None."""
        self._ended: Command | None = None
        """The last zero; None if a command that was sent after it has arrived. A speed that was
        sent before this zero but arrives after it must not move the robot again. If the zero was
        accepted, its stamp is left out."""
        self.clock = ""
        """Name of the clock that stamped the last command passed to `take`."""
        self.twist = REST
        self.arrived_ns: int | None = None
        """Monotonic time of arrival of the last accepted command, ns; None if no command was
        accepted since `require_neutral`."""
        self._present_ns = 0
        """Monotonic time of arrival, ns, of the last command that keeps the sender in the choice of
        the arbiter (`present`), even if this command was not accepted. A stall of the daemon moves
        this time to the end of the stall."""
        self.came_ns = 0
        """Monotonic time of arrival of the first accepted command after the sender's last silence,
        ns."""
        self.zeros_ns: int | None = None
        """Monotonic time since which the sender has sent only zeros, without falling silent, ns;
        None if its last command was a speed."""
        self.speeds_ns: int | None = None
        """Monotonic time since which the sender has sent only speeds, without falling silent, ns;
        None if its last command was a zero."""
        self.disarmed_ns: int | None = None
        """Monotonic time at which `disarm` last disarmed the sender, ns; None if it never did."""
        self.ros = False
        """Whether the last command came from ROS. ROS tools do not send a zero by themselves."""
        self.shared = False
        """Whether several programs may share the identity of this sender."""
        self.noticed_ns = 0
        """Monotonic time of arrival of the last message of this sender, ns, even if it was
        refused."""
        self._doubted_ns: int | None = None
        self.doubt: Verdict = "unproven"
        """The verdict on the last command that was not accepted because of its stamp."""

    def use(self, timeout_ns: int, pause_ns: int) -> None:
        """Use this timeout and this `commands.neutral_pause` from now on, both in ns."""
        self._timeout_ns, self._pause_ns = timeout_ns, pause_ns

    def is_live(self, now_ns: int) -> bool:
        """Return whether the last accepted command is not older than the timeout of its source.

        `now_ns` is the monotonic time, ns.
        """
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def present(self, now_ns: int) -> bool:
        """Return whether the sender takes part in the choice of the arbiter at the time `now_ns`.

        `now_ns` is a monotonic time, ns. A live sender takes part. For at most `CANDIDATE_NS` after
        its last accepted command, a sender also takes part in two other cases:

        - The sender goes on sending commands with doubtful stamps, without a silence longer than
          the timeout.
        - A stall of the daemon has ended at most one timeout ago.
        """
        arrived_ns, timeout_ns = self.arrived_ns, self._timeout_ns
        return arrived_ns is not None and (
            now_ns - arrived_ns <= timeout_ns
            or (now_ns - self._present_ns <= timeout_ns and now_ns - arrived_ns <= CANDIDATE_NS)
        )

    def rank(self, now_ns: int) -> tuple[bool, int]:
        """Return the sort key by which the arbiter orders present senders. The lowest key wins.

        Live senders come before senders that are not live. Otherwise, the sender that began to send
        first comes first. The key does not say whether a sender is armed: `_Source.present` puts
        the armed senders of a source before the unarmed ones.
        """
        return not self.is_live(now_ns), self.came_ns

    def doubtful(self, now_ns: int) -> bool:
        """Return whether a recent command was not accepted because of its stamp.

        A command is recent if it is not older than the timeout of the sender's source.
        """
        return self._doubted_ns is not None and now_ns - self._doubted_ns <= self._timeout_ns

    def armed(self, now_ns: int) -> bool:
        """Return whether the sender is armed: it has sent the zero that lets it drive.

        If the neutral-first rule is off, a sender is always armed.
        """
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
        """Return whether the sender may keep control of the robot if it already has control.

        It may if it is present (`present`), and if one of these conditions is true:

        - The sender is armed.
        - `disarm` has disarmed the sender at most `CANDIDATE_NS` ago.
        - The sender has sent a zero command, and its `commands.neutral_pause` is not over yet.
        """
        just_set = self.disarmed_ns is not None and now_ns - self.disarmed_ns <= CANDIDATE_NS
        waits = just_set or self._zero_ns is not None
        return self.present(now_ns) and (waits or self.armed(now_ns))

    def unlearn(self) -> None:
        """Undo the arming by zeros with unproven stamps.

        The network may have delayed these zeros.
        """
        self._armed, self._zero_ns = self._proven_armed, self._proven_zero_ns

    def resume(self, before_ns: int, now_ns: int) -> None:
        """Continue after the daemon stood still from `before_ns` to `now_ns` (monotonic times, ns).

        The bus may deliver the commands of that time only after this step. Therefore the sender
        stays present for one timeout more, but at most until `CANDIDATE_NS` after its last accepted
        command. A running `commands.neutral_pause` does not advance during the stall, and lasts for
        at least `CATCH_UP_NS` after it.
        """
        if self.present(before_ns):
            self._present_ns = now_ns
        self._settle(before_ns)
        if not self._armed and self._zero_ns is not None:
            rest_ns = max(self._zero_ns + self._pause_ns - before_ns, CATCH_UP_NS)
            proven = self._proven_zero_ns is not None
            self._zero_ns = now_ns + rest_ns - self._pause_ns
            self._proven_zero_ns = self._zero_ns if proven else None

    def cancel_zero(self, at_ns: int) -> None:
        """Cancel the sender's zero, because another program may have sent a speed.

        `at_ns` is the monotonic time at which the speed may have been sent, ns. Only a zero of an
        identity that several programs may share is canceled. A canceled zero does not arm the
        sender. If `commands.neutral_pause` was already over at `at_ns`, the sender stays armed.
        """
        self._settle(at_ns)
        self._zero_ns = self._proven_zero_ns = None

    def outdate(self, command: Command) -> None:
        """Process a speed without a stamp that may have waited during a stall of the daemon.

        This speed does not show what the sender wants now, and neither does the last command before
        the stall. Therefore neither command moves the robot, but the sender takes part in the
        choice of the arbiter.
        """
        now_ns = command.arrived_ns
        if not self.present(now_ns):
            self.came_ns = now_ns
        self.arrived_ns = now_ns - min(self._timeout_ns + 1, CANDIDATE_NS)
        self.twist, self._present_ns = REST, now_ns
        self.refuse(command, "stale")

    def refuse(self, command: Command, why: Verdict) -> None:
        """Record a command that was refused because of its stamp.

        `why` is the verdict on the stamp.
        """
        self.noticed_ns = command.arrived_ns
        self._doubt(command, why)

    def take(
        self, command: Command, since_ns: int, verdict: Verdict = "fresh", watched_ns: int = 0
    ) -> None:
        """Process a command that was not refused.

        If `verdict` is "first" or "unproven", the delays of the sender are not proved yet. The
        command then does not drive the robot, but a zero already arms the sender. `unlearn` undoes
        this arming. If the command is a speed, and several programs may share the sender's
        identity, the caller must first call `cancel_zero` of each sender of the source.

        Args:
            command: the command.
            since_ns: the monotonic time from which zeros arm the sender, ns. An earlier zero does
                not arm it (see `Arbiter.require_neutral`).
            verdict: the verdict of `Freshness.judge` on the stamp of the command.
            watched_ns: the monotonic time at which the daemon's last stall ended, ns.
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
        self._update_times(zero, now_ns, present)
        self.ros, self.name = command.ros, command.sender
        self.twist, self._doubted_ns = command.twist, None
        self.arrived_ns = self._present_ns = now_ns
        self._stamp_ns, self._number = command.stamp_ns, command.sequence
        if self._ended is not None:
            if self._overtaken(command, self._ended):
                self.twist = REST
            else:
                self._ended = None
        if zero and self._ended is None:
            # `Freshness` already compares the stamps of commands of one clock with each other, so
            # leave out the stamp of this accepted zero.
            self._ended = replace(command, stamp_ns=None)

    def _update_times(self, zero: bool, now_ns: int, present: bool) -> None:
        """Update `zeros_ns` and `speeds_ns`, which say since when only zeros or speeds arrive.

        `now_ns` is the monotonic time at which the command arrived, ns. `zero` says whether the
        command is a zero. `present` is false if this command ends a silence of the sender.
        """
        since_ns = self.zeros_ns if zero else self.speeds_ns
        if since_ns is None or not present:
            since_ns = now_ns
        self.zeros_ns, self.speeds_ns = (since_ns, None) if zero else (None, since_ns)

    def _overtaken(self, command: Command, zero: Command) -> bool:
        """Return whether this command was sent before `zero` but arrived after it."""
        # The network delays an accepted command by at most about the timeout. Therefore the stamp
        # of `zero` is wrong if it is later by more than the timeout. If a command with a lower
        # number arrives more than the timeout after `zero`, the sender has restarted its numbers.
        # In both cases, `zero` must not keep the robot at rest.
        if command.clock != zero.clock:
            # Stamps of two clocks cannot be compared, but a sender numbers all its commands.
            passed_ns = command.arrived_ns - zero.arrived_ns
            recent = passed_ns <= self._timeout_ns + MAX_JITTER_NS
            return recent and _later(zero.sequence, command.sequence)
        if command.stamp_ns is None or zero.stamp_ns is None:
            return False
        return 0 < zero.stamp_ns - command.stamp_ns <= self._timeout_ns

    def _doubt(self, command: Command, why: Verdict) -> None:
        if is_zero(command) and (
            self.arrived_ns is None
            or _later(command.stamp_ns, self._stamp_ns)
            or _later(command.sequence, self._number)
        ):
            # The sender does not want its last speed any more, however late this zero may be.
            self.twist, self._ended = REST, command
        present = self.present(command.arrived_ns)
        if present:
            self._present_ns = command.arrived_ns
        self._update_times(is_zero(command), command.arrived_ns, present)
        self._doubted_ns, self.doubt, self.ros = command.arrived_ns, why, command.ros

    def _settle(self, now_ns: int) -> None:
        """Arm the sender if `commands.neutral_pause` has passed since its zero.

        Only a sender whose identity several programs may share must wait for this pause. `now_ns`
        is the monotonic time, ns.
        """
        if self._zero_ns is not None and now_ns - self._zero_ns >= self._pause_ns:
            self._armed = True
            if self._proven_zero_ns == self._zero_ns:
                self._proven_armed = True


def _later(mark: int | None, last: int | None) -> bool:
    return mark is not None and last is not None and mark > last


def is_zero(command: Command) -> bool:
    """Return whether the command asks the robot to rest.

    A motion that the robot cannot perform, such as a sideways speed, does not ask for rest, even
    though its `twist` is zero (see `Command.cancelled`).
    """
    return command.twist == REST and not command.cancelled
