"""Assigns each reply of a prompted board to the command line that it answers.

A plain reply does not name its line. But a board that answers each line samples at that moment, so
the times at which the lines left are the sample times. Two replies are as far apart as their lines,
whenever the host reads them, and where no line left no reply is missing.

Replies come in the order of the lines. If a reply is later than usual by more than half the
distance from its line to the next one, it answers that next line and the reply before it was lost.
"""

from __future__ import annotations

from collections import deque

from msgspec import Struct

from acsard.core.values import NS_PER_S

MEMORY = 64
"""Lines that are remembered because their replies may still come."""

GAIN = 0.05
"""Gain per reply or read of the filters for the usual delay, its spread and the batches."""

SLOW = 0.0125
"""Gain per read of the slower filter that decides whether the spread is the board's."""

LEAST = 0.002
"""Gain per reply with which the least delay is forgotten: a time constant of 500 replies."""

RARE = 0.002
"""Share of lost replies. Below it, a line that another one follows closely does not count as
lost."""

JITTER_NS = 350_000
"""Mean deviation that USB and the scheduler add to a constant delay, ns."""

THOUGHT_NS = 800_000
"""Mean deviation that USB and the scheduler rarely cause, ns. Above it, the board's delay
varies."""

RISE_NS = 20_000
"""Rise of a batched link's least delay per read, by which the link forgets it, ns."""

LOSING = 0.005
"""Gain per read of the share of lost replies. It is slow, because over 20 reads two lost replies
would already make it 3 %."""

MOST_LOST = 0.03
"""Share of lost replies on a batched link. Above it, any line may lack its reply."""

SEVERAL = 0.15
"""Share of the reads that hold several lines. Above it, an adapter batches lines; host stalls alone
cause fewer."""

THINKS = 0.6
"""Filtered share of the reads with a varying delay. Above it, the variation is the board's own. An
adapter that is filled line by line causes it too, but only for a quarter of a second."""

BATCH_NS = 2_000_000
"""Mean deviation that no board causes, ns: an adapter holds the lines back."""


class Answered(Struct, frozen=True, gc=False):
    """The time between a reply's line and the line of the reply before it.

    `dt` is that time in s, None for a first reply. For `bridged` s of it no reply came. `due_ns` is
    the monotonic time at which the reply should be complete.
    """

    dt: float | None
    bridged: float
    due_ns: int


class Prompts:
    """The lines that left, matched with the replies.

    Call `read` for each read and then `answer` or `skip` for each of its lines.
    """

    def __init__(self, soonest_ns: int) -> None:
        """Start; `soonest_ns` is the wire time of a line and its reply."""
        self._soonest = soonest_ns
        self._left: deque[int] = deque(maxlen=MEMORY)
        self.forget()

    def forget(self) -> None:
        """Forget all lines: they are answered or will never be."""
        self._left.clear()
        self._delay: float | None = None
        self._spread = self._least = 0.0
        """Mean deviation of the usual delay, and the least delay; both ns."""
        self._made: int | None = None
        self._apart = self._missing = 0.0
        """Time at which the last line was made, usual distance of two lines, share of lost
        replies."""
        self._last: int | None = None
        """Time of the line that was answered last, plus the excess of its reply over the usual
        delay, ns."""
        self._passed = self._line = 0
        """Times of the last line that is answered or given up, and of the last that is answered."""
        self._lost = False
        """Whether the last lone reply made the code give up the line before its own."""
        self._at, self._alone = 0, False
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        """For a batched link: least delay and usual distance of two reads, both ns, and share of
        lost replies."""
        self._several = 0.0
        """Share of the reads that hold several lines."""
        self._thinking = 0.0
        """Filtered share of the reads in which the delay varied more than a scheduler or an adapter
        causes."""

    @property
    def thinks(self) -> bool:
        """Whether the board's own delay varies, more than a scheduler or an adapter causes."""
        return self._thinking > THINKS and not self._batched

    @property
    def lossy(self) -> bool:
        """Whether replies get lost on a batched link. There no clock of slots can be found."""
        return self._batched and self._losses > MOST_LOST

    @property
    def _batched(self) -> bool:
        """Whether an adapter holds replies back, so that one read brings several."""
        return self._several > SEVERAL

    def left(self, made_ns: int) -> None:
        """Note that a line left that was made at `made_ns`."""
        if self._made is not None:
            apart, usual = made_ns - self._made, self._apart
            self._apart = usual + GAIN * (min(apart, 2 * usual) - usual) if usual else apart
        self._made = made_ns
        self._left.append(made_ns)

    def read(self, at_ns: int, lines: int) -> None:
        """Take a read of `lines` lines, of which the last was complete at `at_ns`.

        The delay of a lone reply shows which line it answers. So does the delay of a batch if it is
        longer than the adapter ever holds a reply back.
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
        """Return the time of the next reply's line, or None if no line waits for a reply.

        `asked_ns` is when the line was made, if the reply names its line.
        """
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
        """Note that the next reply was damaged."""
        if self._left:
            self._passed = self._left.popleft()

    def _begin(self) -> None:
        """Assign the first reply to the newest line that it can answer.

        Only the wire time of a reply is known yet.
        """
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._delay = self._least = float(self._at - left[0])

    def _weigh(self, lines: int, since: int) -> None:
        """Give up lines for which the last reply of a batch is too late.

        `since` is the time since the read before, ns.
        If many replies are lost, the first reply of the batch decides instead, because it was made
        after the batch before.
        """
        left, at = self._left, self._at
        judged, soonest = lines - 1, float(self._soonest)
        if self.lossy:
            judged, soonest = 0, max(soonest, self._base - JITTER_NS)
        if since < 1.5 * self._batch:
            self._batch += GAIN * (since - self._batch)
        if len(left) < lines or self._delay is None:
            return
        if at - left[lines - 1] < self._soonest:  # too soon for a reply: it answers the line before
            left.appendleft(self._passed)
            self._base = float(at - left[lines - 1])
        lost = 0
        while len(left) > lines:
            late = at - left[judged] - self._base
            if late <= self._batch + 2 * JITTER_NS or at - left[lines] < soonest:
                break
            self._passed, lost = left.popleft(), lost + 1
        self._losses += LOSING * (lost / (lines + lost) - self._losses)
        # Giving up a line too late makes a reply look late, but nothing makes one look early. The
        # base is therefore the least delay, and it rises slowly.
        self._base = min(self._base + RISE_NS, at - left[lines - 1])
        self._delay = self._base

    def _given_up_too_early(self, delay: float) -> bool:
        """Return whether the line given up last was not lost.

        If it was, give up the lines lost now.
        """
        left, at, wide = self._left, self._at, 4 * self._spread
        lost, self._lost = self._lost, False
        self._missing -= LOSING * self._missing
        # No reply comes sooner than the least delay. One that seems to is a late reply to the line
        # before.
        soonest = max(self._soonest, self._least)
        while len(left) > 1:
            apart = left[1] - left[0]
            if at - left[0] - delay <= max(apart / 2, wide) or at - left[1] < soonest:
                break
            # After a host stall two lines leave at once and the reply to the first one is late, but
            # not so late that the reply to the second one should have been read too.
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
        """Return the excess of a lone reply's delay over the usual, ns, and update the usual.

        Return 0 if the delay varies no more than the time of a read does by itself, or if an
        adapter causes the variation.
        """
        delay, spread = self._delay, self._spread
        if delay is None or self._batched:
            return 0
        error = self._at - line - delay
        if abs(error) >= max(delay, 4 * spread):
            return 0  # a host stall
        self._delay = delay + GAIN * error
        self._least = min(self._least + LEAST * (delay - self._least), delay + error)
        self._spread += GAIN * (abs(error) - spread)
        if not JITTER_NS < spread < BATCH_NS or abs(error) > 4 * spread:
            return 0
        return int(error * (1 - (JITTER_NS / spread) ** 2))
