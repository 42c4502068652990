"""Commands the robot as one sender: which command is sent, when, and why it has no effect.

This module is pure. Every program that commands the robot uses these time limits. `Commander` is
for a program that forwards the wishes of a person. It sends each wish at most once and repeats
nothing, so the robot stops when the person, the panel or the network falls silent. The newest wish
replaces the one that waits. A zero is never too old to be sent, and the last command is a zero.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.messages.schema import RobotState
from acsard.core.messages.signature import Signature
from acsard.core.values import NS_PER_S, REST, Twist

SEND_PERIOD_S = 0.05
"""Pause between two commands, s: 20 Hz, so five commands within the default timeout."""

SPACING_S = 0.003
"""Smallest pause between two commands on one connection, s. The daemon accepts 1000 a second."""

OPENING_S, OPENING_PERIOD_S = 0.4, 0.01
"""Duration and period of the zeros at the beginning, s. A daemon to which the sender is new
checks for 0.25 s that the commands are not late. More zeros let it decide sooner despite the
jitter of a busy machine.
"""

OPENED_S = 4.0
"""Time after which zeros must count, s. The delay of a sender that is new to the daemon is checked
for up to 2 s, if its source has so long a timeout. It also gives another driver time to leave."""

ZEROS = 3
"""Number of zeros at the end, in case the network loses one."""

GRACE_S = 0.5
"""Longest time, s, for which commands may have no effect before the operator is told or the drive
ends. The first 0.25 s of a new sender never count, and a sender that was only delayed counts again
sooner.
"""

SILENCE_NS = 3 * NS_PER_S // 10
"""Silence after which the robot has begun to brake; the default timeout of a source is 0.25 s."""

GATHER_NS = NS_PER_S // 25
"""Time within which a held-back burst arrives; a panel at 20 Hz does not send twice in it. Only the
first command after a silence waits this long."""

STALE_NS = NS_PER_S // 10
"""Age above which a speed is dropped, because it no longer shows the operator's intention."""

DRIVES_NS = NS_PER_S // 2
"""Time after the last wish for a speed for which a sender counts as driving."""

LONGEST_S = 10.0
"""Longest possible timeout of a source, s. The robot follows no speed that is older."""

NEVER = ("inactive", "stopped", "fault", "shutdown")
"""Modes in which no command counts."""


class Wish(Struct, frozen=True):
    """A command, and its time on the sender's clock, ns; None for a sender without a clock."""

    twist: Twist
    stamp_ns: int | None = None
    steady: bool = False
    """Whether that clock is never adjusted."""


class Commander:
    """The commands of one sender; only the newest one waits.

    With `leads`, a zero is sent first after each silence, for a sender that sends no zeros of its
    own. With `gathers`, a burst after a silence is dropped, because a congested link or a stalled
    process held it back. It is for a sender without stamps, whose delay the daemon cannot judge.
    """

    def __init__(self, *, leads: bool = False, gathers: bool = False) -> None:
        self.replaced = self.stale = 0
        """Counters of wishes that were not sent: replaced by a newer one, or too late."""
        self._leads, self._gather_ns = leads, GATHER_NS if gathers else 0
        self._wish: Wish | None = None
        self._last = Wish(REST)
        """The newest wish, whether it still waits or not."""
        self._came_ns = 0
        self._heard_ns: int | None = None
        self._lead = False
        self._hold_until_ns = 0
        self._burst = 0
        """Number of wishes since the silence, until one is sent."""
        self._moved_ns: int | None = None
        """Time at which a speed was sent; None after a zero."""
        self._asked_ns: int | None = None
        """Time at which a speed was last requested; None after a zero."""

    def take(self, wish: Wish, now_ns: int) -> int | None:
        """Take a wish; return the silence before it if it was longer than `SILENCE_NS`, ns."""
        silence = None if self._heard_ns is None else now_ns - self._heard_ns
        begins = silence is None or silence > SILENCE_NS
        if begins:
            self._lead, self._burst = self._leads, 0
            self._hold_until_ns = now_ns + self._gather_ns
        if now_ns < self._hold_until_ns:
            self._burst += 1
        if self._wish is not None:
            self.replaced += 1
        self._wish = self._last = wish
        self._came_ns = self._heard_ns = now_ns
        self._asked_ns = None if wish.twist == REST else now_ns
        return silence if begins else None

    def due_ns(self) -> int | None:
        """Return the time from which `send` has a command, or None if it has none."""
        if self._lead:
            return self._came_ns
        return None if self._wish is None else self._hold_until_ns

    def send(self, now_ns: int) -> Wish | None:
        """Return the command to send now, or None."""
        if self._lead:
            self._lead = False
            return self._zero(now_ns)
        if self._wish is None or now_ns < self._hold_until_ns:
            return None
        wish, self._wish = self._wish, None
        burst, self._burst = self._burst, 0
        moves = wish.twist != REST
        if moves and (burst > 1 or now_ns - self._came_ns > STALE_NS):
            self.stale += 1
            return None
        self._moved_ns = now_ns if moves else None
        return wish

    def end(self, now_ns: int, timeout_s: float = LONGEST_S) -> Wish | None:
        """Release the robot; return a zero if it may still follow a speed of this sender.

        `timeout_s` is the timeout of the sender's source. A zero later than that would only stop
        the next driver.
        """
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = self._asked_ns = None
        self._lead = False
        # The command may have taken 0.1 s to arrive, and the robot follows it from then on.
        if moved_ns is None or now_ns - moved_ns > timeout_s * NS_PER_S + NS_PER_S // 10:
            return None
        return self._zero(now_ns)

    def _zero(self, now_ns: int) -> Wish:
        """Return a zero stamped by the sender's clock.

        A stamp of another clock would look like a clock change.
        """
        stamp_ns = self._last.stamp_ns
        if stamp_ns is not None:
            stamp_ns += now_ns - self._came_ns
        return Wish(REST, stamp_ns, self._last.steady)

    def drives(self, now_ns: int) -> bool:
        """Return whether the sender asks for a speed."""
        return self._asked_ns is not None and now_ns - self._asked_ns <= DRIVES_NS


class Sender:
    """The identity of one sender, and the number and the newest stamp of its commands."""

    def __init__(self, sender_id: str) -> None:
        self._id, self._sequence, self._newest_ns = sender_id, 0, 0

    def sign(self, stamp_ns: int | None, *, steady: bool, zero: bool = False) -> Signature:
        """Return the signature of the next command.

        `zero` says that the command is a zero. Its stamp is never older than an earlier stamp of
        this sender, because the daemon refuses an older command after a newer one. A sender that
        drives as two sources has one clock, but its commands may overtake each other.
        """
        self._sequence += 1
        if stamp_ns is not None:
            newest_ns = max(stamp_ns, self._newest_ns)
            self._newest_ns, stamp_ns = newest_ns, newest_ns if zero else stamp_ns
        return Signature(self._id, stamp_ns, self._sequence, steady)


def objection(state: RobotState, source: str, sender: str) -> str:
    """Return why the robot does not follow the commands of `sender` as `source`; "" if it does."""
    if state.mode in NEVER:
        return state.reason
    ours = next((one for one in state.sources if one.name == source), None)
    if ours is None:
        names = ", ".join(one.name for one in state.sources)
        return f"{source} is not one of commands.sources: {names}"
    if state.mode == "waiting":
        return state.reason
    if not heard(state, source):
        return no_command(source)
    if state.source != source:
        return ours.waits_for or state.reason
    # The robot is `ready`: the zeros of this client arrive, but they do not count.
    if state.mode != "driving":
        return state.reason
    if state.sender in ("", sender):
        return ""
    return (
        f"another program drives the robot as {source}, {state.sender}: end it, or wait until it "
        "is silent"
    )


def no_command(source: str) -> str:
    """Return the objection to a client whose commands do not arrive at the daemon."""
    return f"the daemon receives no command of source {source}"


def heard(state: RobotState, source: str) -> bool:
    """Return whether any command of this source arrives, even if it is late."""
    return any(one.name == source and one.waits_for != "a command" for one in state.sources)


def hopeless(state: RobotState, source: str) -> bool:
    """Return whether the daemon will keep refusing this source, so that waiting cannot help."""
    return state.mode in NEVER or all(one.name != source for one in state.sources)
