"""What one viewer asks for, and which of it goes to the robot when; pure.

A panel repeats what it asks for while a button is held, and falls silent when it is let go. Each
message goes once: nothing is repeated here. After a silence a zero goes first, as the daemon wants
of who begins. How late a message with a stamp is, the daemon judges. Few have one, but a heap of
them after a silence is what a link, or a process that stood, has held back: it is lived by nobody.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.values import NS_PER_S, REST, Twist

SILENCE_NS = 3 * NS_PER_S // 10
"""After so long the robot has begun to brake (a source's timeout is 0.25 s, by default)."""

HEAP_NS = NS_PER_S // 25
"""What was held back comes out within this: no panel sends twice in it at 20 Hz. Who begins to
drive waits for it, nobody else."""

STALE_NS = NS_PER_S // 10
"""What could not go for so long is not what the person wants now."""

DRIVES_NS = NS_PER_S // 2
"""Who asked for a speed so lately drives, or means to."""

LONGEST_NS = 10 * NS_PER_S
"""No timeout of a source is longer: who was silent for so long drives no more."""

SLOW_NS, SLOW_TIMES = 5 * NS_PER_S // 2, 3
"""Messages that so often come further apart than a silence, and no further than this, are of a
panel that publishes too seldom."""


class Wish(Struct, frozen=True):
    """A twist, and when it was meant by the clock of who meant it, ns; None where nothing says."""

    twist: Twist
    stamp_ns: int | None = None


class Hand:
    """The commands of one viewer: of those that wait, the newest."""

    def __init__(self) -> None:
        self.replaced = self.stale = 0
        """Messages that did not go: a newer one came, or it was too late for them."""
        self._wish: Wish | None = None
        self._stamp_ns: int | None = None
        """Of the last that came."""
        self._came_ns = 0
        self._heard_ns: int | None = None
        self._lead = False
        self._hold_until_ns = 0
        self._heap = 0
        """Messages since the silence, until one goes."""
        self._moved_ns: int | None = None
        """When a speed went, and no zero since."""
        self._asked_ns: int | None = None
        """When a speed was last asked for, and no zero since."""
        self._slow = 0

    def take(self, wish: Wish, now_ns: int) -> None:
        """One has come."""
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
        """When `send` has something to send: at once for what is past; None for never."""
        if self._lead:
            return self._came_ns
        return None if self._wish is None else self._hold_until_ns

    def send(self, now_ns: int) -> Wish | None:
        """What to send now; None for nothing."""
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
        """The viewer lets go: a zero if a speed of his may still be followed."""
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = self._asked_ns = None
        self._lead = False
        if moved_ns is None or now_ns - moved_ns > LONGEST_NS:
            return None
        return self._zero(now_ns)

    def _zero(self, now_ns: int) -> Wish:
        """One of ours, by his clock: another's would look as if his had been set."""
        if self._stamp_ns is None:
            return Wish(REST)
        return Wish(REST, self._stamp_ns + now_ns - self._came_ns)

    def drives(self, now_ns: int) -> bool:
        """He asks for a speed."""
        return self._asked_ns is not None and now_ns - self._asked_ns <= DRIVES_NS

    def is_slow(self) -> bool:
        """The robot stops between his messages."""
        return self._slow >= SLOW_TIMES
