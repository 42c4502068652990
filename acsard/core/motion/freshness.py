"""Decides whether a stamped command is fresh, although the sender's clock is not synchronized.

A delay is arrival minus stamp: the true delay plus an unknown offset, which the minimum of all
delays cancels. A command is stale if its delay exceeds the minimum by more than the source's
timeout, or if an accepted one has a later stamp. A new sender does not drive until its delays are
constant. A delay that changes later is a clock that was set or a congested network, which may look
the same, so it is trusted only within limits. The comment below gives the rules.
"""

from __future__ import annotations

from typing import Literal

from acsard.core.values import NS_PER_S, Command, Ns

# The clock of a sender is in one of two states:
#
#     new      The minimum is not known. Delays fall while a backlog arrives. Therefore a test of
#              several commands (the proof) must first show that the delays no longer fall.
#     known    The minimum is trusted until a proof shows another minimum.
#
# There are two kinds of clocks. A *steady* clock is never adjusted. The client, the tools and the
# web page of acsard declare a steady clock with `"steady": true`. If a command with such a stamp
# looks late, the command is really late, and it stays refused.
#
# A *foreign* clock may be set or slewed, which looks like a change of the delay. If the new delay
# proves constant, it is trusted, and the sender must send a zero again. A congested network can
# look the same. Therefore the sum of the rises of the delay that are trusted in this way is bounded
# by a budget: `FORGIVE_NS`, refilled by 1 s a minute. If the stamps of more than one command go
# back or stand still, the adjustment of the clock is visible and costs no budget, because no
# network can cause that. After a pause of the sender (`MAX_PAUSE_NS`), a rise is trusted even
# beyond the budget, because the clock may have been set by any amount.
#
# Sequence numbers show which commands the network lost, repeated or delivered in another order.
# Lost commands do not count as a pause, and a repeated command changes nothing.
#
# Times of arrival are measured by the monotonic clock, because the daemon's own wall clock may be
# set.

# Two clocks drift apart by 1 s in this time. A bad crystal takes twice as long.
SECONDS_PER_DRIFT = 5000

# Pause in which a clock may have drifted by 50 ms, so that it is new. If the stamps do not show the
# pause, the network held commands back, and the clock stays known.
FORGET_NS = 250 * NS_PER_S

MEMORY_NS = 3600 * NS_PER_S  # silence after which a clock is forgotten to save memory

# Largest decrease of the delay that is jitter; a larger one ends a backlog, or a clock was set.
MAX_JITTER_NS = NS_PER_S // 20

# Largest increase that is jitter; after a larger one, the network has held commands back.
MAX_RISE_NS = NS_PER_S

# The least delays of the halves of a proof may differ by its duration over this: 10 ms per second,
# or 100 ms if the delay creeps. NTP slews a clock by up to 83 ms per second.
EVEN_DIVISOR, CREEP_DIVISOR = 200, 20

# A delay creeps if it changes by at most the distance of two commands over `CREEP`, plus
# `JITTER_NS`. Otherwise it jumps.
CREEP, JITTER_NS = 10, NS_PER_S // 200

MAX_PROOF_NS = 2 * NS_PER_S  # nominal duration, unless the source's timeout is shorter

# Shortest proof after a jump, which is more likely a backlog in bursts than a clock that was set.
JUMP_PROOF_NS = 3 * NS_PER_S // 2

# Silence that is a pause, if the timeout is not longer. It ends a proof. If the stamps show it, a
# foreign clock (one that may be adjusted) may have been set by any amount in it.
MAX_PAUSE_NS = 2 * NS_PER_S

# If commands more than `SEPARATE_NS` apart have stamps closer than this, the clock was set back.
# Zenoh's clock never goes back, but then advances by a fraction of a microsecond per message.
MAX_STOPPED_STAMP_NS = 10_000

SEPARATE_NS = NS_PER_S // 500  # commands this close may have been sent together

# Commands this close come from one queue: no sender may exceed 1000 Hz. The last one has the least
# delay, so a proof waits for it.
SAME_QUEUE_NS = NS_PER_S // 2000

# Budget of trusted increases without a visible adjustment, for foreign clocks: refilled by 1 s in
# 60 s, and above this while commands are late, so that no sender is refused forever.
FORGIVE_NS, FORGIVE_RATE = NS_PER_S, 60

# To push out a sender at 20 Hz, a client would need this number of names in 0.05 s.
MAX_CLOCKS = 1024

State = Literal["new", "known"]
# first: begins the test of a new clock. unproven: the test is not over. Neither drives. set:
# accepted, but the clock seems to have been set, so the sender must send a zero.
Verdict = Literal["fresh", "first", "unproven", "stale", "set"]


class _Proof:
    # Tests whether the delays of a clock are constant: the least delays of successive halves agree.
    def __init__(
        self, delay: int, at_ns: Ns, timeout_ns: Ns, needed_ns: Ns, share: int, again: bool
    ) -> None:
        self.timeout_ns = timeout_ns  # of the source whose command began the test
        self.least = self._first = self._half = delay
        self._length_ns, self._share, self._again = needed_ns // 2, share, again
        self._begun_ns = self.last_ns = at_ns
        self._halves: list[tuple[int, int]] = []  # start and least delay of the last halves

    def add(self, delay: int, at_ns: Ns, timeout_ns: Ns) -> Literal["proven", "open", "failed"]:
        """Add a command, and return the state of the test; "failed" begins a new one with it."""
        if not -MAX_JITTER_NS <= delay - self._first <= MAX_RISE_NS:
            return "failed"
        proven = False
        if at_ns - self._begun_ns >= self._length_ns and at_ns - self.last_ns > SAME_QUEUE_NS:
            self._halves.append((self._begun_ns, self._half))
            self._begun_ns += self._length_ns
            if at_ns - self._begun_ns >= self._length_ns:
                self._begun_ns = at_ns
            self._half = delay
            proven = self._constant(at_ns)
        self._half, self.least = min(self._half, delay), min(self.least, delay)
        self.last_ns = at_ns
        return "proven" if proven and delay - self.least <= timeout_ns else "open"

    def _constant(self, at_ns: Ns) -> bool:
        minima, count = [least for _, least in self._halves], len(self._halves)
        lasted = at_ns - self._halves[0][0]
        if count == 2:
            even = abs(minima[1] - minima[0]) <= lasted // self._share
            # The test of a known clock restarts, and its second half becomes the first one.
            if self._again:
                del self._halves[0]
                if not even:
                    self.least = self._first = minima[1]
            return even
        # The minima of the last eight halves in four pairs must agree within the same limit, or
        # differ by at most `MAX_JITTER_NS` without a trend: a backlog falls, a queue rises.
        if count < 8:
            return False
        del self._halves[0]
        pairs = [min(pair) for pair in zip(minima[::2], minima[1::2], strict=True)]
        spread, up = max(pairs) - min(pairs), sorted(pairs)
        trend = pairs in (up, up[::-1])
        return spread <= lasted // self._share or (spread <= MAX_JITTER_NS and not trend)


class _Clock:
    def __init__(self, at_ns: Ns) -> None:
        self.state: State = "new"
        self.at_ns = at_ns  # arrival of its last command that was no repetition
        self.gap_ns = MAX_PAUSE_NS  # longest silence that is no pause: its longest timeout
        self.forgiven_ns = 0  # last trusted increase, less visible adjustments
        self._stamp_ns = 0
        self._delay = 0
        self._number = -1  # of the last command; -1 without one
        self._least = 0  # minimum of the trusted delays; it rises by the largest drift
        self._early = 0  # recent decreases of `_least`; falls by 1 ns each 10 ns
        self._floor: int | None = None  # lowest delay of a steady clock; it rises by the drift
        self._before: int | None = None  # delay before the first visible adjustment
        self._shown = 0  # sum of these adjustments
        # An adjustment that the next command must confirm: delay before it, size, stamp before it.
        self._doubted: tuple[int, int, int] | None = None
        self._paused = False  # since the last command in time, so the clock may have been set
        self._budget, self._budget_at_ns = FORGIVE_NS, at_ns
        self._proof: _Proof | None = None
        self._accepted: tuple[int, int] | None = None  # stamp, and number or -1

    @property
    def was_known(self) -> bool:
        """Whether a command of this clock was accepted since its last pause over `FORGET_NS`."""
        return self._accepted is not None

    def judge(self, command: Command, stamp_ns: Ns, timeout_ns: Ns) -> Verdict:
        at_ns, delay = command.arrived_ns, command.arrived_ns - stamp_ns
        silence, departed = at_ns - self.at_ns, stamp_ns - self._stamp_ns
        number = -1 if command.sequence is None else command.sequence
        self.gap_ns = max(self.gap_ns, timeout_ns)
        if self._repeats(stamp_ns, number, silence):
            return "stale"
        if silence > FORGET_NS and departed > FORGET_NS:
            self.state, self._proof, self._accepted, self._floor = "new", None, None, None
        if command.steady and self._later_than_lowest(delay, silence) > timeout_ns:
            verdict: Verdict = "stale"
        elif self.state == "new":
            verdict = self._prove(delay, at_ns, silence, timeout_ns)
        else:
            self._least += silence // SECONDS_PER_DRIFT
            if not command.steady:
                self._look_for_adjustment(stamp_ns, silence, number)
            verdict = self._compare(delay, at_ns, silence, timeout_ns, command.steady)
        self.at_ns, self._stamp_ns, self._delay, self._number = at_ns, stamp_ns, delay, number
        mark = stamp_ns, number
        if verdict == "fresh" and self._already_accepted(mark):
            return "stale"
        if verdict in ("fresh", "set"):
            self._accepted = mark
        return verdict

    def _already_accepted(self, mark: tuple[int, int]) -> bool:
        # `mark` is stamp and number (-1: none); only a number shows a repetition.
        last = self._accepted
        return last is not None and (mark < last or (mark == last and mark[1] >= 0))

    def _repeats(self, stamp_ns: Ns, number: int, silence: int) -> bool:
        # A low number may also be a restart of the sender: after a pause, or with a stamp later
        # than both the previous and the last accepted one.
        if not 0 <= number <= self._number or silence > self.gap_ns:
            return False
        accepted = self._accepted
        return stamp_ns <= self._stamp_ns or (accepted is not None and stamp_ns <= accepted[0])

    def _later_than_lowest(self, delay: int, silence: int) -> int:
        floor = delay if self._floor is None else self._floor + silence // SECONDS_PER_DRIFT
        self._floor = min(floor, delay)
        return delay - self._floor

    def _look_for_adjustment(self, stamp_ns: Ns, silence: int, number: int) -> None:
        # A stamp that is not later than the previous one is a clock set back, or swapped commands.
        # The next command must confirm it: not later than its predecessor either, or than the last
        # stamp before. If commands were lost, no pause counts: the network may be the cause.
        lost = number - self._number - 1 if number >= 0 and self._number >= 0 else 0
        if lost < 0:  # the sender has restarted its numbers
            return
        departed, accepted = stamp_ns - self._stamp_ns, self._accepted
        doubted, self._doubted = self._doubted, None
        if doubted is not None and (departed <= MAX_STOPPED_STAMP_NS or stamp_ns <= doubted[2]):
            self._before = doubted[0] if self._before is None else self._before
            self._shown += doubted[1]
        if lost and accepted is not None:
            back = accepted[0] - stamp_ns - self._shown
            if back > 0 and accepted[1] >= 0:
                self._doubted = self._delay, back, accepted[0]
        elif departed > self.gap_ns and silence > self.gap_ns:
            self._paused = True
        elif departed <= MAX_STOPPED_STAMP_NS and silence > SEPARATE_NS:
            self._doubted = self._delay, silence - departed, self._stamp_ns

    def _prove(self, delay: int, at_ns: Ns, silence: int, timeout_ns: Ns) -> Verdict:
        proof = self._proof
        if proof is not None and silence <= self.gap_ns:
            sign = proof.add(delay, at_ns, timeout_ns)
            if sign == "proven":
                self._trust(proof)
                return "fresh"
            if sign == "open":
                return "unproven"
        needed_ns = min(timeout_ns, MAX_PROOF_NS)
        self._proof = _Proof(delay, at_ns, timeout_ns, needed_ns, EVEN_DIVISOR, again=False)
        return "first"

    def _compare(
        self, delay: int, at_ns: Ns, silence: int, timeout_ns: Ns, steady: bool
    ) -> Verdict:
        late = delay - self._least
        early = max(0, self._early - silence // CREEP) + max(0, -late)
        proof = self._proof
        if late <= timeout_ns and early <= MAX_JITTER_NS:
            self._paused = False
            if proof is not None and late > proof.timeout_ns:
                # This source has a longer timeout than the source whose commands are in doubt.
                return "fresh"
            self._proof, self._early = None, early
            self._least = min(self._least, delay)
            self._forget_adjustments()
            return "fresh"
        if steady:  # the known minimum was measured while a backlog arrived
            self.state, self._proof = "new", None
            return self._prove(delay, at_ns, silence, timeout_ns)
        needed_ns, share = min(timeout_ns, MAX_PROOF_NS), CREEP_DIVISOR
        if proof is None:
            self._accrue(at_ns, FORGIVE_NS)
        elif at_ns - proof.last_ns <= self.gap_ns:
            sign = proof.add(delay, at_ns, timeout_ns)
            if sign == "open":
                return "stale"
            if sign == "proven":
                return "set" if self._forgive(proof, at_ns) else "stale"
        if proof or abs(delay - self._delay) > silence // CREEP + JITTER_NS:
            needed_ns, share = max(needed_ns, JUMP_PROOF_NS), EVEN_DIVISOR
        self._proof = _Proof(delay, at_ns, timeout_ns, needed_ns, share, again=True)
        return "stale"

    def _forgive(self, proof: _Proof, at_ns: Ns) -> bool:
        # A larger delay is plausible after a pause, or by visible adjustments and the budget.
        self._accrue(at_ns, FORGET_NS)
        hidden = proof.least - self._least
        if self._before is not None:
            hidden = min(hidden, max(self._before - self._least, hidden - self._shown))
        if hidden > self._budget and not self._paused:
            return False
        self.forgiven_ns = max(0, hidden)
        self._budget = max(0, min(self._budget, FORGIVE_NS) - self.forgiven_ns)
        self._trust(proof)
        return True

    def _accrue(self, at_ns: Ns, most_ns: Ns) -> None:
        grown = (at_ns - self._budget_at_ns) // FORGIVE_RATE
        self._budget, self._budget_at_ns = min(self._budget + grown, most_ns), at_ns

    def _forget_adjustments(self) -> None:
        self._before, self._shown, self._doubted, self._paused = None, 0, None, False

    def _trust(self, proof: _Proof) -> None:
        self.state, self._least, self._proof = "known", proof.least, None
        self._early = 0
        self._forget_adjustments()


class Freshness:
    """Judges whether commands are fresh, with the state of each clock that stamps them."""

    def __init__(self) -> None:
        self._clocks: dict[str, _Clock] = {}
        self._newcomers: dict[str, _Clock] = {}  # foreign, without an accepted command
        self._unproved: dict[str, _Clock] = {}  # steady: the lowest delay is valid at once
        self._numbers: dict[str, tuple[int, int]] = {}  # number and arrival, without stamps
        self.forgiven_ns = 0  # total of trusted increases without a visible adjustment

    def judge(self, command: Command, timeout_ns: Ns) -> Verdict:
        """Return the verdict on a command, and remember its stamp and sequence number.

        Without a stamp it is stale only if its sequence number is out of order.
        """
        if command.stamp_ns is None:
            return self._in_order(command, max(MAX_PAUSE_NS, timeout_ns))
        name, at_ns = command.clock or command.source, command.arrived_ns
        clock = None
        for group in (self._clocks, self._newcomers, self._unproved):
            clock = clock or group.pop(name, None)
        clock = clock or _Clock(at_ns)
        verdict = clock.judge(command, command.stamp_ns, timeout_ns)
        if verdict == "set":
            self.forgiven_ns += clock.forgiven_ns
        group = self._unproved if command.steady else self._newcomers
        if clock.was_known:
            group = self._clocks
        group[name] = clock
        self._forget(at_ns)
        return verdict

    def _in_order(self, command: Command, gap_ns: Ns) -> Verdict:
        number, at_ns = command.sequence, command.arrived_ns
        if number is None:
            return "fresh"
        last = self._numbers.pop(command.sender, None)
        if last is not None and number <= last[0] and at_ns - last[1] <= gap_ns:
            self._numbers[command.sender] = last
            return "stale"
        self._numbers[command.sender] = number, at_ns
        if len(self._numbers) > MAX_CLOCKS:
            del self._numbers[next(iter(self._numbers))]
        return "fresh"

    def _forget(self, now_ns: Ns) -> None:
        # A recording begins with all clocks, which the control loop writes in one step.
        limits = (
            (self._newcomers, MAX_PAUSE_NS),
            (self._unproved, MEMORY_NS),
            (self._clocks, MEMORY_NS),
        )
        for group, silent_ns in limits:
            while group and now_ns - _oldest(group).at_ns > max(silent_ns, _oldest(group).gap_ns):
                del group[next(iter(group))]
        some = [group for group, _ in limits if group]
        if sum(map(len, some)) > MAX_CLOCKS:
            doubtful = [group for group in some if group is not self._clocks]
            silent = [group for group in doubtful if now_ns - _oldest(group).at_ns > MAX_PAUSE_NS]
            group = min(silent or some, key=lambda clocks: _oldest(clocks).at_ns)
            del group[next(iter(group))]


def _oldest(clocks: dict[str, _Clock]) -> _Clock:
    return next(iter(clocks.values()))
