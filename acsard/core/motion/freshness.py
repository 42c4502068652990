"""Decides whether a stamped command is fresh, by two clocks that nobody has compared.

The arrival by our clock minus the stamp by the sender's clock is the delay plus an unknown offset.
The offset cancels out against the minimum of all delays: a command is stale if it took longer than
the minimum by more than its timeout, or if its stamp lies before that of an accepted command.

    new      the minimum is not known: the delays must stop falling first, as a backlog's never do
    known    the minimum is believed, until a proof of another one ends

There are two kinds of clocks. A *steady* clock is never adjusted: our client, tools and page say so
with `"steady": true`. Its command that looks late is late, and stays refused. A *foreign* clock may
be set or slewed, which looks like a delay. A new delay that has proved constant is believed; the
sender must return to neutral. What is forgiven in this way is bounded, because a congested network
looks the same: `FORGIVE_NS`, refilled by 1 s a minute. Stamps that go back, or stand, and do so for
more than one command show an adjustment that no network can cause, so it costs nothing. While the
sender pauses, its clock may be set by any amount. Arrivals are monotonic: our own wall clock may
step.
"""

from __future__ import annotations

from typing import Literal

from acsard.core.values import NS_PER_S, Command

DRIFT = 5000
"""The two clocks drift apart by less than one part in 5000, twice the error of a bad crystal."""

FORGET_NS = 250 * NS_PER_S
"""After a pause of this length the drift may be 50 ms, so the clock is new again. A pause shows in
the stamps; a network that holds everything back for as long leaves the clock known."""

KEEP_NS = 3600 * NS_PER_S
"""A clock that was silent for this time is forgotten, to save memory."""

EARLY_NS = NS_PER_S // 20
"""Delays that fall by more than this are not jitter: a backlog pours in, or the clock was set."""

WAVER_NS = NS_PER_S
"""Delays that rise by more than this are not jitter: the network held commands back."""

EVEN, CREPT = 200, 20
"""A proof allows the minimum of the delays to change by one part in this of the time it takes. The
halves of that time are compared, so the slopes are twice that: 1 %, or 10 % for a clock that crept
away, because NTP slews by up to 8.3 %."""

CREEP, JITTER_NS = 10, NS_PER_S // 200
"""A delay creeps if it changes from one command to the next by no more than one part in `CREEP` of
the time between them and `JITTER_NS`. Otherwise it jumps."""

LONGEST_PROOF_NS = 2 * NS_PER_S
"""A proof takes the timeout of the source, but no longer than this."""

JUMP_PROOF_NS = 3 * NS_PER_S // 2
"""A sender whose delay jumped must prove itself for this time. The jump is more likely a backlog
that arrives in bursts than a clock that was set."""

GAP_NS = 2 * NS_PER_S
"""A silence of this length ends a proof. A foreign clock may have been set by any amount while its
sender paused for this time, by its own stamps and by the arrivals. Numbers tell a pause from
commands that were lost."""

STANDS_NS = 10_000
"""Two stamps that are no further apart, of commands that did not arrive together, show a clock that
was set back by the time between the arrivals. Zenoh's own clock never goes back: it advances by a
fraction of a microsecond for each message until the wall clock has caught up."""

APART_NS = NS_PER_S // 500
"""Commands that arrive within this time of each other may have been sent together."""

TOGETHER_NS = NS_PER_S // 2000
"""Commands that arrive within this time of each other come out of one queue, the oldest first. A
check waits for the last of them. No sender may send more than 1000 commands a second."""

FORGIVE_NS, FORGIVE_RATE = NS_PER_S, 60
"""How much later a foreign clock may become without an adjustment that shows: 1 s, and 1 s more for
each minute."""

MAX_CLOCKS = 1024
"""Number of clocks that are remembered. The clock that was silent for longest is forgotten first.
Senders may use this many names within 0.05 s before one at 20 Hz is forgotten."""

State = Literal["new", "known"]
Verdict = Literal["fresh", "first", "unproven", "stale", "set"]
"""`fresh` counts. `unproven` does not count yet, nor does `first`, with which a proof begins.
`stale` does not count. `set` counts, but the sender must return to neutral."""


class _Proof:
    """A test that the delays have become constant, from one command on.

    The minimum of the first half of the proof time is compared with that of the second. Through
    jitter they differ. The proof of a clock that is known begins `again` with its second half.
    For a new clock the last eight halves are looked at instead, in four pairs. Their minima must
    differ by less than `EARLY_NS` and follow no trend: they fall while a backlog pours in, and rise
    while a queue grows.
    """

    def __init__(self, delay: int, at_ns: int, needed_ns: int, share: int, again: bool) -> None:
        self.least = self._first = self._half = delay
        self._length_ns, self._share, self._again = needed_ns // 2, share, again
        self._begun_ns = self._last_ns = at_ns
        self._halves: list[tuple[int, int]] = []
        """When each of the last halves began, and its minimum."""

    def add(self, delay: int, at_ns: int, timeout_ns: int) -> Literal["proven", "open", "failed"]:
        """Judge one more command; `failed` if the proof must begin again with it.

        A command later than the least by more than the timeout proves nothing about itself.
        """
        if not -EARLY_NS <= delay - self._first <= WAVER_NS:
            return "failed"
        proven = False
        if at_ns - self._begun_ns >= self._length_ns and at_ns - self._last_ns > TOGETHER_NS:
            self._halves.append((self._begun_ns, self._half))
            self._begun_ns += self._length_ns
            if at_ns - self._begun_ns >= self._length_ns:
                self._begun_ns = at_ns
            self._half = delay
            proven = self._constant(at_ns)
        self._half, self.least = min(self._half, delay), min(self.least, delay)
        self._last_ns = at_ns
        return "proven" if proven and delay - self.least <= timeout_ns else "open"

    def _constant(self, at_ns: int) -> bool:
        """Compare the halves that are over."""
        minima, count = [least for _, least in self._halves], len(self._halves)
        lasted = at_ns - self._halves[0][0]
        if count == 2:
            even = abs(minima[1] - minima[0]) <= lasted // self._share
            if self._again:
                del self._halves[0]
                if not even:
                    self.least = self._first = minima[1]
            return even
        if count < 8:
            return False
        del self._halves[0]
        pairs = [min(pair) for pair in zip(minima[::2], minima[1::2], strict=True)]
        spread, up = max(pairs) - min(pairs), sorted(pairs)
        trend = pairs in (up, up[::-1])
        return spread <= lasted // self._share or (spread <= EARLY_NS and not trend)


class _Clock:
    """One clock, judged by the commands that it stamped."""

    def __init__(self, at_ns: int) -> None:
        self.state: State = "new"
        self.at_ns = at_ns
        """Arrival of the last command."""
        self.forgiven_ns = 0
        """How much later the delays became by the last `set`, without an adjustment that shows."""
        self._stamp_ns = 0
        self._delay = 0
        self._number: int | None = None
        """Sequence number of the last command."""
        self._least = 0
        """The minimum of the believed delays, which rises with the drift."""
        self._early = 0
        """How much the minimum has fallen lately."""
        self._floor: int | None = None
        """Lowest delay of a steady clock, which rises with the drift; None for a foreign clock."""
        self._before: int | None = None
        """Delay before the first adjustment that showed since the clock was last prompt."""
        self._shown = 0
        """Sum of the visible clock adjustments since then, ns."""
        self._doubted: tuple[int, int, int] | None = None
        """An adjustment that the next command must confirm, because the network may have swapped
        or repeated a command: the delay before it, its amount, and the stamp before it."""
        self._paused = False
        """Its sender has paused since then, so any adjustment may have happened."""
        self._budget, self._budget_at_ns = FORGIVE_NS, at_ns
        self._proof: _Proof | None = None
        self._accepted: tuple[int, int] | None = None
        """Stamp and sequence number of the last accepted command."""

    @property
    def was_known(self) -> bool:
        """Whether a command of this clock was accepted, so that its floor and order are known.

        A proof that begins again does not change that.
        """
        return self._accepted is not None

    def judge(self, command: Command, stamp_ns: int, timeout_ns: int) -> Verdict:
        """Return the verdict on the next command of this clock."""
        at_ns, delay = command.arrived_ns, command.arrived_ns - stamp_ns
        silence, departed = at_ns - self.at_ns, stamp_ns - self._stamp_ns
        if silence > FORGET_NS and departed > FORGET_NS:
            self.state, self._proof, self._accepted, self._floor = "new", None, None, None
        if command.steady and self._later_than_lowest(delay, silence) > timeout_ns:
            verdict: Verdict = "stale"
        elif self.state == "new":
            verdict = self._prove(delay, at_ns, silence, timeout_ns)
        else:
            self._least += silence // DRIFT
            if not command.steady:
                self._look_for_adjustment(stamp_ns, silence, command.sequence)
            verdict = self._compare(delay, at_ns, silence, timeout_ns, command.steady)
        self.at_ns, self._stamp_ns, self._delay = at_ns, stamp_ns, delay
        self._number = command.sequence
        mark = stamp_ns, -1 if command.sequence is None else command.sequence
        if verdict == "fresh" and self._superseded(mark):
            return "stale"
        if verdict in ("fresh", "set"):
            self._accepted = mark
        return verdict

    def _superseded(self, mark: tuple[int, int]) -> bool:
        """Return whether a newer command was accepted. Without numbers, equal stamps pass."""
        last = self._accepted
        return last is not None and (mark < last or (mark == last and mark[1] >= 0))

    def _later_than_lowest(self, delay: int, silence: int) -> int:
        """Return how much later than the lowest delay a command of a steady clock came."""
        floor = delay if self._floor is None else self._floor + silence // DRIFT
        self._floor = min(floor, delay)
        return delay - self._floor

    def _look_for_adjustment(self, stamp_ns: int, silence: int, number: int | None) -> None:
        """Note a pause, or stamps that go back or stand, unless the numbers show a loss.

        Stamps that go back or stand count once the next command confirms it: its stamp goes back
        too, stands, or has still not caught up.
        """
        doubted, self._doubted = self._doubted, None
        if number is not None and self._number is not None and number != self._number + 1:
            return
        departed = stamp_ns - self._stamp_ns
        if doubted is not None and (departed <= STANDS_NS or stamp_ns <= doubted[2]):
            self._before = doubted[0] if self._before is None else self._before
            self._shown += doubted[1]
        if departed > GAP_NS and silence > GAP_NS:
            self._paused = True
        elif departed <= STANDS_NS and silence > APART_NS:
            self._doubted = self._delay, silence - departed, self._stamp_ns

    def _prove(self, delay: int, at_ns: int, silence: int, timeout_ns: int) -> Verdict:
        proof = self._proof
        if proof is not None and silence <= GAP_NS:
            sign = proof.add(delay, at_ns, timeout_ns)
            if sign == "proven":
                return self._believe(proof, "fresh")
            if sign == "open":
                return "unproven"
        needed_ns = min(timeout_ns, LONGEST_PROOF_NS)
        self._proof = _Proof(delay, at_ns, needed_ns, EVEN, again=False)
        return "first"

    def _compare(
        self, delay: int, at_ns: int, silence: int, timeout_ns: int, steady: bool
    ) -> Verdict:
        late = delay - self._least
        early = max(0, self._early - silence // CREEP) + max(0, -late)
        if late <= timeout_ns and early <= EARLY_NS:
            self._proof, self._early = None, early
            self._least = min(self._least, delay)
            self._forget_adjustments()
            return "fresh"
        if steady:  # the minimum was that of a backlog
            self.state, self._proof = "new", None
            return self._prove(delay, at_ns, silence, timeout_ns)
        proof, needed_ns, share = self._proof, min(timeout_ns, LONGEST_PROOF_NS), CREPT
        if proof is None:
            self._accrue(at_ns, FORGIVE_NS)
        elif silence <= GAP_NS:
            sign = proof.add(delay, at_ns, timeout_ns)
            if sign == "open":
                return "stale"
            if sign == "proven":
                return self._forgive(proof, at_ns)
        if proof or abs(delay - self._delay) > silence // CREEP + JITTER_NS:
            needed_ns, share = max(needed_ns, JUMP_PROOF_NS), EVEN
        self._proof = _Proof(delay, at_ns, needed_ns, share, again=True)
        return "stale"

    def _forgive(self, proof: _Proof, at_ns: int) -> Verdict:
        """Believe the proven delay if an adjustment showed or a pause hid it, or by the budget."""
        self._accrue(at_ns, FORGET_NS)
        hidden = proof.least - self._least
        if self._before is not None:
            hidden = min(hidden, max(self._before - self._least, hidden - self._shown))
        if hidden > self._budget and not self._paused:
            return "stale"
        self.forgiven_ns = max(0, hidden)
        self._budget = max(0, min(self._budget, FORGIVE_NS) - self.forgiven_ns)
        return self._believe(proof, "set")

    def _accrue(self, at_ns: int, most_ns: int) -> None:
        """Let the budget grow with the time. It has no limit while the clock is refused."""
        grown = (at_ns - self._budget_at_ns) // FORGIVE_RATE
        self._budget, self._budget_at_ns = min(self._budget + grown, most_ns), at_ns

    def _forget_adjustments(self) -> None:
        self._before, self._shown, self._doubted, self._paused = None, 0, None, False

    def _believe(self, proof: _Proof, verdict: Verdict) -> Verdict:
        self.state, self._least, self._proof = "known", proof.least, None
        self._early = 0
        self._forget_adjustments()
        return verdict


class Freshness:
    """The clocks of all senders that stamp their commands."""

    def __init__(self) -> None:
        self._clocks: dict[str, _Clock] = {}
        self._newcomers: dict[str, _Clock] = {}
        """Foreign clocks that were never believed. A silence ends their proof without a trace."""
        self._unproved: dict[str, _Clock] = {}
        """Steady clocks that were never believed. Their lowest delay holds from the first command
        on."""
        self._numbers: dict[str, tuple[int, int]] = {}
        """Number and arrival of the last command of each sender that numbers without stamps."""
        self.forgiven_ns = 0
        """How much later foreign clocks became in all, without an adjustment that shows, ns."""

    def judge(self, command: Command, timeout_ns: int) -> Verdict:
        """Return whether the command counts. Without a stamp it is as old as its arrival."""
        if command.stamp_ns is None:
            return self._in_order(command)
        name, at_ns = command.clock or command.source, command.arrived_ns
        clock = None
        for held in (self._clocks, self._newcomers, self._unproved):
            clock = clock or held.pop(name, None)
        clock = clock or _Clock(at_ns)
        verdict = clock.judge(command, command.stamp_ns, timeout_ns)
        if verdict == "set":
            self.forgiven_ns += clock.forgiven_ns
        held = self._unproved if command.steady else self._newcomers
        if clock.was_known:
            held = self._clocks
        held[name] = clock
        self._forget(at_ns)
        return verdict

    def _in_order(self, command: Command) -> Verdict:
        """Judge a command without a stamp by its number. A sender that paused may start again."""
        number, at_ns = command.sequence, command.arrived_ns
        if number is None:
            return "fresh"
        last = self._numbers.pop(command.sender, None)
        if last is not None and number <= last[0] and at_ns - last[1] <= GAP_NS:
            self._numbers[command.sender] = last
            return "stale"
        self._numbers[command.sender] = number, at_ns
        if len(self._numbers) > MAX_CLOCKS:
            del self._numbers[next(iter(self._numbers))]
        return "fresh"

    def _forget(self, now_ns: int) -> None:
        """Forget the clocks that were silent for long, and any above the limit.

        Above the limit, the first to go is a silent clock that was never believed.
        A recording begins with all clocks, which the loop writes in one step.
        """
        limits = (self._newcomers, GAP_NS), (self._unproved, KEEP_NS), (self._clocks, KEEP_NS)
        for held, silent_ns in limits:
            while held and now_ns - _oldest(held).at_ns > silent_ns:
                del held[next(iter(held))]
        some = [held for held, _ in limits if held]
        if sum(map(len, some)) > MAX_CLOCKS:
            held = min(some, key=lambda clocks: _oldest(clocks).at_ns)
            if self._unproved and now_ns - _oldest(self._unproved).at_ns > GAP_NS:
                held = self._unproved
            del held[next(iter(held))]


def _oldest(held: dict[str, _Clock]) -> _Clock:
    """Return the clock that was silent for longest: each command moves its clock to the end."""
    return next(iter(held.values()))
