"""The rules for a sender of commands: what it sends and when, and why a command has no effect.

This module is pure, and every program that commands the robot uses its time limits. One that
forwards a person's commands passes each as a `Wish` to a `Commander`, which never repeats one: the
robot stops when the person, the panel or the network falls silent. A new command replaces one that
waits. A zero is sent even if it is old, and ends a drive.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.messages.schema import Beat, RobotState, SourceState
from acsard.core.messages.signature import Signature
from acsard.core.values import NS_PER_S, REST, Ns, Twist

SEND_PERIOD_S = 0.05  # of a drive: five commands within a source's default timeout of 0.25 s

MIN_SPACING_S = 0.003  # on one connection: the daemon drops commands above 1000 per second

# Zeros at the beginning, at least until a state after the first one may have arrived.
OPENING_S, OPENING_PERIOD_S = 0.2, 0.01

OPEN_TIMEOUT_S = 4.0  # for these zeros to be accepted: another sender may finish its drive

# Least zeros at the end of a drive. A hiccup of the network may lose all, so a sender that follows
# the state uses `FinalZeros`.
ZEROS = 3

# A drive ends after this time without an effect, or without a command of the program. It is longer
# than a short delay.
GRACE_S = 0.5

# Without input a held key counts as released.
RELEASE_TIMEOUT_NS = 3 * NS_PER_S // 2

STALE_NS = NS_PER_S // 10  # age of a speed that the operator may no longer want

MAX_SOURCE_TIMEOUT_S = 10.0  # of any source: the robot follows no older command

# That no command moves and that do not end by themselves.
NEVER_DRIVING_MODES = ("inactive", "stopped", "fault", "shutdown")


class Wish(Struct, frozen=True):
    """A twist that a person requests, with the time on the sender's clock, if it has one."""

    twist: Twist
    stamp_ns: Ns | None = None
    echo: Beat | None = None  # the newest beat that the person's program had received


class Commander:
    """Decides when to send the commands of one sender, and which commands to drop.

    At most one waits, and a newer one replaces it.

    Args:
        sends_leading_zero: send a zero before the first command, and after a silence of
            `RELEASE_TIMEOUT_NS`, for a sender that never sends one. After a shorter silence a
            button may be held, and after a stop and a `clear` a zero would arm it.
    """

    def __init__(self, *, sends_leading_zero: bool = False) -> None:
        self.replaced = self.stale = 0  # not sent: replaced by a newer one; too old
        self._sends_leading_zero = sends_leading_zero
        self._wish: Wish | None = None
        self._last = Wish(REST)  # sent or not
        self._came_ns: Ns | None = None  # newest command
        self._lead = False
        self._moved_ns: Ns | None = None  # a speed was last sent; None after a zero
        self._asked_ns: Ns | None = None  # a speed last arrived; None after a zero

    def take(self, wish: Wish, now_ns: Ns) -> None:
        """Store a command, which replaces one that waits."""
        if self._came_ns is None or now_ns - self._came_ns > RELEASE_TIMEOUT_NS:
            self._lead = self._sends_leading_zero
        if self._wish is not None:
            self.replaced += 1
        self._wish = self._last = wish
        self._came_ns = now_ns
        self._asked_ns = None if wish.twist == REST else now_ns

    @property
    def waits(self) -> bool:
        """Whether a command waits to be sent."""
        return self._lead or self._wish is not None

    def send(self, now_ns: Ns) -> Wish | None:
        """Return the command to send now, or None; drop a speed that is old."""
        if self._came_ns is None:
            return None
        if self._lead:
            self._lead = False
            # If the zero had a later stamp than the command after it, the daemon would refuse the
            # command.
            return self._zero(self._came_ns - 1)
        wish, self._wish = self._wish, None
        if wish is None:
            return None
        moves = wish.twist != REST
        if moves and now_ns - self._came_ns > STALE_NS:
            self.stale += 1
            return None
        self._moved_ns = now_ns if moves else None
        return wish

    def end(self, now_ns: Ns, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> Wish | None:
        """End the drive, discard what waits, and return a zero to send, or None.

        After a zero, or the source's timeout since the last speed, another zero would only stop the
        next sender.
        """
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = self._asked_ns = None
        self._lead = False
        # The timeout begins when the last command arrives at the daemon, which may take 0.1 s.
        if moved_ns is None or now_ns - moved_ns > timeout_s * NS_PER_S + NS_PER_S // 10:
            return None
        return self._zero(now_ns)

    def _zero(self, at_ns: Ns) -> Wish:
        # With a stamp from another clock, the daemon would assume that the sender's clock has
        # jumped.
        stamp_ns = self._last.stamp_ns
        if stamp_ns is not None and self._came_ns is not None:
            stamp_ns += at_ns - self._came_ns
        return Wish(REST, stamp_ns, self._last.echo)

    @property
    def last_is_nonzero(self) -> bool:
        """Whether the last command was not zero, even if it arrived long ago."""
        return self._asked_ns is not None


class CommandSigner:
    def __init__(self, sender_id: str) -> None:
        self._id, self._sequence, self._newest_ns = sender_id, 0, 0

    def sign(self, stamp_ns: Ns | None, echo: Beat | None, *, zero: bool = False) -> Signature:
        """Return the signature of the next command, with its sequence number.

        A zero gets a later stamp of this sender, so that it is not refused as older.
        """
        self._sequence += 1
        # The daemon refuses a command whose stamp is older than that of an earlier command. If a
        # sender uses two sources, its commands may be signed in another order than their stamps.
        if stamp_ns is not None:
            newest_ns = max(stamp_ns, self._newest_ns)
            self._newest_ns, stamp_ns = newest_ns, newest_ns if zero else stamp_ns
        return Signature(self._id, stamp_ns, self._sequence, echo)


def objection(state: RobotState, source: str, sender: str) -> str:
    """Return why the robot does not follow a sender (by public name); "" if it does."""
    if state.mode in NEVER_DRIVING_MODES:
        return state.why
    ours = _entry(state, source)
    if ours is None:
        names = ", ".join(entry.name for entry in state.sources)
        return (
            f"{source} is not one of commands.sources: {names}; use one of these sources, or add "
            f"{source} to commands.sources in the robot's acsard.toml and restart the daemon"
        )
    if state.mode == "waiting":
        return state.why
    if ours.wait == "command":
        return (
            f"the daemon receives no command of source {source}; `acsard top` shows whether the "
            "daemon refuses commands"
        )
    if state.source != source:
        return ours.waits_for or state.why
    # The robot is `ready`: the zeros of this client arrive, but do not let it drive yet.
    if state.mode != "driving":
        return state.why
    if state.sender in ("", sender):
        return ""
    return (
        f"another program, {state.sender}, drives the robot as source {source}: end that program, "
        "or wait until it sends no commands"
    )


def must_release_key(state: RobotState, source: str) -> bool:
    """Return whether the operator must release a held key and press it again to drive.

    Otherwise the key would move the robot as soon as the mode allows it, or after a zero, which the
    operator may not expect.
    """
    ours = _entry(state, source)
    return not can_drive(state) or (ours is not None and ours.wait == "neutral")


def can_drive(state: RobotState) -> bool:
    """Return whether some command can move the robot in its present mode."""
    return state.mode not in NEVER_DRIVING_MODES and state.mode != "waiting"


def lacks_only_commands(state: RobotState, source: str) -> bool:
    """Return whether the robot would drive if the commands of this source reached the daemon."""
    ours = _entry(state, source)
    never = state.mode in (*NEVER_DRIVING_MODES, "waiting")
    return ours is not None and ours.wait == "command" and not never


def receives_commands(state: RobotState, source: str) -> bool:
    """Return whether the daemon receives commands of this source, even late ones."""
    ours = _entry(state, source)
    return ours is not None and ours.wait != "command"


def refuses_for_good(state: RobotState, source: str) -> bool:
    """Return whether waiting cannot help: no command moves the robot, or there is no source."""
    return state.mode in NEVER_DRIVING_MODES or _entry(state, source) is None


def _entry(state: RobotState, source: str) -> SourceState | None:
    return next((entry for entry in state.sources if entry.name == source), None)
