"""Applies the neutral-first rule to one sender: only an armed sender may drive the robot.

A zero arms. If several programs may share the identity, the zero arms when no speed has followed
for `NEUTRAL_PAUSE_NS`. Where the source says `neutral_first = "pause"`, this holds for all of ROS,
and silence arms too, but only silence that is proved to be the sender's and not the network's:

- a publisher of rmw_zenoh: its last message was a zero, and the next number follows.
- any other ROS publisher: its liveliness token was there without a message for so long that a lost
  network would have ended it. It says nothing sooner, because a token stays for its lease.

`require_neutral` disarms, and so does silence of `SILENT_NS`.
"""

from __future__ import annotations

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.motion.ages import SILENT_NS, Order, number
from acsard.core.values import NS_PER_S, REST, Command, Ns, Twist, Wait

# Longer than the pauses of irregular senders.
NEUTRAL_PAUSE_NS = NS_PER_S

# The longest lease on the way: of a bridge, from whose end on silence disarms, and of a session of
# rmw_zenoh, with a second.
BRIDGE_LEASE_NS, RMW_LEASE_NS = SILENT_NS, 61 * NS_PER_S

FOREVER_NS = 1 << 62


class Hint(Struct, frozen=True, gc=False):
    """A zero, or the end of a pause, which arms later if the proof of the clock shows no delay."""

    zero: bool
    at_ns: Ns
    delay: int
    clock: str


class Sender(Struct):
    """One sender of a source: its last accepted command, and whether it is armed."""

    order: Order
    seen_ns: Ns  # last message, even a refused one
    shared: bool = False  # several programs may share its identity
    bridged: bool = False  # by a bridge of ROS
    number: int = 0  # the highest one that was received
    rests: bool = False  # the message with this number was a zero
    ros: bool = False  # the last command came from ROS, whose tools send no zero by themselves
    twist: Twist = REST
    arrived_ns: Ns | None = None  # last accepted command since `require_neutral`
    present_ns: Ns = 0  # the same, or the end of a later stall of the daemon
    came_ns: Ns = 0  # first accepted command after its last silence
    zeros_ns: Ns | None = None  # it has sent only zeros since then
    speeds_ns: Ns | None = None  # it has sent only speeds since then
    armed: bool = False
    zero_ns: Ns | None = None  # a zero that arms after `NEUTRAL_PAUSE_NS`
    hint: Hint | None = None
    refused: Wait | None = None  # why the last command was refused
    refused_ns: Ns = 0

    def is_live(self, now_ns: Ns, timeout_ns: Ns) -> bool:
        return self.arrived_ns is not None and now_ns - self.arrived_ns <= timeout_ns

    def is_present(self, now_ns: Ns, timeout_ns: Ns) -> bool:
        """Return whether the sender takes part in the choice: a stall of the daemon ends no sender.

        Otherwise, after a stall, the first sender that is read would take the robot from another.
        """
        return self.arrived_ns is not None and now_ns - self.present_ns <= timeout_ns

    def is_armed(self, now_ns: Ns) -> bool:
        if self.arrived_ns is None or now_ns - self.arrived_ns > SILENT_NS:
            return False
        return self.armed or (
            self.zero_ns is not None and now_ns - self.zero_ns >= NEUTRAL_PAUSE_NS
        )

    def worth(self, now_ns: Ns, timeout_ns: Ns) -> tuple[bool, bool, Ns]:
        """Return the sort key by which senders are replaced: one that may drive comes last."""
        armed = self.is_armed(now_ns)
        return armed and self.is_present(now_ns, timeout_ns), armed, self.seen_ns

    def changes_ns(self, now_ns: Ns, timeout_ns: Ns) -> Ns:
        """Return the next time at which a method gives another result without a new message."""
        arrived_ns, zero_ns = self.arrived_ns or 0, self.zero_ns or 0
        next_ns = FOREVER_NS
        for time_ns in (
            arrived_ns + timeout_ns + 1,
            self.present_ns + timeout_ns + 1,
            self.refused_ns + timeout_ns + 1,
            arrived_ns + SILENT_NS + 1,
            zero_ns + NEUTRAL_PAUSE_NS,
        ):
            if now_ns < time_ns < next_ns:
                next_ns = time_ns
        return next_ns

    def require_neutral(self) -> None:
        """Forget the last command; the sender must be neutral again before it drives."""
        self.arrived_ns = self.zero_ns = self.hint = None
        self.armed = False

    def receive(self, command: Command) -> None:
        """Note a message, even one that is refused."""
        self.seen_ns = command.arrived_ns
        self.shared, self.ros, self.bridged = command.shared, command.ros, command.bridged
        if command.sequence is not None and command.sequence > self.number:
            self.number, self.rests = command.sequence, is_zero(command)

    def find_gap(self, command: Command) -> None:
        """Cancel a zero that waits if a lost command came behind it: it may have been a speed."""
        numbered = command.ros and not command.shared and self.number > 0
        if numbered and not self.armed and number(command) > self.number + 1:
            self.zero_ns = None

    def follows_rest(self, command: Command) -> bool:
        """Return whether the number of a command proves that nothing was sent since a zero."""
        numbered = command.ros and not command.shared and self.number > 0
        return numbered and self.rests and number(command) == self.number + 1

    def cancel_zero(self, at_ns: Ns) -> None:
        """Cancel a zero, because another program of a shared identity may have sent a speed."""
        self.armed = self.is_armed(at_ns)
        self.zero_ns = None
        hint = self.hint
        if hint is not None and hint.zero and at_ns - hint.at_ns < NEUTRAL_PAUSE_NS:
            self.hint = None

    def resume(self, before_ns: Ns, now_ns: Ns, timeout_ns: Ns) -> None:
        """Continue after the daemon stood still: the pause behind a shared zero starts again."""
        if self.is_present(before_ns, timeout_ns):
            self.present_ns = now_ns
        self.armed = self.is_armed(before_ns)
        if self.zero_ns is not None:
            self.zero_ns = now_ns
        if self.hint is not None:
            self.hint = replace(self.hint, at_ns=now_ns)

    def repeats(self, command: Command, timeout_ns: Ns) -> bool:
        """Return whether a command repeats the last one of a sender that is armed and live."""
        unchanged = command.twist == self.twist and is_zero(command) == (self.zeros_ns is not None)
        return unchanged and self.armed and self.is_live(command.arrived_ns, timeout_ns)

    def take(self, command: Command, timeout_ns: Ns) -> None:
        now_ns, zero = command.arrived_ns, is_zero(command)
        self.armed = self.is_armed(now_ns)
        if not self.is_present(now_ns, timeout_ns):
            self.came_ns, self.zeros_ns, self.speeds_ns = now_ns, None, None
        since_ns = self.zeros_ns if zero else self.speeds_ns
        since_ns = now_ns if since_ns is None else since_ns
        self.zeros_ns, self.speeds_ns = (since_ns, None) if zero else (None, since_ns)
        self.twist, self.arrived_ns, self.present_ns = command.twist, now_ns, now_ns
        self.refused = None

    def neutral(self, at_ns: Ns, zero: bool, waits: bool) -> None:
        """Arm after a zero, which may wait for `NEUTRAL_PAUSE_NS`, or after a proved pause."""
        if not (zero and waits):
            self.armed = True
        elif self.zero_ns is None:
            self.zero_ns = at_ns

    def refuse(self, command: Command, why: Wait) -> None:
        """Process a refused command: a newer zero still ends the speed, but arms nothing."""
        self.refused, self.refused_ns = why, command.arrived_ns
        sequence = command.sequence
        newer = why.what != "not_newer" if sequence is None else sequence > self.order.sequence
        if newer and is_zero(command):
            self.twist = REST
            if sequence is not None:
                # A speed that was sent before it, and that it overtook, must not count any more.
                self.order.sequence, self.order.at_ns = sequence, command.arrived_ns


def is_zero(command: Command) -> bool:
    """Return whether a command asks for rest.

    A motion that the robot cannot perform does not, although its twist is zero
    (`Command.cancelled`).
    """
    return command.twist == REST and not command.cancelled
