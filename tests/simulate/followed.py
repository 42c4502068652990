"""Judges which command the robot follows.

The robot reports the arrival time of the command that it follows, so the simulator knows its
sender. `explanation/commands.md` of the manual says which sender that must be. The judge expects
only commands that the daemon certainly accepts: they have no stamp, or their delays were the lowest
ones and constant for long enough.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from typing import Any, NamedTuple

from tests.simulate.ages import MARGIN_NS, Wish
from tests.simulate.product import HELD
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS, Message, Sample, stable

STOOD_NS = NS // 2
"""After a step that stalled for this time, the next one may release and stop the robot again, and
forget who held it."""

KEPT = 4000
"""Commands that are remembered."""

OUTDATED_NS = 3 * NS
"""After a stall of more than `LATE_NS`, commands older than this are forgotten. The daemon gives a
speed that may have waited in the stall an arrival 4 s ago, which can be that of a true command."""

LATE_NS = NS // 20
"""A step that comes later than this after the one before may have stalled."""

OBEYED_NS = 20_000_000
"""A command that was accepted is obeyed within this time and one period."""

EVEN_NS = 20_000_000
"""Delays within this time of their lowest are even."""

FALL_NS = 5_000_000
"""A delay that is lower than all before by more than this falls."""

UNBROKEN_NS = NS
"""A longer silence begins a new run of even delays."""

NUMBERED = ("client", "page", "signed", "rmw")
"""Ways whose messages have numbers."""

Wheels = tuple[float, ...]

Who = tuple[str, str]
"""Source and identity of a sender."""


class Command(NamedTuple):
    """A command that arrived, with its time on the robot's clock and its true properties."""

    arrived_ns: int
    true_ns: int
    who: Who
    sender: dict[str, Any]
    message: Message
    clock: str
    v: float
    w: float
    numbered: bool
    """It has a number, and its sender does not share its identity."""
    overtaken: bool = False
    """A later zero of the same sender arrived just before it, so it may not move the robot."""

    @property
    def zero(self) -> bool:
        return not (self.v or self.w or self.message.junk)


class Run:
    """A series of messages of one clock whose delays are nearly equal."""

    def __init__(self, at_ns: int, age: int) -> None:
        self.begun_ns = self.last_ns = at_ns
        self.low = self.high = age
        self.followed = False
        """The robot has followed a command of this run, so the daemon knows its delays."""


class Followed:
    """The commands that arrived at one daemon, and the command that the daemon follows."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._arrived: dict[int, Command | None] = {}
        """By arrival; None if several arrived at that time."""
        self._runs: dict[str, Run] = {}
        self._least: dict[str, tuple[int, int]] = {}
        """The lowest delay of each clock, and when the daemon last forgot all delays."""
        self._fell_ns: dict[str, int] = {}
        """When the lowest delay of each clock last fell clearly."""
        self._newest: dict[str, int] = {}
        """The highest number that arrived, by clock."""
        self._waiting: dict[Who, Command] = {}
        """Commands that certainly count from the next step on."""
        self._count = 0
        """Commands that arrived since the last step."""
        self._sure: dict[Who, Command] = {}
        """The newest command of each sender that certainly counts."""
        self._holder: Command | None = None
        """The command that was followed in the last step."""
        self._keeper: Command | None = None
        """The last command that was followed of the sender that keeps the robot."""
        self._higher: list[Wish] = []
        """Commands since the last step of sources of higher priority than that sender."""
        self._rests_ns: dict[Who, int] = {}
        """Arrival of the newest zero of each sender, by the robot's clock."""
        self._stamps_ns: dict[Who, list[int]] = {}
        """The stamps of the zeros of each sender, in ascending order."""
        self._latest: dict[Who, Command] = {}
        """The last command that arrived from each sender, without overtaken speeds."""
        self._slowest: tuple[float, float] | None = None
        """The lowest speed and turn rate since the followed command is one that a zero overtook,
        None if it is not such a command."""
        self._armed_since_ns = witness.armed_since_ns
        self._decided_ns = 0
        """Beginning of the step before."""

    def command(
        self,
        sender: dict[str, Any],
        message: Message,
        sample: Sample,
        at_ns: int,
        wish: Wish | None,
    ) -> None:
        """Record a message that arrived at `at_ns` on the robot's clock.

        `wish` is None if the message is not a command or is not readable.
        """
        self._count += 1
        if wish is None:
            return
        key = sender["source"], sample.identity
        numbered = sender["way"] in NUMBERED and not sample.shared
        command = Command(
            at_ns, wish.arrived_ns, key, sender, message, sample.clock, wish.v, wish.w, numbered
        )
        if self._is_overtaken(command):
            command = command._replace(overtaken=True)
        else:
            self._latest[key] = command
        if not (wish.v or wish.w or message.junk):
            self._rests_ns[key] = at_ns
            insort(self._stamps_ns.setdefault(key, []), message.stamp_ns)
        if self._keeper is not None:
            priority = self._witness.priority
            if priority[key[0]] > priority[self._keeper.who[0]]:
                self._higher.append(wish)
        self._arrived[at_ns] = None if at_ns in self._arrived else command
        if len(self._arrived) > KEPT:
            del self._arrived[next(iter(self._arrived))]
        if self._certain(command, sample, wish):
            self._waiting[key] = command

    def _is_overtaken(self, command: Command) -> bool:
        """Return whether a later zero of the same sender arrived before this speed.

        A zero that arrived more than the timeout earlier does not count, because the sender may
        have restarted its numbers since.
        """
        zero, timeout_ns = self._latest.get(command.who), self._witness.timeout[command.who[0]]
        return (
            zero is not None
            and zero.zero
            and not command.zero
            and zero.numbered
            and command.numbered
            and zero.sender is command.sender
            and zero.message.number > command.message.number
            and command.arrived_ns - zero.arrived_ns < timeout_ns - MARGIN_NS
        )

    def _certain(self, command: Command, sample: Sample, wish: Wish) -> bool:
        """Return whether the daemon certainly accepts this command."""
        witness, sender, message = self._witness, command.sender, command.message
        newest = self._newest.get(sample.clock, 0)
        self._newest[sample.clock] = max(newest, message.number)
        if command.who[0] in witness.churned or message.junk or sender.get("stamps_speeds"):
            return False
        if not sample.clock:
            # A zero of a shared identity counts only behind its pause.
            since_ns = max(witness.armed_since_ns, witness.disarmed_ns)
            armed = wish.armed_ns > since_ns and command.who[0] not in witness.pausing
            waited = witness.may_have_waited(wish, surely=False)
            return wish.certain and not waited and (armed or not sample.shared)
        if sample.clock in witness.shared_clocks or not stable(sender):
            return False
        if sample.beat is not None:
            # Its age, which the daemon knows, is the time since the beat.
            timeout_ns = witness.timeout[command.who[0]]
            prompt = wish.arrived_ns - sample.beat[1] < timeout_ns - MARGIN_NS
            known = sample.beat[1] > witness.born_ns
            return prompt and known and message.number > newest
        age, at_ns = wish.arrived_ns - message.sent_ns, wish.arrived_ns
        learned_ns, least = self._least.get(sample.clock, (0, age))
        if learned_ns != witness.ages.learned_ns:
            least = age
        if age < least - FALL_NS:
            # A backlog pours in, or the clock was set: the daemon waits for one timeout.
            self._fell_ns[sample.clock] = wish.arrived_ns
            for commands in (self._waiting, self._sure):
                for key in [
                    key for key, waiting in commands.items() if waiting.clock == sample.clock
                ]:
                    del commands[key]
        # The daemon may know a clock that it has never followed, also behind a silence.
        least = min(least, age)
        self._least[sample.clock] = witness.ages.learned_ns, least
        run = self._runs.get(sample.clock)
        if (
            run is None
            or at_ns - run.last_ns > UNBROKEN_NS
            or run.begun_ns < witness.ages.learned_ns
            or max(run.high, age) - min(run.low, age) > EVEN_NS
        ):
            run = self._runs[sample.clock] = Run(at_ns, age)
        run.low, run.high, run.last_ns = min(run.low, age), max(run.high, age), at_ns
        timeout_ns = witness.timeout[command.who[0]]
        proof_ns = 3 * NS + 2 * timeout_ns
        proven = run.followed or (not sender.get("jitter") and at_ns - run.begun_ns > proof_ns)
        proven &= at_ns - self._fell_ns.get(sample.clock, -proof_ns) >= NS + timeout_ns
        return proven and age <= least + EVEN_NS and message.number > newest

    @property
    def wish(self) -> tuple[float, float] | None:
        """The speeds of the command that the robot follows, None if that is not known.

        A newer zero of the same sender may have ended them, although its delay is in doubt. If
        several programs share a clock by name, or a clock is set back, a zero that came earlier may
        have the later stamp.
        """
        holder = self._holder
        if holder is None:
            return None
        overtakes_ns = 0
        if holder.clock in self._witness.shared_clocks:
            overtakes_ns = 2 * self._witness.timeout[holder.who[0]]
        if self._rests_ns.get(holder.who, -overtakes_ns - 1) > holder.arrived_ns - overtakes_ns:
            return None
        if not stable(holder.sender) and self._has_later_zero(holder):
            return None
        return None if holder.overtaken else (holder.v, holder.w)

    def _has_later_zero(self, command: Command) -> bool:
        """Return whether a zero of the same sender has a stamp that is later by up to the timeout.

        The daemon ignores a zero whose stamp is later by more than that.
        """
        stamps_ns, stamp_ns = self._stamps_ns.get(command.who, []), command.message.stamp_ns
        place = bisect_right(stamps_ns, stamp_ns)
        longest_ns = self._witness.timeout[command.who[0]]
        return place < len(stamps_ns) and stamps_ns[place] - stamp_ns <= longest_ns

    @property
    def sender(self) -> dict[str, Any] | None:
        """The sender of the command that the robot follows, None if that is not known."""
        return None if self._holder is None else self._holder.sender

    def forget(self) -> None:
        """Note that the daemon may have forgotten all commands."""
        self._sure.clear()
        self._holder = self._keeper = None

    def step(
        self, true_ns: int, decided_ns: int, followed_ns: int | None, mode: str, link: str
    ) -> None:
        """Judge the command that the robot follows in a step that began at `decided_ns`.

        The caller has judged the ages of all commands before.
        """
        witness = self._witness
        armed_since_ns = witness.armed_since_ns
        # Each further cause of a fault makes the daemon forget all commands again.
        disarmed = armed_since_ns != self._armed_since_ns or mode in ("fault", "shutdown")
        self._armed_since_ns = armed_since_ns
        stood = decided_ns - self._decided_ns > STOOD_NS
        if decided_ns - self._decided_ns > LATE_NS:
            known = self._arrived.items()
            self._arrived = {at: entry for at, entry in known if at > decided_ns - OUTDATED_NS}
        self._decided_ns = decided_ns
        if disarmed or stood or witness.pending or link != "up":
            self.forget()
        elif self._count <= HELD:
            self._sure.update(self._waiting)
        self._waiting.clear()
        self._count = 0
        if any(wish.fresh for wish in self._higher):
            # If a sender of higher priority gets the robot, also one that must send a zero, the
            # first of the others to come gets the robot behind it. The daemon may refuse this
            # command nevertheless.
            self._keeper = None
        self._higher.clear()
        command = None if followed_ns is None else self._arrived.get(followed_ns)
        if command is not None:
            self._first_keeps(true_ns, decided_ns, command)
            self._highest_wins(true_ns, decided_ns, command)
            self._newest_counts(true_ns, decided_ns, command)
            if command.clock in self._runs:
                run = self._runs[command.clock]
                run.followed |= command.true_ns >= run.begun_ns
        # A step may follow a command and forget it: a call that releases the robot comes later.
        self._holder = None if disarmed else command
        if disarmed:
            self._keeper = None

    def line(self, true_ns: int, before: Wheels, wheels: Wheels) -> None:
        """Check that the robot slows down if the speed that it follows is older than a zero.

        Such a speed arrived after a zero that its sender sent later. `before` contains the wheel
        speeds of the previous line.
        """
        witness, holder = self._witness, self._holder
        # A limited jerk lets a speed grow on for a moment.
        sure = witness.mode == "driving" and "linear_jerk" not in witness.limits
        sure &= not (witness.pending or witness.away)
        # Senders that change their identity may push out the record of the zero.
        sure &= holder is not None and holder.who[0] not in witness.churned
        if holder is None or not holder.overtaken or not sure:
            self._slowest = None
            return
        v, w = map(abs, witness.twist(wheels))
        if self._slowest is None:
            old_v, old_w = map(abs, witness.twist(before))
            self._slowest = old_v, old_w
            witness.counts["overtaken speeds"] += 1
        least_v, least_w = self._slowest
        room = 0.022 * witness.radius
        if v > least_v + room or w > least_w + room / witness.half:
            raise BrokenError(
                "a speed that a zero overtook moves nothing", true_ns,
                f"{holder.who} sent number {holder.message.number} before its zero, and the robot "
                f"speeds up from {least_v:.3f} m/s, {least_w:.3f} rad/s to {v:.3f}, {w:.3f}",
            )  # fmt: skip
        self._slowest = min(v, least_v), min(w, least_w)

    def _first_keeps(self, true_ns: int, decided_ns: int, command: Command) -> None:
        """Check that the robot leaves its sender only for a source of higher priority.

        It may also leave a sender that is silent, or that the daemon refuses because its clock was
        set.
        """
        keeper, witness = self._keeper, self._witness
        other = keeper is not None and keeper.who != command.who
        if keeper is not None and other and self._is_kept(keeper, decided_ns):
            priority = witness.priority
            if priority[command.who[0]] <= priority[keeper.who[0]]:
                raise BrokenError(
                    "the first of equal priority keeps the robot", true_ns,
                    f"{command.who} is followed, {keeper.who} goes on, and was followed "
                    f"{(decided_ns - keeper.arrived_ns) / NS:.3f} s ago",
                )  # fmt: skip
        self._keeper = command

    def _is_kept(self, keeper: Command, decided_ns: int) -> bool:
        """Return whether the daemon must continue to follow this sender."""
        witness, source = self._witness, keeper.who[0]
        return (
            decided_ns - keeper.arrived_ns < witness.timeout[source] - witness.period_ns
            and keeper.true_ns > witness.disarmed_ns
            and source not in witness.churned
        )

    def _highest_wins(self, true_ns: int, decided_ns: int, entry: Command) -> None:
        witness = self._witness
        priority = witness.priority[entry.who[0]]
        for (source, identity), other in self._sure.items():
            if witness.priority[source] <= priority:
                continue
            age = decided_ns - other.arrived_ns
            if OBEYED_NS + witness.period_ns < age < witness.timeout[source] - witness.period_ns:
                raise BrokenError(
                    "the highest priority wins", true_ns,
                    f"{entry.who} is followed, {source} by {identity} arrived {age / NS:.3f} s ago",
                )  # fmt: skip

    def _newest_counts(self, true_ns: int, decided_ns: int, command: Command) -> None:
        newest, late_ns = self._sure.get(command.who), OBEYED_NS + self._witness.period_ns
        if newest is not None and command.arrived_ns < newest.arrived_ns < decided_ns - late_ns:
            raise BrokenError(
                "the newest command is obeyed at once", true_ns,
                f"{command.who} sent one {(decided_ns - newest.arrived_ns) / NS:.3f} s ago, and "
                f"that of {(decided_ns - command.arrived_ns) / NS:.3f} s ago is followed",
            )  # fmt: skip
