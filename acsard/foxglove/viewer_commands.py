"""Decodes one viewer's commands, and decides which of them go to the robot, and when.

This module is pure. A panel repeats its command while a button is held and is silent after the
release. Each message is sent at most once; nothing is repeated here. After a silence a zero is sent
first, because the daemon requires one from a sender that starts. The daemon itself judges how late
a message with a stamp is, but few messages carry one. Therefore a burst of messages after a silence
is discarded: a congested link or a stalled process held it back.

A viewer whose commands do not drive is informed why.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.config.settings import DriveConfig, JointsConfig
from acsard.drive.kinematics import Kinematics
from acsard.incoming.commands import STAMPED_TWISTS, TWISTS, Arrival, Receiver
from acsard.messages.encodings import DecodeError, encoding_name
from acsard.values import NS_PER_S, REST, Twist

SILENCE_NS = 3 * NS_PER_S // 10
"""Silence after which the robot has begun to brake; the default timeout of a source is 0.25 s."""

HEAP_NS = NS_PER_S // 25
"""Time within which a held-back burst arrives; a panel at 20 Hz does not send twice in it. Only the
first command after a silence waits this long."""

STALE_NS = NS_PER_S // 10
"""Age above which a command is discarded, because it no longer shows the operator's intention."""

DRIVES_NS = NS_PER_S // 2
"""Time after the last command with a speed for which a viewer counts as driving."""

LONGEST_NS = 10 * NS_PER_S
"""Longest possible timeout of a source. A viewer that was silent for longer does not drive any
more."""

SLOW_NS, SLOW_TIMES = 5 * NS_PER_S // 2, 3
"""Thresholds for a panel that publishes too seldom: this many messages in a row, each later than
`SILENCE_NS` but not later than `SLOW_NS`."""


class Wish(Struct, frozen=True):
    """A twist, and the time in ns that its sender stamped it with, or None without a stamp."""

    twist: Twist
    stamp_ns: int | None = None


class Hand:
    """The commands of one viewer; only the newest one waits."""

    def __init__(self) -> None:
        self.replaced = self.stale = 0
        """Counters of messages that were not sent: replaced by a newer one, or too late."""
        self._wish: Wish | None = None
        self._stamp_ns: int | None = None
        """Stamp of the last message."""
        self._came_ns = 0
        self._heard_ns: int | None = None
        self._lead = False
        self._hold_until_ns = 0
        self._heap = 0
        """Number of messages since the silence, until one is sent."""
        self._moved_ns: int | None = None
        """Time at which a speed was sent; None after a zero."""
        self._asked_ns: int | None = None
        """Time at which a speed was last requested; None after a zero."""
        self._slow = 0

    def take(self, wish: Wish, now_ns: int) -> None:
        """Take a message from the viewer."""
        silence = None if self._heard_ns is None else now_ns - self._heard_ns
        if silence is None or silence > SILENCE_NS:
            self._lead, self._hold_until_ns, self._heap = True, now_ns + HEAP_NS, 0
            self._slow = self._slow + 1 if silence is not None and silence <= SLOW_NS else 0
        else:
            self._slow = 0
        if now_ns < self._hold_until_ns:
            self._heap += 1
        if self._wish is not None:
            self.replaced += 1
        self._wish, self._stamp_ns = wish, wish.stamp_ns
        self._came_ns = self._heard_ns = now_ns
        self._asked_ns = None if wish.twist == REST else now_ns

    def due_ns(self) -> int | None:
        """Return the time at which `send` has a message, which may be in the past, or None."""
        if self._lead:
            return self._came_ns
        return None if self._wish is None else self._hold_until_ns

    def send(self, now_ns: int) -> Wish | None:
        """Return the message to send now, or None."""
        if self._lead:
            self._lead = False
            return self._zero(now_ns)
        if self._wish is None or now_ns < self._hold_until_ns:
            return None
        wish, self._wish = self._wish, None
        heap, self._heap = self._heap, 0
        if heap > 1 or now_ns - self._came_ns > STALE_NS:
            self.stale += 1
            return None
        self._moved_ns = None if wish.twist == REST else now_ns
        return wish

    def end(self, now_ns: int) -> Wish | None:
        """Release the robot; return a zero if it may still follow a speed of this viewer."""
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = self._asked_ns = None
        self._lead = False
        if moved_ns is None or now_ns - moved_ns > LONGEST_NS:
            return None
        return self._zero(now_ns)

    def _zero(self, now_ns: int) -> Wish:
        """Return a zero stamped by the viewer's clock.

        A stamp of another clock would look like a clock change.
        """
        if self._stamp_ns is None:
            return Wish(REST)
        return Wish(REST, self._stamp_ns + now_ns - self._came_ns)

    def drives(self, now_ns: int) -> bool:
        """Return whether the viewer asks for a speed."""
        return self._asked_ns is not None and now_ns - self._asked_ns <= DRIVES_NS

    def is_slow(self) -> bool:
        """Return whether the messages come so seldom that the robot stops in between."""
        return self._slow >= SLOW_TIMES


_receiver = Receiver(JointsConfig(), Kinematics(DriveConfig()))
"""Decoder for twists only. They depend on neither joints nor wheels, so the defaults are
sufficient."""


def encoding_of(encoding: str, schema_name: str) -> str:
    """Return the Zenoh encoding of a channel. Raises `DecodeError` if it cannot carry twists."""
    package, _, name = schema_name.partition("/")
    full = f"{package}/msg/{name.removeprefix('msg/')}"
    if full not in (TWISTS[0], STAMPED_TWISTS[0]):
        raise DecodeError("wrong_type", f"{schema_name or 'no type'} where {TWISTS[0]} is wanted")
    if encoding == "cdr":
        return f"{encoding_name('cdr')};{full}"
    if encoding == "json":
        return encoding_name("json")
    raise DecodeError("unknown_encoding", f"{encoding} where json or cdr is wanted")


def wish(encoding: str, payload: bytes) -> Wish:
    """Return the twist and the stamp of a message.

    It is decoded as the daemon decodes commands: accepted or refused as a whole. Raises
    `DecodeError` with the reason.
    """
    found = _receiver.command(Arrival("cmd/app", True, payload, encoding, 0, None, ""))
    return Wish(found.twist, found.stamp_ns)


OBJECTS_NS = NS_PER_S // 2
"""Delay before an objection is reported: the first 0.25 s of a new sender never drive, which is
normal."""


class Objections:
    """The objection to one viewer's commands."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self.told = ""
        """The objection that was reported and still holds, or ""."""

    def look(self, objection: str, now_ns: int) -> bool:
        """Process the current objection ("" for none); return whether `told` has changed."""
        if not objection:
            self._since_ns = None
            changed, self.told = bool(self.told), ""
            return changed
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns < OBJECTS_NS or objection == self.told:
            return False
        self.told = objection
        return True
