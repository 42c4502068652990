"""Decides whether a stamped command is fresh, although the sender's clock is not synchronized.

The delay of a command is its time of arrival by the daemon's clock minus its stamp. This difference
is the true delay plus the unknown offset between the two clocks. The offset cancels out when the
daemon compares a delay with the minimum of all delays. A command is stale if its delay exceeds the
minimum by more than the timeout of its source, or if its stamp is earlier than that of an accepted
command.

A new sender does not drive until its delays have been constant for some time. If the delay changes
later, either the sender's clock was set or the network is congested. Both causes can look the same,
so the daemon trusts the new delay only within limits. The comment below gives the rules.
"""

from __future__ import annotations

from typing import Literal

from acsard.core.values import NS_PER_S, Command

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

SECONDS_PER_DRIFT = 5000
"""Number of seconds in which two clocks may drift apart by 1 s. A bad crystal takes twice as
long."""

FORGET_NS = 250 * NS_PER_S
"""Pause of a sender, ns, after which its clock counts as new, because the clock may have drifted by
50 ms. If the arrival times show the pause but the stamps do not, the network held commands back,
and the clock stays known."""

MEMORY_NS = 3600 * NS_PER_S
"""Silence of a sender, ns, after which its clock is forgotten to save memory."""

MAX_JITTER_NS = NS_PER_S // 20
"""Largest decrease of the delay that can be jitter, ns. After a larger decrease, a backlog has
ended or a clock was set."""

MAX_RISE_NS = NS_PER_S
"""Largest increase of the delay that can be jitter, ns. After a larger increase, the network has
held commands back."""

EVEN_DIVISOR, CREEP_DIVISOR = 200, 20
"""Divisors for a proof, which is a test whether the delay is constant. A proof compares the minimum
delays of its two halves. The minima may differ by the duration of the proof divided by
`EVEN_DIVISOR`, or divided by `CREEP_DIVISOR` if the delay creeps (see `CREEP`). The centers of the
halves are half the duration apart, so the delay may change by 10 ms per second, or by 100 ms per
second if it creeps. NTP slews a clock by up to 83 ms per second."""

CREEP, JITTER_NS = 10, NS_PER_S // 200
"""A delay creeps if it changes little between two commands: by at most the time between the two
commands divided by `CREEP`, plus `JITTER_NS`. Otherwise the delay jumps."""

MAX_PROOF_NS = 2 * NS_PER_S
"""Nominal duration of a proof (a test whether the delay is constant), ns. The timeout of the source
applies instead if it is shorter."""

JUMP_PROOF_NS = 3 * NS_PER_S // 2
"""Shortest time for which the delay must be constant after a jump before it is trusted, ns. The
cause of a jump is more likely a backlog that arrives in bursts than a clock that was set."""

MAX_PAUSE_NS = 2 * NS_PER_S
"""Silence of a sender that counts as a pause, ns. If the timeout of the sender's source is longer,
this timeout applies instead, because the sender need not send more often. A pause ends a test of
the sender's delay. If the stamps show the pause too, a foreign clock (one that may be adjusted) may
have been set by any amount in the pause."""

MAX_STOPPED_STAMP_NS = 10_000
"""If two successive commands arrive more than `SEPARATE_NS` apart, but the second stamp is later
than the first by at most this, ns, the clock was set back. The limit is not 0, because Zenoh's own
clock never goes back: if the wall clock was set back, Zenoh's clock advances by a fraction of a
microsecond for each message until the wall clock has caught up."""

SEPARATE_NS = NS_PER_S // 500
"""Commands that arrive within this time of each other, ns, may have been sent together."""

SAME_QUEUE_NS = NS_PER_S // 2000
"""Commands that arrive within this time of each other, ns, come from one queue. A test of the delay
waits for the last command of the queue, which has the smallest delay. No sender may send more than
1000 commands a second."""

FORGIVE_NS, FORGIVE_RATE = NS_PER_S, 60
"""Budget for increases of the delay that are trusted without a visible adjustment of the clock, ns.
The budget applies to foreign clocks (clocks that may be adjusted). It is refilled by one second in
`FORGIVE_RATE` seconds. While commands are late, the budget may rise above `FORGIVE_NS`, so that no
sender is refused forever."""

MAX_CLOCKS = 1024
"""Largest number of clocks that are kept. If there are more, the daemon usually forgets the clock
that has been silent longest. To make it forget a sender that sends at 20 Hz, a client would have to
use this many names within 0.05 s."""

State = Literal["new", "known"]
Verdict = Literal["fresh", "first", "unproven", "stale", "set"]
"""The verdict on a command.

- `fresh`: the command is accepted.
- `stale`: the command is refused, because it is late or repeated, or because a newer command was
  accepted before it.
- `first`: the command begins the test of a new clock, and does not drive the robot.
- `unproven`: the test of a new clock is not over, so the command does not drive the robot.
- `set`: the command is accepted, but the clock seems to have been set. The sender must send a zero
  before it drives the robot.
"""


class _Proof:
    """A test whether the delays of a clock have become constant. It starts with one command.

    The test compares the minimum delays of successive intervals. Each interval lasts half of the
    nominal duration of the test, and is called a half. The delays are constant if the minima of the
    first two halves are nearly equal (`EVEN_DIVISOR`, `CREEP_DIVISOR`). Otherwise the test goes on
    with further halves.
    """

    def __init__(
        self, delay: int, at_ns: int, timeout_ns: int, needed_ns: int, share: int, again: bool
    ) -> None:
        self.timeout_ns = timeout_ns
        """Timeout of the source whose command began the test, ns."""
        self.least = self._first = self._half = delay
        self._length_ns, self._share, self._again = needed_ns // 2, share, again
        self._begun_ns = self.last_ns = at_ns
        self._halves: list[tuple[int, int]] = []
        """For each of the last half periods of the test: its start on the monotonic clock, and the
        smallest delay in it, both in ns."""

    def add(self, delay: int, at_ns: int, timeout_ns: int) -> Literal["proven", "open", "failed"]:
        """Add a command of the clock, and return the state of the test.

        The test is "proven" if the delays are constant, and "open" if it needs more commands. It is
        "failed" if the delay has changed so much that a new test must begin with this command.

        Args:
            delay: the delay of the command, ns.
            at_ns: the monotonic time at which the command arrived, ns.
            timeout_ns: the timeout of the command's source, ns.
        """
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

    def _constant(self, at_ns: int) -> bool:
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
        # The test of a new clock compares the last eight halves in four pairs. The minima of the
        # pairs must agree within the same limit, or differ by at most `MAX_JITTER_NS` without a
        # trend. A trend means that the minima only fall, as while a backlog arrives, or only rise,
        # as while a queue grows.
        if count < 8:
            return False
        del self._halves[0]
        pairs = [min(pair) for pair in zip(minima[::2], minima[1::2], strict=True)]
        spread, up = max(pairs) - min(pairs), sorted(pairs)
        trend = pairs in (up, up[::-1])
        return spread <= lasted // self._share or (spread <= MAX_JITTER_NS and not trend)


class _Clock:
    """A clock that stamps commands, with the estimated minimum delay of these commands."""

    def __init__(self, at_ns: int) -> None:
        self.state: State = "new"
        self.at_ns = at_ns
        """Monotonic time at which the last command of this clock arrived, ns. Repeated commands do
        not count."""
        self.gap_ns = MAX_PAUSE_NS
        """Longest silence of the sender that is not a pause, ns: the longest timeout of the sources
        that received the sender's commands, but at least `MAX_PAUSE_NS`."""
        self.forgiven_ns = 0
        """The last trusted increase of the delay, ns, minus the part that visible adjustments of
        the clock explain."""
        self._stamp_ns = 0
        self._delay = 0
        self._number = -1
        """Sequence number of the last command, or -1 if that command was not numbered."""
        self._least = 0
        """Minimum of the trusted delays, ns. It rises with time by the largest possible drift."""
        self._early = 0
        """Sum of the recent decreases of `_least`, ns. It falls by 1 ns for each 10 ns that
        pass."""
        self._floor: int | None = None
        """Lowest delay of a steady clock (one that is never adjusted), ns. It rises with time by
        the largest possible drift. It is None before the first command, and always None for a clock
        that may be adjusted."""
        self._before: int | None = None
        """Delay before the first visible adjustment of the clock, ns; None if no adjustment is
        visible. Adjustments before the last command that was on time do not count."""
        self._shown = 0
        """Sum of the visible adjustments of the clock since the last command that was on time,
        ns."""
        self._doubted: tuple[int, int, int] | None = None
        """An adjustment of the clock that the next command must confirm, because the network may
        have swapped or repeated a command. The tuple has the delay before the adjustment, the size
        of the adjustment, and the stamp before the adjustment, all in ns."""
        self._paused = False
        """Whether the sender has paused since its last command that was on time, so that its clock
        may have been set."""
        self._budget, self._budget_at_ns = FORGIVE_NS, at_ns
        self._proof: _Proof | None = None
        self._accepted: tuple[int, int] | None = None
        """The stamp, ns, and the sequence number of the last accepted command; None before the
        first accepted command. The sequence number is -1 if that command was not numbered."""

    @property
    def was_known(self) -> bool:
        """Whether the daemon has already accepted a command with a stamp of this clock.

        After a pause of the sender longer than `FORGET_NS`, only later commands count.
        """
        return self._accepted is not None

    def judge(self, command: Command, stamp_ns: int, timeout_ns: int) -> Verdict:
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
        """Return whether the last accepted command is newer than this one, or is the same command.

        `mark` contains the stamp of this command, ns, and its sequence number, or -1 if it has no
        number. A repetition of the last accepted command is recognized only by its number.
        """
        last = self._accepted
        return last is not None and (mark < last or (mark == last and mark[1] >= 0))

    def _repeats(self, stamp_ns: int, number: int, silence: int) -> bool:
        """Return whether the network repeated this command, or delivered it after a later one.

        A low number may also come from a restart of the sender. The method assumes a restart after
        a pause of the sender, or if the stamp is later than both the previous and the last accepted
        stamp.
        """
        if not 0 <= number <= self._number or silence > self.gap_ns:
            return False
        accepted = self._accepted
        return stamp_ns <= self._stamp_ns or (accepted is not None and stamp_ns <= accepted[0])

    def _later_than_lowest(self, delay: int, silence: int) -> int:
        """Return by how much `delay` exceeds the lowest delay so far, ns.

        The method also updates the lowest delay. Call it only for a steady clock, which is a clock
        that is never adjusted. `silence` is the time since its last command, ns.
        """
        floor = delay if self._floor is None else self._floor + silence // SECONDS_PER_DRIFT
        self._floor = min(floor, delay)
        return delay - self._floor

    def _look_for_adjustment(self, stamp_ns: int, silence: int, number: int) -> None:
        """Record a pause of the sender or an adjustment of its clock, if this command shows one.

        If the stamp of a command is not later than the previous stamp, the clock was probably set
        back. But the network may have swapped or repeated a command instead. Therefore the
        adjustment counts only after the next command has confirmed it. That command confirms it in
        two cases:

        - Its stamp is again not later than the previous stamp.
        - Its stamp is not later than the last stamp before the adjustment.

        If commands were lost, the network may have caused the silence, so no pause is recorded. The
        adjustment is then measured from the stamp of the last accepted command.
        """
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

    def _prove(self, delay: int, at_ns: int, silence: int, timeout_ns: int) -> Verdict:
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
        self, delay: int, at_ns: int, silence: int, timeout_ns: int, steady: bool
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

    def _forgive(self, proof: _Proof, at_ns: int) -> bool:
        """Return whether the new constant delay, which `proof` has found, is plausible.

        If so, the clock uses this delay from now on. A smaller delay is always plausible. A larger
        delay is plausible in two cases:

        - The sender has paused, so its clock may have been set meanwhile.
        - The increase can be explained by visible adjustments of the clock, by the budget for
          invisible adjustments (`FORGIVE_NS`), or by both together.
        """
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

    def _accrue(self, at_ns: int, most_ns: int) -> None:
        grown = (at_ns - self._budget_at_ns) // FORGIVE_RATE
        self._budget, self._budget_at_ns = min(self._budget + grown, most_ns), at_ns

    def _forget_adjustments(self) -> None:
        self._before, self._shown, self._doubted, self._paused = None, 0, None, False

    def _trust(self, proof: _Proof) -> None:
        self.state, self._least, self._proof = "known", proof.least, None
        self._early = 0
        self._forget_adjustments()


class Freshness:
    """Judges whether commands are fresh. It keeps the state of each clock that stamps commands."""

    def __init__(self) -> None:
        self._clocks: dict[str, _Clock] = {}
        self._newcomers: dict[str, _Clock] = {}
        """Clocks that may be adjusted and have not stamped an accepted command yet. They are
        forgotten after a pause."""
        self._unproved: dict[str, _Clock] = {}
        """Clocks that are never adjusted and have not stamped an accepted command yet. They are
        forgotten only after a silence of `MEMORY_NS`, because their lowest delay is valid from the
        first command on."""
        self._numbers: dict[str, tuple[int, int]] = {}
        """For each sender that numbers its commands but does not stamp them: the last sequence
        number, and its monotonic time of arrival, ns."""
        self.forgiven_ns = 0
        """Total increase of delays that was trusted without a visible adjustment of a clock, ns."""

    def judge(self, command: Command, timeout_ns: int) -> Verdict:
        """Return the verdict on a command, and remember its stamp and sequence number.

        `timeout_ns` is the timeout of the command's source, ns. A command without a stamp is stale
        only if its sequence number is out of order.
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

    def _in_order(self, command: Command, gap_ns: int) -> Verdict:
        """Judge a command without a stamp by its sequence number.

        After a silence of more than `gap_ns`, the sender may start its sequence numbers again.
        """
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

    def _forget(self, now_ns: int) -> None:
        # The number of clocks is limited, because a recording begins with all clocks, and the
        # control loop writes all of them in one step.
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
    # Each command moves its clock to the end of the dictionary.
    return next(iter(clocks.values()))
