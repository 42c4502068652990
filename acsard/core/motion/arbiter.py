"""Chooses the command that the robot follows: first the source, then a sender of this source.

A sender is live until its last accepted command is older than the source's timeout. The live source
of the highest priority wins, among equals the one that began first, until it falls silent; so do
senders. A source without an armed sender keeps its priority, and the robot stands still: a lower
one must not drive instead. Zeros alone keep the robot at rest for any time, which `state` and the
log report. A sender with doubtful stamps is chosen for a short time (`Sender.present`), and the
robot stands still.
"""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.motion.emergency_stop import CATCH_UP_NS, LATE_STEP_NS
from acsard.core.motion.freshness import MAX_PROOF_NS, Freshness
from acsard.core.motion.neutral import FOREVER_NS, NEUTRAL_PAUSE_NS, Sender, is_zero
from acsard.core.values import NS_PER_S, REST, Command, Ns, SourceStatus, Twist, Wait

MAX_SENDERS = 16  # of a source; one that may keep control (`Sender.holds`) is never replaced

Objection = Literal["unknown_source", "not_finite", "too_many_senders", "unproven", "stale"]

# s of zeros only, or of speeds without being armed, to which `state` rounds down.
REPORTED_DURATIONS_S = (3.0, 10.0, 60.0, 600.0, 3600.0)

NOTHING, COMMAND = Wait("nothing"), Wait("command")


class Choice(Struct, frozen=True):
    """The twist to follow, or None and the reason `wait`; the chosen source and sender."""

    source: str = ""
    twist: Twist | None = None
    wait: Wait = COMMAND
    arrived_ns: Ns | None = None
    sender: str = ""


# No source has sent within its timeout. A command that its stamp made unacceptable has a `wait`.
IDLE = Choice()


class _Source:
    def __init__(self, settings: Source, neutral_first: bool) -> None:
        self.name, self.priority = settings.name, settings.priority
        self.neutral_first = neutral_first
        self.senders: dict[str, Sender] = {}
        self.use(settings)

    def use(self, settings: Source) -> None:
        self.timeout_ns = int(settings.timeout * NS_PER_S)
        self.proof = Wait("proof", settings.name, min(self.timeout_ns, MAX_PROOF_NS) / NS_PER_S)
        self.late = Wait("late", settings.name, settings.timeout)
        self.stalled = Wait("stalled", settings.name)
        for sender in self.senders.values():
            sender.use(self.timeout_ns)

    def add(self, name: str, now_ns: Ns) -> Sender | None:
        """Return a new sender (it may replace the one of the lowest rank), or None."""
        if len(self.senders) >= MAX_SENDERS:
            least = min(self.senders, key=lambda other: self._account(other, now_ns))
            if self._account(least, now_ns)[0]:
                return None
            del self.senders[least]
        added = self.senders[name] = Sender(self.timeout_ns, self.neutral_first)
        return added

    def _account(self, name: str, now_ns: Ns) -> tuple[bool, bool, int]:
        sender = self.senders[name]
        holds = sender.holds(now_ns)
        return holds, holds or sender.armed(now_ns), sender.noticed_ns

    def cancel_zeros(self, at_ns: Ns) -> None:
        """Cancel the zeros of identities that several programs share: one may have sent a speed.

        A zero whose neutral pause was over at `at_ns` stays.
        """
        for sender in self.senders.values():
            sender.cancel_zero(at_ns)

    def undo_zeros(self, command: Command, was_set: bool) -> None:
        """Undo the unaccepted zeros of a sender with a doubtful clock, or all if it was set."""
        sender = self.senders.get(command.sender)
        # Behind a bridge, programs with clocks of their own share one identity, so a command to
        # another source counts only if the same clock stamped the last one to this source.
        if sender is None or (command.source != self.name and command.clock != sender.clock):
            return
        if was_set:
            sender.disarm(command.arrived_ns)
        else:
            sender.unlearn()

    def present(self, now_ns: Ns) -> list[Sender]:
        """Return the senders that may be chosen: armed, live, others; the oldest first."""
        present = []
        for sender in self.senders.values():
            if sender.present(now_ns):
                present.append(sender)
        if len(present) < 2:
            return present
        return sorted(
            present,
            key=lambda sender: (not sender.armed(now_ns), *sender.rank(now_ns)),
        )

    def latest_ns(self) -> Ns | None:
        """Return when the last accepted command since `require_neutral` arrived."""
        times = [s.arrived_ns for s in self.senders.values() if s.arrived_ns is not None]
        return max(times, default=None)

    def require_neutral(self) -> None:
        for sender in self.senders.values():
            sender.require_neutral()

    def neutral(self, sender: Sender, lasts: float = 0.0) -> Wait:
        """Return the `Wait` for a zero; `lasts` is how long the sender has sent only speeds, s."""
        return Wait(
            "neutral",
            self.name,
            NEUTRAL_PAUSE_NS / NS_PER_S,
            lasts=lasts,
            ros=sender.ros,
            shared=sender.shared,
        )

    def doubt_wait(self, now_ns: Ns) -> Wait | None:
        """Return why the newest sender with doubtful stamps does not drive, or None without any."""
        doubtful = [sender for sender in self.senders.values() if sender.doubtful(now_ns)]
        if not doubtful:
            return None
        return self.stale_wait(max(doubtful, key=lambda sender: sender.noticed_ns), now_ns)

    def stale_wait(self, sender: Sender, now_ns: Ns) -> Wait:
        """Return why `sender`, which is not live, does not drive the robot."""
        if not sender.doubtful(now_ns):
            return self.stalled
        if sender.doubt == "stale":
            return self.late
        return self.proof if sender.armed(now_ns) else self.neutral(sender)

    def wait_of(self, sender: Sender, now_ns: Ns, lasting: bool = True) -> Wait:
        """Return why `sender` does not drive; if `lasting`, for how long it has sent speeds."""
        if not sender.is_live(now_ns):
            return self.stale_wait(sender, now_ns)
        since_ns = sender.speeds_ns if lasting else None
        return self.neutral(
            sender, 0.0 if since_ns is None else _reported_duration_s(now_ns - since_ns)
        )


class Arbiter:
    """Stores the latest command of each sender, and chooses the command that the robot follows."""

    def __init__(self, commands: CommandsConfig) -> None:
        self._sources = {s.name: _Source(s, commands.neutral_first) for s in commands.sources}
        self._ranking = sorted(self._sources.values(), key=lambda source: -source.priority)
        self._holder: _Source | None = None
        self._followed: Sender | None = None
        self._since_ns = 0
        self._begun_ns = self._watched_ns = 0
        self._freshness = Freshness()
        self.until_ns = 0  # the last `choose` holds until then, unless another method is called

    def use(self, commands: CommandsConfig) -> None:
        """Use other timeouts. Armed senders stay armed."""
        for settings in commands.sources:
            self._sources[settings.name].use(settings)
        self.until_ns = 0

    def require_neutral(self, since_ns: Ns = 0) -> None:
        """Forget all commands: each sender must send a zero that arrives from `since_ns` on.

        An older zero, for example from before a stop was cleared, does not show that the sender
        wants rest now. The latest `since_ns` counts. Without `commands.neutral_first` no zero is
        needed.
        """
        self._since_ns = max(self._since_ns, since_ns)
        for source in self._ranking:
            source.require_neutral()
        self._holder = self._followed = None
        self.until_ns = 0

    def begin(self, now_ns: Ns) -> bool:
        """Begin a control step, and return whether the daemon stood still before (True at first).

        After `LATE_STEP_NS`, the bus may not have delivered all commands, so senders stay in the
        choice for a short time, and a running neutral pause does not advance (`Sender.resume`).
        """
        before_ns, self._begun_ns = self._begun_ns, now_ns
        if now_ns - before_ns <= LATE_STEP_NS:
            return False
        self._watched_ns = now_ns if before_ns else now_ns - CATCH_UP_NS
        self.until_ns = 0
        for source in self._ranking:
            for sender in source.senders.values():
                sender.resume(before_ns, now_ns)
        return True

    def accept(self, command: Command) -> Objection | Literal[""]:
        """Process a command. Return "" if it is accepted, otherwise the reason to refuse it."""
        self.until_ns = 0
        source = self._sources.get(command.source)
        if source is None:
            return "unknown_source"
        twist, known = command.twist, source.senders.get(command.sender)
        if command.shared and not is_zero(command):
            source.cancel_zeros(command.arrived_ns)
        if not (math.isfinite(twist.linear) and math.isfinite(twist.angular)):
            self.notice(command.source, command.sender, command.arrived_ns)
            return "not_finite"
        verdict = self._freshness.judge(command, source.timeout_ns)
        if verdict == "stale":
            if known is not None:
                known.refuse(command, verdict)
            return "stale"
        sender = known or source.add(command.sender, command.arrived_ns)
        if sender is None:
            return "too_many_senders"
        since_stall_ns = command.arrived_ns - self._watched_ns
        if since_stall_ns < CATCH_UP_NS and command.stamp_ns is None and not is_zero(command):
            # The command may have waited during the whole stall, and only a stamp would show that.
            sender.outdate(command)
            return "stale"
        if verdict in ("set", "first"):
            # The doubt about a clock concerns its stamps on all sources.
            for other in self._ranking:
                other.undo_zeros(command, verdict == "set")
        sender.take(command, self._since_ns, verdict, self._watched_ns)
        return "" if verdict in ("fresh", "set") else "unproven"

    def notice(self, source: str, sender: str, arrived_ns: Ns) -> None:
        """Record that a message of a sender was lost or unusable; it may have been a speed.

        It cancels the zero of its own identity only. Of another identity of the same program it
        shows no more than silence, which arms after the neutral pause, and a program that sends
        only such messages must not keep the others of the source from being armed.
        """
        self.until_ns = 0
        known = self._sources.get(source)
        known_sender = None if known is None else known.senders.get(sender)
        if known_sender is not None:
            known_sender.noticed_ns = arrived_ns
            known_sender.cancel_zero(arrived_ns)

    def choose(self, now_ns: Ns) -> Choice:
        """Return the command that the robot follows now, or the reason why it follows none.

        The result is the same until `until_ns`.
        """
        self.until_ns = self._changes_ns(now_ns)
        first: tuple[_Source, Sender] | None = None
        previous = self._followed
        for source in self._ranking:
            if not source.senders or not (present := source.present(now_ns)):
                continue
            if first is None or (
                source.priority == first[0].priority
                and present[0].rank(now_ns) < first[1].rank(now_ns)
            ):
                first = source, present[0]
            if (
                previous is not None
                and previous in present
                and source.priority == first[0].priority
                and previous.holds(now_ns)
            ):
                # `previous` began later, but `source` may have become armed just now.
                first = source, previous
                break
        if first is None:
            self._holder = self._followed = None
            for source in self._ranking:
                if source.senders and (wait := source.doubt_wait(now_ns)) is not None:
                    return Choice(wait=wait)
            return IDLE
        source, sender = first
        armed = sender.armed(now_ns)
        self._holder, self._followed = source, sender if armed or sender is previous else None
        if not (armed and sender.is_live(now_ns)):
            return Choice(source.name, None, source.wait_of(sender, now_ns), sender=sender.name)
        wait = NOTHING
        if sender.zeros_ns is not None and (
            lasts := _reported_duration_s(now_ns - sender.zeros_ns)
        ):
            wait = Wait(
                "zeros", source.name, lasts=lasts, kept=self._blocked_source(source, now_ns)
            )
        return Choice(source.name, sender.twist, wait, sender.arrived_ns, sender.name)

    def _changes_ns(self, now_ns: Ns) -> Ns:
        times = [FOREVER_NS]
        for source in self._ranking:
            for sender in source.senders.values():
                times.append(sender.changes_ns(now_ns))
                for since_ns in (sender.zeros_ns, sender.speeds_ns):
                    if since_ns is not None:
                        times.append(since_ns + _next_report_ns(now_ns - since_ns))
        return min(times)

    def _blocked_source(self, holder: _Source, now_ns: Ns) -> str:
        # The source, or another sender of it, whose speeds have no effect: `holder` sends zeros.
        for source in self._ranking:
            senders = (each for each in source.present(now_ns) if each is not self._followed)
            if any(sender.twist != REST for sender in senders):
                return f"another sender of {source.name}" if source is holder else source.name
        return ""

    @property
    def clock_adjustment_ns(self) -> Ns:
        """Sum of the trusted increases of delays that no stamps explain (`freshness.py`)."""
        return self._freshness.forgiven_ns

    def sources(self, now_ns: Ns) -> tuple[SourceStatus, ...]:
        """Return the status of each source, the highest priority first."""
        return tuple(self._status(source, now_ns) for source in self._ranking)

    def _status(self, source: _Source, now_ns: Ns) -> SourceStatus:
        latest = source.latest_ns()
        age_s = None if latest is None else max(0, now_ns - latest) / NS_PER_S
        return SourceStatus(source.name, source.priority, age_s, self._waits_for(source, now_ns))

    def _waits_for(self, source: _Source, now_ns: Ns) -> Wait:
        holder, present = self._holder, source.present(now_ns)
        if not present:
            return source.doubt_wait(now_ns) or COMMAND
        first = self._followed if source is holder and self._followed else present[0]
        if not (first.armed(now_ns) and first.is_live(now_ns)):
            return source.wait_of(first, now_ns, lasting=False)
        if holder is None or source is holder:
            return Wait("senders", senders=len(present) - 1) if len(present) > 1 else NOTHING
        return Wait("equal" if holder.priority == source.priority else "higher", holder.name)


def _next_report_ns(ns: Ns) -> Ns:
    # The duration at which `_reported_duration_s` gives another result.
    after = [limit for seconds in REPORTED_DURATIONS_S if (limit := int(seconds * NS_PER_S)) > ns]
    return after[0] if after else FOREVER_NS


def _reported_duration_s(ns: Ns) -> float:
    if ns < REPORTED_DURATIONS_S[0] * NS_PER_S:
        return 0.0  # Nearly every step ends here.
    return max(seconds for seconds in REPORTED_DURATIONS_S if ns >= seconds * NS_PER_S)
