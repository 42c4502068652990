"""Chooses the command that the robot follows: first the source, then a sender of this source.

A sender is live until its last accepted command is older than the source's timeout. The live source
of the highest priority wins; of its senders, and of sources with the same priority, an armed one,
and then the one that drives already or that began first, until it falls silent. Without an armed
sender a source keeps its priority, and the robot stands still: a lower one must not drive instead.
Zeros alone keep the robot at rest for any time, which `state` and the log report.
"""

from __future__ import annotations

import math

from msgspec import Struct, field

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.link.step_times import CATCH_UP_NS
from acsard.core.motion.ages import MARGIN_NS, MAX_CLOCKS, SILENT_NS, Ages, Order
from acsard.core.motion.neutral import (
    BRIDGE_LEASE_NS,
    FOREVER_NS,
    NEUTRAL_PAUSE_NS,
    RMW_LEASE_NS,
    Hint,
    Sender,
    is_zero,
)
from acsard.core.tables.sender_codes import AgeCode
from acsard.core.values import (
    BRIDGES,
    NS_PER_S,
    REST,
    Announcement,
    Command,
    Ns,
    SourceStatus,
    Twist,
    Wait,
)

MAX_SENDERS = 16  # of a source; one that may drive is never replaced

LASTING_NS = 3 * NS_PER_S  # of zeros only, or of speeds without being armed, until `state` says so

# A longer gap behind a speed is the end of a drive. The longest gap is of the last one or two
# windows.
LONGEST_GAP_NS, GAP_WINDOW_NS = 5 * NS_PER_S, 30 * NS_PER_S

NOTHING, COMMAND = Wait("nothing"), Wait("command")

NOBODY = ("", "")

MAX_ANNOUNCED = 64  # ROS publishers of a source whose tokens are remembered


class Choice(Struct, frozen=True):
    """The twist to follow, or None and the reason `wait`; the chosen source and sender."""

    source: str = ""
    twist: Twist | None = None
    wait: Wait = COMMAND
    sender: str = ""


# No source has sent within its timeout. A command that was refused for its age has a `wait`.
IDLE = Choice()


class SourceSenders(Struct):
    """The senders of one source, and their clocks."""

    senders: dict[str, Sender] = {}
    ages: Ages = field(default_factory=Ages)
    forgot_ns: Ns = 0  # last message of a sender that was replaced, or that never had a place
    # Since when the token of a sender is there; of all bridges, since the last change.
    announced: dict[str, Ns] = {}
    # Longest times between a speed and the next command, now and before, and since when.
    gap_ns: Ns = 0
    gap_before_ns: Ns = 0
    gaps_since_ns: Ns = 0

    def note_gap(self, gap_ns: Ns, now_ns: Ns) -> None:
        """Note the time between a speed of a sender and its next command."""
        if now_ns - self.gaps_since_ns > GAP_WINDOW_NS:
            self.gap_before_ns, self.gap_ns, self.gaps_since_ns = self.longest_ns(now_ns), 0, now_ns
        if gap_ns <= LONGEST_GAP_NS:
            self.gap_ns = max(self.gap_ns, gap_ns)

    def longest_ns(self, now_ns: Ns) -> Ns:
        """Return the longest gap of the last window or two, 0 without commands."""
        if now_ns - self.gaps_since_ns > 2 * GAP_WINDOW_NS:
            return 0
        if now_ns - self.gaps_since_ns > GAP_WINDOW_NS:
            return self.gap_ns
        return max(self.gap_ns, self.gap_before_ns)

    def add(self, name: str, now_ns: Ns, timeout_ns: Ns) -> Sender | None:
        """Return a new sender (it may replace another one), or None."""
        if len(self.senders) >= MAX_SENDERS:
            least = min(self.senders.values(), key=lambda other: other.worth(now_ns, timeout_ns))
            if least.worth(now_ns, timeout_ns)[0]:
                return None
            self.forgot_ns = max(self.forgot_ns, least.seen_ns)
            self.senders = {
                name: other for name, other in self.senders.items() if other is not least
            }
        added = self.senders[name] = Sender(Order(), 0)
        return added

    def announce(self, news: Announcement) -> None:
        """Note that a token has appeared or disappeared."""
        if not news.present:
            self.announced.pop(news.sender, None)
        elif news.sender in self.announced or len(self.announced) < MAX_ANNOUNCED:
            self.announced[news.sender] = news.at_ns

    def was_silent(self, sender: Sender, command: Command, since_ns: Ns) -> bool:
        """Return whether the silence before a command is proved to be its sender's.

        `since_ns`: the daemon stood still until then.
        """
        now_ns = command.arrived_ns
        if now_ns - sender.seen_ns < NEUTRAL_PAUSE_NS:
            return False
        if sender.follows_rest(command):
            return True
        if command.bridged:
            others = [each.seen_ns for each in self.senders.values() if each.bridged]
            name, quiet_ns, lease_ns = BRIDGES, max([self.forgot_ns, *others]), BRIDGE_LEASE_NS
        elif command.ros and not sender.number:
            name, quiet_ns, lease_ns = command.sender, self.forgot_ns, RMW_LEASE_NS
        else:
            return False
        announced_ns = self.announced.get(name)
        return (
            announced_ns is not None and now_ns - max(quiet_ns, announced_ns, since_ns) >= lease_ns
        )


class Arbiter(Struct):
    """Stores the latest command of each sender, and chooses the command that the robot follows."""

    sources: dict[str, SourceSenders] = {}
    holder: tuple[str, str] = NOBODY  # source that drives or waits, and sender that drives
    follows: bool = False  # the last choice has the twist of this sender
    since_ns: Ns = 0  # zeros from then on arm
    caught_up_ns: Ns = 0  # until then, commands may arrive that waited during the last stall
    resumed_ns: Ns = 0  # end of the last time in which the daemon stood still
    until_ns: Ns = 0  # the last `choose` holds until then, unless another method is called

    def require_neutral(self, since_ns: Ns = 0) -> None:
        """Forget all commands: each sender must be neutral from `since_ns` on.

        An older zero, for example from before a stop was cleared, does not show that the sender
        wants rest now. The latest `since_ns` counts.
        """
        self.since_ns = max(self.since_ns, since_ns)
        for source in self.sources.values():
            for sender in source.senders.values():
                sender.require_neutral()
        self.holder, self.until_ns = NOBODY, 0

    def forget_clocks(self) -> None:
        """Measure the delays of all senders without an echo anew."""
        for source in self.sources.values():
            source.ages = Ages()

    def announce(self, news: Announcement) -> None:
        """Note that the token of a ROS publisher has appeared or disappeared."""
        self.sources.setdefault(news.source, SourceSenders()).announce(news)

    def resume(self, before_ns: Ns, now_ns: Ns, commands: CommandsConfig) -> None:
        """Begin a late step, before which the bus may not have delivered all commands."""
        self.until_ns, self.caught_up_ns = 0, now_ns + CATCH_UP_NS
        self.resumed_ns = now_ns
        for settings in commands.sources:
            if (source := self.sources.get(settings.name)) is not None:
                for sender in source.senders.values():
                    sender.resume(before_ns, now_ns, timeout_ns(settings))

    def accept(self, command: Command, commands: CommandsConfig) -> Wait | None:
        """Process a command. Return None if it is accepted, otherwise why it is refused."""
        until_ns, self.until_ns = self.until_ns, 0
        for settings in commands.sources:
            if settings.name == command.source:
                break
        else:
            return Wait("unknown_source", command.source)
        if not (math.isfinite(command.twist.linear) and math.isfinite(command.twist.angular)):
            self.notice(command.source, command.sender, command.arrived_ns)
            return Wait("not_finite", command.source)
        if (source := self.sources.get(command.source)) is None:
            source = self.sources[command.source] = SourceSenders()
        now_ns, timeout, zero = command.arrived_ns, timeout_ns(settings), is_zero(command)
        sender = source.senders.get(command.sender) or source.add(command.sender, now_ns, timeout)
        if sender is None:
            source.forgot_ns = max(source.forgot_ns, now_ns)
            return Wait("too_many_senders", command.source, MAX_SENDERS)
        neutral, pauses = zero and now_ns >= self.since_ns, settings.neutral_first == "pause"
        # A filter of Nav2 sends zeros in mid-goal, such as collision_monitor without transforms.
        waits = command.shared or (pauses and command.ros)
        if pauses:
            sender.find_gap(command)
            if not zero and now_ns >= self.since_ns and not sender.is_armed(now_ns):
                neutral = source.was_silent(sender, command, self.resumed_ns)
        sender.receive(command)
        if now_ns - sender.refused_ns > SILENT_NS:
            sender.hint = None  # silence disarms also a sender whose zero was not proven yet
        if command.shared and not zero:
            for other in source.senders.values():
                if other.shared:
                    other.cancel_zero(now_ns)
        elif waits and not zero:
            sender.cancel_zero(now_ns)
        stalled = not zero and now_ns < self.caught_up_ns
        verdict = source.ages.judge_age(command, sender.order, timeout, stalled)
        if verdict:
            if neutral and verdict in ("unproven", "early"):
                _keep_hint(sender, command, timeout)
            why = _refusal(verdict, command, source.ages, sender.order, settings)
            sender.refuse(command, why)
            return why
        if (
            self.follows
            and (command.source, command.sender) == self.holder
            and sender.repeats(command, timeout)
            and not command.shared
            and sender.hint is None
        ):
            # Only the time of the sender that drives is newer, so the choice holds even longer.
            self.until_ns = until_ns
        if sender.arrived_ns is not None and sender.twist != REST:
            source.note_gap(now_ns - sender.arrived_ns, now_ns)
        sender.take(command, timeout)
        if sender.hint is not None:
            _accept_hint(sender, command, source.ages, timeout, waits=waits)
        if neutral:
            sender.neutral(now_ns, zero, waits)
        return None

    def arrived_ns(self, choice: Choice) -> Ns | None:
        """Return the arrival of the newest command of the sender that drives, None without one."""
        if choice.twist is None:
            return None
        return self.sources[choice.source].senders[choice.sender].arrived_ns

    def notice(self, source: str, sender: str, arrived_ns: Ns) -> None:
        """Record that a message of a sender was lost or unusable; it may have been a speed.

        It cancels the zero of its own identity only: a program that sends only such messages must
        not keep the others of the source from being armed.
        """
        self.until_ns = 0
        known_source = self.sources.get(source)
        known = None if known_source is None else known_source.senders.get(sender)
        if known_source is not None and known is None:
            known_source.forgot_ns = max(known_source.forgot_ns, arrived_ns)
        if known is not None:
            known.seen_ns = max(known.seen_ns, arrived_ns)
            known.cancel_zero(arrived_ns)

    def choose(self, now_ns: Ns, commands: CommandsConfig) -> Choice:
        """Return the command that the robot follows now, or the reason why it follows none.

        The result is the same until `until_ns`.
        """
        until_ns, best, first = FOREVER_NS, None, None
        for settings in commands.sources:
            source = self.sources.get(settings.name)
            if source is None:
                continue
            timeout = timeout_ns(settings)
            for name, sender in source.senders.items():
                until_ns = min(until_ns, _changes_ns(sender, now_ns, timeout))
                if not sender.is_present(now_ns, timeout):
                    continue
                rank = (
                    -settings.priority,
                    not sender.is_armed(now_ns),
                    (settings.name, name) != self.holder,
                    sender.came_ns,
                )
                if best is None or rank < best:
                    best, first = rank, (settings, name, sender)
        self.until_ns, self.follows = until_ns, False
        if first is None:
            self.holder = NOBODY
            for settings in ranking(commands):
                if (wait := self._refused(settings, now_ns)) is not None:
                    return Choice(wait=wait)
            return IDLE
        settings, name, sender = first
        armed = sender.is_armed(now_ns)
        self.holder = settings.name, name if armed else ""
        if not (armed and sender.is_live(now_ns, timeout_ns(settings))):
            return Choice(settings.name, None, _wait(sender, settings, now_ns), name)
        self.follows = True
        wait, since_ns = NOTHING, sender.zeros_ns
        if since_ns is not None and now_ns - since_ns >= LASTING_NS:
            kept = self._without_effect(now_ns, commands)
            wait = Wait("zeros", settings.name, kept=kept)
        return Choice(settings.name, sender.twist, wait, name)

    def _refused(self, settings: Source, now_ns: Ns) -> Wait | None:
        # Why the newest command of a source that is not live was refused.
        senders = self.sources.get(settings.name, SourceSenders()).senders.values()
        refused = [
            sender
            for sender in senders
            if sender.refused and now_ns - sender.refused_ns <= timeout_ns(settings)
        ]
        return max(refused, key=lambda sender: sender.refused_ns).refused if refused else None

    def _present(self, settings: Source, now_ns: Ns) -> dict[str, Sender]:
        timeout = timeout_ns(settings)
        senders = self.sources.get(settings.name, SourceSenders()).senders
        return {
            name: sender for name, sender in senders.items() if sender.is_present(now_ns, timeout)
        }

    def _without_effect(self, now_ns: Ns, commands: CommandsConfig) -> str:
        # The source, or another sender of it, that sends speeds while the one that drives sends
        # zeros.
        for settings in ranking(commands):
            for name, sender in self._present(settings, now_ns).items():
                if (settings.name, name) != self.holder and sender.twist != REST:
                    same = settings.name == self.holder[0]
                    return f"another sender of {settings.name}" if same else settings.name
        return ""

    def status(self, now_ns: Ns, commands: CommandsConfig) -> tuple[SourceStatus, ...]:
        """Return the status of each source, the highest priority first."""
        return tuple(self._status(settings, now_ns, commands) for settings in ranking(commands))

    def _status(self, settings: Source, now_ns: Ns, commands: CommandsConfig) -> SourceStatus:
        source = self.sources.get(settings.name, SourceSenders())
        came = [
            (s.arrived_ns, s.twist) for s in source.senders.values() if s.arrived_ns is not None
        ]
        latest_ns, twist = max(came, key=lambda pair: pair[0], default=(None, None))
        return SourceStatus(
            settings.name,
            settings.priority,
            None if latest_ns is None else max(0, now_ns - latest_ns) / NS_PER_S,
            self._waits_for(settings, now_ns, commands),
            twist,
            source.longest_ns(now_ns) / NS_PER_S,
        )

    def _waits_for(self, settings: Source, now_ns: Ns, commands: CommandsConfig) -> Wait:
        present, (holder, name) = self._present(settings, now_ns), self.holder
        if not present:
            return self._refused(settings, now_ns) or COMMAND
        first = present.get(name) if holder == settings.name else None
        first = first or min(
            present.values(), key=lambda each: (not each.is_armed(now_ns), each.came_ns)
        )
        if not (first.is_armed(now_ns) and first.is_live(now_ns, timeout_ns(settings))):
            return _wait(first, settings, now_ns)
        if holder in ("", settings.name):
            return Wait("senders", senders=len(present) - 1) if len(present) > 1 else NOTHING
        equal = any(s.name == holder and s.priority == settings.priority for s in commands.sources)
        return Wait("equal" if equal else "higher", holder)


def timeout_ns(settings: Source) -> Ns:
    return int(settings.timeout * NS_PER_S)


def ranking(commands: CommandsConfig) -> list[Source]:
    return sorted(commands.sources, key=lambda settings: -settings.priority)


def _keep_hint(sender: Sender, command: Command, timeout: Ns) -> None:
    # The first one counts, unless a later one shows that it was late.
    hint, delay = sender.hint, command.arrived_ns - (command.stamp_ns or 0)
    if hint is None or hint.clock != command.clock or hint.delay - delay > timeout:
        sender.hint = Hint(is_zero(command), command.arrived_ns, delay, command.clock)


def _accept_hint(sender: Sender, command: Command, ages: Ages, timeout: Ns, *, waits: bool) -> None:
    # Now the clock is proven, so it is known whether the sender's zero was late.
    hint, clock = sender.hint, ages.clocks.get(command.clock)
    sender.hint = None
    if hint is None or hint.clock != command.clock or clock is None or clock.least is None:
        return
    if hint.delay - clock.least <= timeout:
        sender.neutral(hint.at_ns, hint.zero, waits)


def _refusal(
    verdict: AgeCode, command: Command, ages: Ages, order: Order, settings: Source
) -> Wait:
    seconds, note, clock = settings.timeout, "", ages.clocks.get(command.clock)
    if verdict in ("too_old", "round_trip"):
        seconds = round((timeout_ns(settings) + MARGIN_NS) / NS_PER_S, 3)
        note = f"{math.ceil(order.round_trip_ns / NS_PER_S * 10) / 10:g}"
    elif verdict == "set_back" and clock is not None:
        seconds = round(clock.behind / NS_PER_S, 1)
    elif verdict == "stamps" and clock is not None:
        note = f"by {clock.advance:.1f} s in a second" if clock.advance else "they stand still"
    elif verdict == "too_many_clocks":
        note = f"{MAX_CLOCKS}"
    return Wait(verdict, settings.name, seconds, kept=note)


def _wait(sender: Sender, settings: Source, now_ns: Ns) -> Wait:
    # Why a sender that takes part in the choice does not drive.
    if not sender.is_live(now_ns, timeout_ns(settings)):
        return sender.refused or Wait("stalled", settings.name)
    since_ns = sender.speeds_ns
    return Wait(
        "neutral",
        settings.name,
        NEUTRAL_PAUSE_NS / NS_PER_S,
        lasts=since_ns is not None and now_ns - since_ns >= LASTING_NS,
        ros=sender.ros,
        shared=sender.shared,
        pause=settings.neutral_first == "pause",
    )


def _changes_ns(sender: Sender, now_ns: Ns, timeout: Ns) -> Ns:
    until_ns = sender.changes_ns(now_ns, timeout)
    for since_ns in (sender.zeros_ns, sender.speeds_ns):
        if since_ns is not None and now_ns < since_ns + LASTING_NS:
            until_ns = min(until_ns, since_ns + LASTING_NS)
    return until_ns
