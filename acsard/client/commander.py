"""The rules for a sender of commands: what it sends and when, and why a command has no effect.

This module is pure: times and commands come in as arguments. Every program that commands the robot
uses the time limits of this module. A program that forwards the commands of a person, for example
from a panel in a browser, passes each command as a `Wish` to a `Commander`.

A `Commander` never repeats a command, so the robot stops when the person, the panel or the network
falls silent. A new command replaces a command that still waits to be sent. A zero is sent even if
it is old. A drive ends with a zero.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.messages.schema import RobotState, SourceState
from acsard.core.messages.signature import Signature
from acsard.core.values import NS_PER_S, REST, Twist

SEND_PERIOD_S = 0.05
"""Pause between two commands of a drive, s. At 20 Hz, a source sends five commands within its
default timeout of 0.25 s."""

MIN_SPACING_S = 0.003
"""Shortest pause between two commands on one connection, s. The daemon drops commands at rates
above 1000 per second."""

OPENING_S, OPENING_PERIOD_S = 0.4, 0.01
"""Duration and period of the zeros that a client sends at the beginning of a drive, s. The daemon
checks for 0.25 s whether the commands of a new sender are late. With many zeros in this time, the
jitter of a busy machine does not prolong the check."""

OPEN_TIMEOUT_S = 4.0
"""Time within which the daemon must accept the zeros at the beginning of a drive, s. Otherwise the
drive fails. If the source has a long timeout, the daemon checks the delay of a new sender for up to
2 s. The rest of the time is for another sender that must finish its drive first."""

ZEROS = 3
"""Smallest number of zeros that a sender sends at the end of a drive. A hiccup of the network may
lose all of them. A sender that follows the robot's state therefore uses `FinalZeros`."""

GRACE_S = 0.5
"""Longest time for which commands may have no effect, s. After this time, the program informs the
operator or ends the drive. A drive also ends if the program itself sends no command for longer than
this. The time must be longer than 0.25 s, because the first commands of a new sender have no effect
for that long. It must also be longer than a short delay of a known sender."""

BRAKING_AFTER_NS = 3 * NS_PER_S // 10
"""Time without a command after which the robot is assumed to brake, ns. It is a little longer than
a source's default timeout of 0.25 s."""

RELEASE_TIMEOUT_NS = 3 * NS_PER_S // 2
"""Time without input after which a button or a key that was held counts as released, ns. A shorter
silence may be a pause of the network. A panel of Foxglove publishes once a second by default, and
must not seem released between its messages. The time must be shorter than 2 s: if a new sender is
silent for 2 s after its zero, the daemon forgets the zero."""

BURST_WINDOW_NS = NS_PER_S // 25
"""Time for which the first command after a silence waits to be sent, ns. The wait shows whether a
burst follows: a panel that sends at 20 Hz sends at most one command in this time. After a burst of
more than `MAX_BURST_COMMANDS` commands, the next command waits too."""

MAX_BURST_COMMANDS = 5
"""Largest number of commands that a panel is assumed to send within `BURST_WINDOW_NS` (125 Hz). If
more commands arrive, they have waited in a queue, which may contain further commands."""

STALE_NS = NS_PER_S // 10
"""Largest age of a nonzero command that is still sent, ns. An older one is dropped, because the
operator may no longer want it."""

DRIVING_TIMEOUT_NS = NS_PER_S // 2
"""Time for which a sender still counts as driving after its last nonzero command, ns."""

MAX_SOURCE_TIMEOUT_S = 10.0
"""Longest timeout that a command source may have, s. The robot follows no command older than
this."""

NEVER_DRIVING_MODES = ("inactive", "stopped", "fault", "shutdown")
"""Modes in which no command moves the robot, and which do not end by themselves."""


class Wish(Struct, frozen=True):
    """A command to forward: the twist that a person requests.

    `stamp_ns` is the time of the command on the sender's clock, ns; None if the sender has no
    clock.
    """

    twist: Twist
    stamp_ns: int | None = None
    steady: bool = False
    """Whether the clock of `stamp_ns` is steady, which means that nothing adjusts it."""


class Commander:
    """Decides when to send the commands of one sender, and which commands to drop.

    At most one command waits to be sent. A newer command replaces the waiting command. All times
    are monotonic times in ns.

    Args:
        sends_leading_zero: whether to send a zero (a command with the speed 0) before the first
            command, and before the first command after each silence longer than
            `RELEASE_TIMEOUT_NS`. The daemon requires a zero before a sender may move the robot, so
            set this for a sender that never sends zeros itself. No zero is sent after a shorter
            silence, because the person may still hold a button. After a stop and a `clear`, such a
            zero would arm the sender, and the held button would drive the robot again.
        connected_ns: the monotonic time of the sender's connection, ns. Set this for a sender that
            may connect while a button is held. If its first command arrives within
            `RELEASE_TIMEOUT_NS` after this time, no zero is sent before that command. None means
            that no button was held.
        detects_bursts: whether the first command after a silence waits for `BURST_WINDOW_NS`. If
            several commands arrive in this time, a congested link or a stalled process has delayed
            these commands. In this case they are dropped, except the last one if it is a zero. Set
            this for a sender without stamps, because the daemon cannot measure the delay of its
            commands.
    """

    def __init__(
        self,
        *,
        sends_leading_zero: bool = False,
        connected_ns: int | None = None,
        detects_bursts: bool = False,
    ) -> None:
        self.replaced = self.stale = 0
        """Two counters of commands that were not sent. `replaced` counts the commands that a newer
        command replaced, and `stale` counts the commands that were too old or came in a burst."""
        self._sends_leading_zero = sends_leading_zero
        self._gather_ns = BURST_WINDOW_NS if detects_bursts else 0
        self._wish: Wish | None = None
        self._last = Wish(REST)
        """The newest command, sent or not."""
        self._came_ns = 0
        self._connected_ns = connected_ns
        """Monotonic time of the sender's connection, ns; None if no button was held then."""
        self._heard_ns: int | None = None
        """Monotonic time of the newest command, ns; None before the first command."""
        self._lead = False
        self._hold_until_ns = 0
        self._burst = 0
        """Number of commands that have arrived while the first of these commands waits (see
        `BURST_WINDOW_NS`). The method `send()` resets this number."""
        self._crowded = False
        """Whether the last burst had more than `MAX_BURST_COMMANDS` commands."""
        self._moved_ns: int | None = None
        """Monotonic time at which a nonzero command was last sent, ns; None after a zero."""
        self._asked_ns: int | None = None
        """Monotonic time at which a nonzero command last arrived, ns; None after a zero."""

    def take(self, wish: Wish, now_ns: int) -> int | None:
        """Store a command that has arrived. It replaces a command that still waits to be sent.

        Returns the time since the previous command arrived, if this time is longer than
        `BRAKING_AFTER_NS`. Returns None after a shorter time, and for the first command.
        """
        silence = None if self._heard_ns is None else now_ns - self._heard_ns
        begins = silence is None or silence > BRAKING_AFTER_NS
        before_ns = self._connected_ns if self._heard_ns is None else self._heard_ns
        if before_ns is None or now_ns - before_ns > RELEASE_TIMEOUT_NS:
            self._lead = self._sends_leading_zero
        if begins or (self._crowded and now_ns >= self._hold_until_ns):
            self._burst, self._crowded = 0, False
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
        """Return the time at which the caller must call `send`; None if nothing waits."""
        if self._lead:
            return self._came_ns
        return None if self._wish is None else self._hold_until_ns

    def send(self, now_ns: int) -> Wish | None:
        """Return the command that the caller must send now, or None.

        A nonzero command is dropped if it is older than `STALE_NS`, or if it came in a burst.
        """
        if self._lead:
            self._lead = False
            # If the zero had a later stamp than the command after it, the daemon would refuse the
            # command. The command leaves `_gather_ns` after the zero. With this stamp both have the
            # same delay, so the daemon need not test the delays of a new sender for longer.
            return self._zero(self._came_ns - max(1, self._gather_ns))
        if self._wish is None or now_ns < self._hold_until_ns:
            return None
        wish, self._wish = self._wish, None
        burst, self._burst = self._burst, 0
        self._crowded = burst > MAX_BURST_COMMANDS
        moves = wish.twist != REST
        if moves and (burst > 1 or now_ns - self._came_ns > STALE_NS):
            self.stale += 1
            return None
        self._moved_ns = now_ns if moves else None
        return wish

    def end(self, now_ns: int, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> Wish | None:
        """End the drive of this sender, and return a zero to send, or None.

        The command that waits to be sent is discarded. The result is a zero if the robot may still
        follow a nonzero command of this sender. The result is None if the last command was a zero,
        or if the timeout has passed since the last nonzero command, because a zero would then only
        stop the next sender. `timeout_s` is the timeout of this sender's source, s.
        """
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = self._asked_ns = None
        self._lead = False
        # The timeout begins when the last command arrives at the daemon, which may take 0.1 s.
        if moved_ns is None or now_ns - moved_ns > timeout_s * NS_PER_S + NS_PER_S // 10:
            return None
        return self._zero(now_ns)

    def _zero(self, at_ns: int) -> Wish:
        # With a stamp from another clock, the daemon would assume that the sender's clock has
        # jumped.
        stamp_ns = self._last.stamp_ns
        if stamp_ns is not None:
            stamp_ns += at_ns - self._came_ns
        return Wish(REST, stamp_ns, self._last.steady)

    @property
    def last_is_nonzero(self) -> bool:
        """Whether the last command that arrived was not zero, even if it arrived long ago."""
        return self._asked_ns is not None

    def is_driving(self, now_ns: int) -> bool:
        """Return whether the last command was not zero and arrived within `DRIVING_TIMEOUT_NS`."""
        return self._asked_ns is not None and now_ns - self._asked_ns <= DRIVING_TIMEOUT_NS


class CommandSigner:
    """Signs and numbers the commands of one sender."""

    def __init__(self, sender_id: str) -> None:
        self._id, self._sequence, self._newest_ns = sender_id, 0, 0

    def sign(self, stamp_ns: int | None, *, steady: bool, zero: bool = False) -> Signature:
        """Return the signature of the next command, with its sequence number.

        If this sender has already used a later stamp, a zero gets that later stamp, so that the
        daemon does not refuse the zero because its stamp is older.

        Args:
            stamp_ns: the time of the command on the sender's clock, ns; None if the sender has no
                clock.
            steady: whether this clock is steady, which means that nothing adjusts it.
            zero: whether the command is a zero.
        """
        self._sequence += 1
        # The daemon refuses a command whose stamp is older than that of an earlier command. If a
        # sender uses two sources, its commands may be signed in another order than their stamps.
        if stamp_ns is not None:
            newest_ns = max(stamp_ns, self._newest_ns)
            self._newest_ns, stamp_ns = newest_ns, newest_ns if zero else stamp_ns
        return Signature(self._id, stamp_ns, self._sequence, steady)


def objection(state: RobotState, source: str, sender: str) -> str:
    """Return why the robot does not follow the commands of a sender; "" if it follows them.

    Args:
        state: the newest state of the robot.
        source: the command source of the sender's commands.
        sender: the public name of the sender.
    """
    if state.mode in NEVER_DRIVING_MODES:
        return state.reason
    ours = _entry(state, source)
    if ours is None:
        names = ", ".join(entry.name for entry in state.sources)
        return (
            f"{source} is not one of commands.sources: {names}; use one of these sources, or add "
            f"{source} to commands.sources in the robot's acsard.toml and restart the daemon"
        )
    if state.mode == "waiting":
        return state.reason
    if ours.wait == "command":
        return no_command(source)
    if state.source != source:
        return ours.waits_for or state.reason
    # The robot is `ready`: the zeros of this client arrive, but do not let it drive yet.
    if state.mode != "driving":
        return state.reason
    if state.sender in ("", sender):
        return ""
    return (
        f"another program, {state.sender}, drives the robot as source {source}: end that program, "
        "or wait until it sends no commands"
    )


def no_command(source: str) -> str:
    """Return the message for the operator if no command of `source` reaches the daemon."""
    return (
        f"the daemon receives no command of source {source}; `acsard top` shows whether the daemon "
        "refuses commands"
    )


def must_release_key(state: RobotState, source: str) -> bool:
    """Return whether the operator must release a held key and press it again to drive.

    The operator must do so in two cases: the robot cannot drive in its present mode (a mode in
    `NEVER_DRIVING_MODES`, or "waiting"), or `source` must first send a zero. Otherwise, a held key
    would move the robot as soon as the robot can drive again, which the operator may not expect.
    """
    return not can_drive(state) or only_needs_zero(state, source)


def only_needs_zero(state: RobotState, source: str) -> bool:
    """Return whether the robot can drive, and `source` can drive it after a zero."""
    ours = _entry(state, source)
    return ours is not None and ours.wait == "neutral" and can_drive(state)


def can_drive(state: RobotState) -> bool:
    """Return whether some command can move the robot in its present mode."""
    return state.mode not in NEVER_DRIVING_MODES and state.mode != "waiting"


def receives_commands(state: RobotState, source: str) -> bool:
    """Return whether `state` shows that the daemon receives commands of this source.

    Late commands count too.
    """
    ours = _entry(state, source)
    return ours is not None and ours.wait != "command"


def refuses_for_good(state: RobotState, source: str) -> bool:
    """Return whether the daemon will keep refusing the commands of this source.

    If so, waiting cannot help: no command moves the robot in its present mode, or the source is not
    configured.
    """
    return state.mode in NEVER_DRIVING_MODES or _entry(state, source) is None


def _entry(state: RobotState, source: str) -> SourceState | None:
    return next((entry for entry in state.sources if entry.name == source), None)
