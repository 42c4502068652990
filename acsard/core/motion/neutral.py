"""Applies the neutral-first rule to one sender: only an armed sender may drive the robot.

Only a zero arms, silence does not, until `require_neutral`, `disarm` or `unlearn`. If several
programs may share the identity, the zero arms it after `NEUTRAL_PAUSE_NS`, unless a speed of
any shared identity of the source cancels it. A live sender (its last accepted command is within the
timeout) is present, so it may be chosen. After a stall or with doubtful stamps it stays present for
`CANDIDATE_NS`; otherwise one that holds the robot with zeros would lose control to one that sends
speeds.
"""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.motion.emergency_stop import CATCH_UP_NS
from acsard.core.motion.freshness import MAX_JITTER_NS, MAX_PROOF_NS, Verdict
from acsard.core.values import NS_PER_S, REST, Command, Ns

# Programs without a sender id and without a GID may share an identity. For them:
#
# - The zero of one must not arm another one that never stopped, so it arms only after
#   `NEUTRAL_PAUSE_NS` without a speed. Further zeros and silence do not restart this time.
# - While the daemon stands still, it receives no speeds, so a stall does not count towards it.
# - One program may have several shared identities in turn, by the Zenoh session that stamps its
#   commands, so a speed of one cancels the zeros of all shared identities of the source.

# Time for which a sender that is not live stays in the choice, and an unarmed one keeps control
# after its clock was set. Even a longest proof that restarts with its second half ends within it.
CANDIDATE_NS = 2 * MAX_PROOF_NS

# Without a speed, after the zero of a shared identity: longer than the pauses of irregular senders.
NEUTRAL_PAUSE_NS = NS_PER_S

FOREVER_NS = 1 << 62


class Sender:
    """One sender of a command source: its last command, and whether it is armed."""

    def __init__(self, timeout_ns: Ns, neutral_first: bool) -> None:
        self.use(timeout_ns)
        self._neutral_first = neutral_first
        self._armed = self._proven_armed = not neutral_first
        self._zero_ns: Ns | None = None  # zero of a shared identity that will arm it
        self._proven_zero_ns: Ns | None = None
        self.name = ""
        self._stamp_ns: Ns | None = None  # of the last accepted command
        self._number: int | None = None  # of the last accepted command
        # The last zero (accepted: without a stamp), until a command that was sent after it arrives.
        # A speed from before it must not move the robot again.
        self._ended: Command | None = None
        self.clock = ""  # of the last command
        self.twist = REST
        self.arrived_ns: Ns | None = None  # last accepted command since `require_neutral`
        self._present_ns = 0  # last command, accepted or not; a stall moves it to its end
        self.came_ns = 0  # first accepted command after its last silence
        self.zeros_ns: Ns | None = None  # zeros only since then, without a silence
        self.speeds_ns: Ns | None = None  # speeds only since then, without a silence
        self.disarmed_ns: Ns | None = None  # by `disarm`
        self.ros = False  # the last command came from ROS, whose tools send no zero by themselves
        self.shared = False  # several programs may share its identity
        self.noticed_ns = 0  # last message, even a refused one
        self._doubted_ns: Ns | None = None
        self.doubt: Verdict = "unproven"  # of the last command with an unacceptable stamp

    def use(self, timeout_ns: Ns) -> None:
        self._timeout_ns = timeout_ns

    def is_live(self, now_ns: Ns) -> bool:
        """Return whether the last accepted command is within the timeout of its source."""
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= self._timeout_ns

    def present(self, now_ns: Ns) -> bool:
        """Return whether the sender takes part in the arbiter's choice.

        A live one does, and for `CANDIDATE_NS` after its last accepted command one that goes on
        sending with doubtful stamps, or after a stall that ended at most a timeout ago.
        """
        arrived_ns, timeout_ns = self.arrived_ns, self._timeout_ns
        return arrived_ns is not None and (
            now_ns - arrived_ns <= timeout_ns
            or (now_ns - self._present_ns <= timeout_ns and now_ns - arrived_ns <= CANDIDATE_NS)
        )

    def rank(self, now_ns: Ns) -> tuple[bool, int]:
        """Return the sort key of present senders: live ones first, then who began first."""
        return not self.is_live(now_ns), self.came_ns

    def doubtful(self, now_ns: Ns) -> bool:
        """Return whether a command within the timeout had an unacceptable stamp."""
        return self._doubted_ns is not None and now_ns - self._doubted_ns <= self._timeout_ns

    def armed(self, now_ns: Ns) -> bool:
        """Return whether the sender is armed, as it always is without the neutral-first rule."""
        if self._zero_ns is not None:
            self._settle(now_ns)
        return self._armed

    def require_neutral(self) -> None:
        """Forget the last command; a zero must come again before the sender drives."""
        self.arrived_ns = self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def disarm(self, now_ns: Ns) -> None:
        """Disarm the sender because its clock was set; it still takes part in the choice."""
        if self.armed(now_ns):
            self.disarmed_ns = now_ns
        self._zero_ns = self._proven_zero_ns = None
        self._armed = self._proven_armed = not self._neutral_first

    def holds(self, now_ns: Ns) -> bool:
        """Return whether a sender in control may keep it: it is present, and armed or nearly so.

        Nearly: `disarm` was at most `CANDIDATE_NS` ago, or its zero's neutral pause is running.
        """
        just_set = self.disarmed_ns is not None and now_ns - self.disarmed_ns <= CANDIDATE_NS
        waits = just_set or self._zero_ns is not None
        return self.present(now_ns) and (waits or self.armed(now_ns))

    def unlearn(self) -> None:
        """Undo the arming by zeros with unproven stamps, which the network may have delayed."""
        self._armed, self._zero_ns = self._proven_armed, self._proven_zero_ns

    def changes_ns(self, now_ns: Ns) -> Ns:
        """Return the next time at which a method gives another result without a new message."""
        times = [FOREVER_NS]
        if self.arrived_ns is not None:
            times.append(self.arrived_ns + self._timeout_ns + 1)
            times.append(self.arrived_ns + CANDIDATE_NS + 1)
            times.append(self._present_ns + self._timeout_ns + 1)
        if self._doubted_ns is not None:
            times.append(self._doubted_ns + self._timeout_ns + 1)
        if self.disarmed_ns is not None:
            times.append(self.disarmed_ns + CANDIDATE_NS + 1)
        if self._zero_ns is not None:
            times.append(self._zero_ns + NEUTRAL_PAUSE_NS)
        return min([time for time in times if time > now_ns])

    def resume(self, before_ns: Ns, now_ns: Ns) -> None:
        """Continue after the daemon stood still from `before_ns` to `now_ns`.

        Commands of that time may come later, so the sender stays present for one timeout more,
        within `CANDIDATE_NS`. A running neutral pause does not advance, and lasts for `CATCH_UP_NS`
        more at least.
        """
        if self.present(before_ns):
            self._present_ns = now_ns
        self._settle(before_ns)
        if not self._armed and self._zero_ns is not None:
            rest_ns = max(self._zero_ns + NEUTRAL_PAUSE_NS - before_ns, CATCH_UP_NS)
            proven = self._proven_zero_ns is not None
            self._zero_ns = now_ns + rest_ns - NEUTRAL_PAUSE_NS
            self._proven_zero_ns = self._zero_ns if proven else None

    def cancel_zero(self, at_ns: Ns) -> None:
        """Cancel the zero of a shared identity: another program may have sent a speed at `at_ns`.

        If neutral pause was over by then, the sender stays armed.
        """
        self._settle(at_ns)
        self._zero_ns = self._proven_zero_ns = None

    def outdate(self, command: Command) -> None:
        """Process a speed without a stamp that may have waited during a stall of the daemon.

        Neither it nor the last command before the stall shows what the sender wants now, so neither
        moves the robot, but the sender takes part in the choice.
        """
        now_ns = command.arrived_ns
        if not self.present(now_ns):
            self.came_ns = now_ns
        self.arrived_ns = now_ns - min(self._timeout_ns + 1, CANDIDATE_NS)
        self.twist, self._present_ns = REST, now_ns
        self.refuse(command, "stale")

    def refuse(self, command: Command, why: Verdict) -> None:
        self.noticed_ns = command.arrived_ns
        self._doubt(command, why)

    def take(
        self, command: Command, since_ns: Ns, verdict: Verdict = "fresh", watched_ns: Ns = 0
    ) -> None:
        """Process a command that was not refused.

        With "first" or "unproven" it does not drive, but a zero already arms (see `unlearn`).
        Before a speed of a shared identity, the caller calls `cancel_zero` of each sender of the
        source. Zeros arm from `since_ns` on, and neutral pause begins at `watched_ns`, the end of
        the last stall, at the earliest.
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
                # When the zero arms, an earlier speed must not drive the robot.
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
            # `Freshness` compares the stamps of accepted commands already.
            self._ended = replace(command, stamp_ns=None)

    def _update_times(self, zero: bool, now_ns: Ns, present: bool) -> None:
        since_ns = self.zeros_ns if zero else self.speeds_ns
        if since_ns is None or not present:
            since_ns = now_ns
        self.zeros_ns, self.speeds_ns = (since_ns, None) if zero else (None, since_ns)

    def _overtaken(self, command: Command, zero: Command) -> bool:
        # Sent before `zero`, but arrived after it. A stamp or a number that says so for longer than
        # the timeout is wrong: the network delays no accepted command by more, and the sender may
        # have restarted its numbers. Then `zero` must not keep the robot at rest.
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

    def _settle(self, now_ns: Ns) -> None:
        if self._zero_ns is not None and now_ns - self._zero_ns >= NEUTRAL_PAUSE_NS:
            self._armed = True
            if self._proven_zero_ns == self._zero_ns:
                self._proven_armed = True


def _later(mark: int | None, last: int | None) -> bool:
    return mark is not None and last is not None and mark > last


def is_zero(command: Command) -> bool:
    """Return whether a command asks for rest.

    A motion that the robot cannot perform does not, although its twist is zero
    (`Command.cancelled`).
    """
    return command.twist == REST and not command.cancelled
