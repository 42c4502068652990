"""Which line of ours a reply answers, where the reply does not say: the lines that left in order.

An MCU that answers each line makes its report then, so the lines that left are its clock: a reply
is as far from the one before as the lines are apart that they answer, whenever they are read, and
where no line left nothing is missing. Replies come in the order of the lines. One that comes later
than usual by more than half of what its line is apart from the next belongs to that next one, and
its own is lost.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.values import NS_PER_S

MEMORY = 64
"""Lines whose answers may still come."""

GAIN = 0.05
"""How quickly the usual delay and its spread follow."""

SLOW = 0.0125
"""How quickly it shows whose that spread is."""

LEAST = 0.002
"""How quickly the least delay is forgotten: in 500 answers."""

RARE = 0.002
"""Share of answers lost, below which of two lines close to each other none is taken to be."""

JITTER_NS = 350_000
"""What USB and the scheduler make of a constant delay: its mean deviation."""

THOUGHT_NS = 800_000
"""A mean deviation that USB and the scheduler hardly make."""

RISE_NS = 20_000
"""By which a batched link's least delay is forgotten, read by read."""

LOSING = 0.005
"""How quickly the share of lost answers follows: in 20 reads two lost ones would make it 3 %."""

MOST_LOST = 0.03
"""Share of answers lost on a batched link, from which on any line may be without one."""

SEVERAL = 0.15
"""Share of the reads that have several lines; more are an adapter's, and not of stalls alone."""

THINKS = 0.6
"""Share of the late reads whose spread is that, from which on it is the MCU's own: an adapter that
is filled line by line makes it too, for a quarter of a second."""

BATCH_NS = 2_000_000
"""A mean deviation that no MCU makes: an adapter holds the lines back."""


class Answered(Struct, frozen=True, gc=False):
    """How a reply's line is apart from that of the reply before it; None for a first one.

    In s; `bridged` of it are without a reply. `due_ns` is when the reply should be complete.
    """

    dt: float | None
    bridged: float
    due_ns: int


class Prompts:
    """Remembers the lines that left; `read` and then `answer` for each of its lines."""

    def __init__(self, soonest_ns: int) -> None:
        """`soonest_ns` is what a line and its answer take on the wire alone."""
        self._soonest = soonest_ns
        self._left: deque[int] = deque(maxlen=MEMORY)
        self.forget()

    def forget(self) -> None:
        """What was sent until now is answered, or nobody will."""
        self._left.clear()
        self._delay: float | None = None
        self._spread = self._least = 0.0
        """The usual delay's mean deviation; the least one, ns."""
        self._made: int | None = None
        self._apart = self._missing = 0.0
        """When the last line left, how far two usually are apart, the share of answers lost."""
        self._last: int | None = None
        """When the line left that was answered last, and what its answer took beyond the usual."""
        self._passed = self._line = 0
        """The last line that is answered or given up, and the last that is answered."""
        self._lost = False
        """The last lone answer made us give up the line before its own."""
        self._at, self._alone = 0, False
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        """Of a batched link: the least delay, ns, between two reads, and the share of the lost."""
        self._several = 0.0
        """Share of the reads that have several lines."""
        self._thinking = 0.0
        """Share of the reads in which the answers' delay varied as neither makes it."""

    @property
    def thinks(self) -> bool:
        """The answers' delay varies as no scheduler makes it, nor an adapter: it is the MCU's."""
        return self._thinking > THINKS and not self._batched

    @property
    def lossy(self) -> bool:
        """Answers get lost on a batched link, where no clock of slots is to be found."""
        return self._batched and self._losses > MOST_LOST

    @property
    def _batched(self) -> bool:
        """An adapter holds answers back, so that several come in one read."""
        return self._several > SEVERAL

    def left(self, made_ns: int) -> None:
        """A line has left that was made then."""
        if self._made is not None:
            apart, usual = made_ns - self._made, self._apart
            self._apart = usual + GAIN * (min(apart, 2 * usual) - usual) if usual else apart
        self._made = made_ns
        self._left.append(made_ns)

    def read(self, at_ns: int, lines: int) -> None:
        """A read of so many lines, the last of them complete then.

        A lone one tells which line of ours it answers; so do several, where an adapter holds
        them back and that one came later than it ever does.
        """
        alone, since = lines == 1, at_ns - self._at
        self._at, self._alone = at_ns, alone
        self._several += GAIN * ((not alone) - self._several)
        varies = THOUGHT_NS < self._spread < BATCH_NS and not self._batched
        self._thinking += SLOW * (varies - self._thinking)
        if self._batched:
            self._weigh(lines, since)
        elif self._delay is not None:
            self._base, self._losses = self._delay, 0.0

    def answer(self, asked_ns: int | None = None) -> Answered | None:
        """The next reply's line; made `asked_ns` if the reply says so. None if no line waits."""
        left = self._left
        if asked_ns is not None:
            while left and left[0] < asked_ns:
                self._passed = left.popleft()
            if left and left[0] == asked_ns:
                left.popleft()
            return self._answered(asked_ns)
        if self._delay is None:
            self._begin()
        elif self._alone and not self._batched and self._given_up_too_early(self._delay):
            return self._answered(self._passed)
        if not left:
            self._last = None
            return None
        return self._answered(left.popleft())

    def _answered(self, line: int) -> Answered:
        last, before = self._last, self._passed
        lost, self._passed, self._line = before > self._line, line, line
        at = line + (self._shift(line) if self._alone else 0)
        self._last = at if last is None else max(last, at)
        due_ns = at + int(self._delay or self._soonest)
        if last is None:
            return Answered(None, 0.0, due_ns)
        dt = self._last - last
        bridged = min(max(0, before - last), dt) if lost else 0
        return Answered(dt / NS_PER_S, bridged / NS_PER_S, due_ns)

    def skip(self) -> None:
        """The next reply came damaged."""
        if self._left:
            self._passed = self._left.popleft()

    def _begin(self) -> None:
        """Of a first reply only what the wire takes is known: it answers the newest it can."""
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._delay = self._least = float(self._at - left[0])

    def _weigh(self, lines: int, since: int) -> None:
        """Give up lines that a batch's last answer is too late for, `since` the read before.

        Where many are lost, its first answer too: it came with the batch after it was made.
        """
        left, at = self._left, self._at
        judged, soonest = lines - 1, float(self._soonest)
        if self.lossy:
            judged, soonest = 0, max(soonest, self._base - JITTER_NS)
        if since < 1.5 * self._batch:
            self._batch += GAIN * (since - self._batch)
        if len(left) < lines or self._delay is None:
            return
        if at - left[lines - 1] < self._soonest:  # no answer is so soon: it is the one before's
            left.appendleft(self._passed)
            self._base = float(at - left[lines - 1])
        lost = 0
        while len(left) > lines:
            late = at - left[judged] - self._base
            if late <= self._batch + 2 * JITTER_NS or at - left[lines] < soonest:
                break
            self._passed, lost = left.popleft(), lost + 1
        self._losses += LOSING * (lost / (lines + lost) - self._losses)
        # A line that is given up too late makes an answer later, none makes it earlier.
        self._base = min(self._base + RISE_NS, at - left[lines - 1])
        self._delay = self._base

    def _given_up_too_early(self, delay: float) -> bool:
        """The line that was given up last was not lost; else gives up those that are now."""
        left, at, wide = self._left, self._at, 4 * self._spread
        lost, self._lost = self._lost, False
        self._missing -= LOSING * self._missing
        # No answer comes sooner than any ever does: then it is a late one of the line before.
        soonest = max(self._soonest, self._least)
        while len(left) > 1:
            apart = left[1] - left[0]
            if at - left[0] - delay <= max(apart / 2, wide) or at - left[1] < soonest:
                break
            # Behind a stall two lines leave at once, and the first one's answer is late; but not so
            # late that the second one's ought to be read by then.
            overdue = at - left[1] - delay > max(self._apart / 2, wide)
            close = apart < self._apart / 2 and not overdue
            if close and self._missing < RARE:
                break
            self._passed, self._lost = left.popleft(), True
            self._missing += LOSING * (not close)
        if not lost or not left:
            return lost
        return at - left[0] - delay <= -max((left[0] - self._passed) / 2, wide)

    def _shift(self, line: int) -> int:
        """How much beyond the usual the MCU took over a lone answer, ns; follows the usual too.

        Of a delay that varies no more than a read's time does by itself nothing is the MCU's, and
        of one that an adapter makes neither.
        """
        delay, spread = self._delay, self._spread
        if delay is None or self._batched:
            return 0
        error = self._at - line - delay
        if abs(error) >= max(delay, 4 * spread):
            return 0  # a stall
        self._delay = delay + GAIN * error
        self._least = min(self._least + LEAST * (delay - self._least), delay + error)
        self._spread += GAIN * (abs(error) - spread)
        if not JITTER_NS < spread < BATCH_NS or abs(error) > 4 * spread:
            return 0
        return int(error * (1 - (JITTER_NS / spread) ** 2))
