"""Compares the reason of a resting robot with the true cause, while a sender sends speeds.

The documentation says that `state` has the code of each refusal, in `code` or in the source's
`wait`. A code is right if the true events allow it. The module knows which senders stamp, how
constant their delays are, when each message arrived, and when the last other event happened.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.simulate.ages import HOUR_NS, MARGIN_NS
from tests.simulate.promises import BrokenError
from tests.simulate.roads import FOREIGN, NS, Message, Sample

if TYPE_CHECKING:
    from tests.simulate.actors import Run

LATE = (
    "no_echo", "other_run", "from_future", "too_old", "round_trip", "not_newer", "copied", "early",
    "stale", "set_back", "stamps",
)  # fmt: skip

KINDS = {
    "nothing": "", "no_command": "command", "higher": "priority", "equal": "priority",
    "unproven": "proof",
} | dict.fromkeys(LATE, "late")  # fmt: skip
"""The codes whose kind of cause has another name."""

BUMPERS = ("bumper_away", "bumper_blocks")
"""The codes in `state` that hide the one of the source."""

EVERY_NS = NS // 5
"""Time between two looks at `state`, which takes longer to build than a step."""

STEADY_NS = 15_000_000
"""Range of the true delays of a sender whose commands are certainly never late."""

PROOF = 10
"""Number of commands after which a proof through jitter is certainly over."""

FORGOTTEN_NS = HOUR_NS - NS
"""After a silence of this length a clock may be new again."""


class _Clock:
    """The true delays of one sender's stamps since the daemon started."""

    def __init__(self, at_ns: int, delay_ns: int) -> None:
        self.first_ns = self.last_ns = at_ns
        """Arrival of the first message from which its proof may begin, and of the last one."""
        self.least_ns = self.most_ns = delay_ns
        self.count = 0
        """Messages since `first_ns`."""
        self.proved = False
        """Its proof was certainly over once."""
        self.unsure = False
        """Its proof may have been over before a silence, or not."""
        self.believed = False
        """Its proof may have been over when one of its commands arrived."""
        self.odd = False
        """It is adjusted or shared, or its messages overtake each other."""

    @property
    def steady(self) -> bool:
        return not self.odd and self.most_ns - self.least_ns <= STEADY_NS

    def is_proved(self, at_ns: int, timeout_ns: int) -> bool:
        """Return whether the daemon certainly had proved this clock's delays at this time.

        Only commands prove them: the time since the last one does not count.
        """
        lasted = min(at_ns, self.last_ns) - self.first_ns
        return self.steady and lasted > 5 * timeout_ns + NS and self.count >= PROOF

    def may_be_known(self, at_ns: int, timeout_ns: int) -> bool:
        """Return whether the daemon may have proved this clock's delays at this time."""
        return self.odd or self.unsure or at_ns - self.first_ns > timeout_ns - MARGIN_NS


class _LastMessage:
    """The last message of one sender on one source."""

    def __init__(self) -> None:
        self.arrived_ns = self.speed_ns = -1
        """Arrival of the last command, and of the last one that is a speed."""
        self.armed_ns = -1
        self.clock: _Clock | None = None
        self.foreign = self.shared = False
        self.own = True
        """The identity is certainly the sender's own, or certainly not. A router that the robot
        does not know stamps like a session, so the robot may let such a zero wait for its pause."""
        self.stamped = False
        """A program of this identity has stamped its commands: its zeros may have been late."""
        self.echoes = False
        self.old_ns = -NS
        """Arrival of the last command whose echo was too old, or of another run."""


def named_source(state: dict[str, Any]) -> str:
    """Return the source that the reason of a resting robot is about; "" if there is none."""
    waiting = (row["name"] for row in state["sources"] if row["wait"] == state["code"])
    return state["source"] or next(waiting, "")


class Reasons:
    """The messages that one daemon received, and the judge of the reasons that it publishes."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._ready_ns = self._looked_ns = self._calm_ns = -1
        self._stalled_ns = -100 * NS
        self._clocks: dict[str, _Clock] = {}
        self._known_before: set[str] = set()
        """Clocks whose proof may have been over before the robot's clock stood. The daemon compares
        their next commands with the delays from before, and does not take them for new."""
        self.restart()

    def restart(self, stood: bool = False) -> None:
        """Forget all senders: a daemon starts, has executed `activate`, or slept (`stood`).

        After a sleep the daemon still remembers the old delays, so all delays look changed to it.
        """
        self._stood = stood
        if stood:
            believed = (name for name, clock in self._clocks.items() if clock.believed)
            self._known_before.update(believed)
        else:
            self._known_before.clear()
        self._clocks.clear()
        self._heard: dict[str, dict[str, _LastMessage]] = {}
        self._dropped_ns: dict[str, int] = {}
        """When a message of a source was last dropped unread. It may have been a speed, so a shared
        identity must send a zero again."""
        self._junk: set[str] = set()
        """Sources with refused messages, any of which may undo the zero of a shared identity."""

    def command(self, sender: dict[str, Any], message: Message, sample: Sample) -> None:
        """Record a command. The caller has passed it to the witness before."""
        source = sender["source"]
        if message.junk or sender.get("bad_stamps"):
            self._junk.add(source)
        if message.junk not in ("", "cancels") or sender["churn"]:
            return
        wish = self.run.witness.wishes[-1][1]
        at_ns, delay_ns = wish.arrived_ns, wish.arrived_ns - message.sent_ns
        record = self._heard.setdefault(source, {}).setdefault(sample.identity, _LastMessage())
        record.arrived_ns, record.armed_ns = at_ns, wish.armed_ns
        record.shared = sample.shared
        record.stamped |= bool(sample.clock)
        record.foreign, record.own = sender["way"] in FOREIGN, sender["way"] != "zenoh"
        record.echoes = sample.beat is not None
        if sample.beat is not None:
            timeout_ns, (_, beat_ns) = self.run.witness.timeout[source], sample.beat
            old = at_ns - beat_ns > timeout_ns - MARGIN_NS
            if old or beat_ns <= self.run.witness.born_ns:
                record.old_ns = at_ns
        if wish.v or wish.w:
            record.speed_ns = at_ns
        if not sample.clock:
            record.clock = None
            return
        clock = self._clock(sample.clock, at_ns, delay_ns)
        wild = (sender.get(name) for name in ("clock", "twice", "swap", "bad_stamps"))
        clock.odd |= any(wild) or sender.get("stamps_speeds", False)
        clock.odd |= sample.clock in self.run.witness.shared_clocks
        clock.proved |= clock.is_proved(at_ns, self.run.witness.timeout[source])
        clock.believed |= clock.may_be_known(at_ns, self.run.witness.timeout[source])
        record.clock = clock

    def dropped(self, key: str, at_ns: int) -> None:
        """Note that the inbox dropped a message on this key before a step read it."""
        self._dropped_ns[key.split("/")[1]] = at_ns

    def _clock(self, name: str, at_ns: int, delay_ns: int) -> _Clock:
        """Add a delay to the clock of this name, and return the clock."""
        clock = self._clocks.get(name)
        if clock is None:
            clock = self._clocks[name] = _Clock(at_ns, delay_ns)
            clock.unsure = name in self._known_before
        silent_ns = at_ns - clock.last_ns
        if silent_ns > FORGOTTEN_NS:
            # Its proof may begin again, unless it was over.
            clock.first_ns, clock.unsure, clock.proved, clock.count = at_ns, True, False, 0
        clock.last_ns = at_ns
        clock.count += 1
        clock.least_ns = min(clock.least_ns, delay_ns)
        clock.most_ns = max(clock.most_ns, delay_ns)
        return clock

    def judge(self, now_ns: int, stalled_ns: int) -> None:
        """Judge `state` if the robot has been ready for a while although a sender sends speeds."""
        run, witness = self.run, self.run.witness
        if witness.mode != "ready":
            self._ready_ns = -1
            return
        if self._ready_ns < 0:
            self._ready_ns = now_ns
        tick_ns = 2 * witness.period_ns + MARGIN_NS
        if now_ns - max(self._ready_ns, self._looked_ns + EVERY_NS) < tick_ns:
            return
        if witness.pending or witness.churned or stalled_ns > now_ns - NS:
            return
        self._looked_ns, self._stalled_ns = now_ns, stalled_ns
        # A board that greets after a reset disarms all, and then the robot becomes ready again.
        self._calm_ns = max(run.liveness.event_ns, stalled_ns, self._ready_ns)
        wishing = [
            source
            for source, senders in self._heard.items()
            for record in senders.values()
            if self._waits(source, record, now_ns, tick_ns)
        ]
        if wishing:
            self._judge(now_ns, wishing, run.product.state())

    def _waits(self, source: str, record: _LastMessage, now_ns: int, tick_ns: int) -> bool:
        """Return whether the daemon certainly has a fresh speed of this sender."""
        age_ns = now_ns - record.speed_ns
        return (
            record.speed_ns == record.arrived_ns > self._calm_ns + tick_ns
            and tick_ns < age_ns < self.run.witness.timeout[source] - tick_ns
            and not (record.clock and record.clock.odd)
        )

    def _judge(self, now_ns: int, wishing: list[str], state: dict[str, Any]) -> None:
        """Compare the codes of `state` with the possible causes."""
        self.run.counts["reason looks"] += 1
        name = "every refusal has its reason in state"
        waits = {row["name"]: KINDS.get(row["wait"], row["wait"]) for row in state["sources"]}
        for source in wishing:
            allowed = self.allowed(source, now_ns)
            if waits[source] not in allowed:
                text = f"{source} waits for {waits[source]!r}, allowed is {sorted(allowed)}"
                raise BrokenError(name, now_ns, text)
        kind, named = KINDS.get(state["code"], state["code"]), named_source(state)
        if state["code"] in BUMPERS:
            kind = waits.get(named, "")
        allowed = self.allowed(named, now_ns) - {"priority"} if named in waits else set()
        if kind not in allowed:
            text = f"{state['reason']!r}, allowed is {sorted(allowed)}, {wishing} wish a speed"
            raise BrokenError(name, now_ns, text)

    def allowed(self, source: str, now_ns: int) -> set[str]:
        """Return the kinds of causes for which this source may wait now."""
        witness, causes = self.run.witness, set[str]()
        timeout_ns = witness.timeout[source]
        for sender in self._fresh_senders(source, now_ns):
            clock, certain = sender.clock, not (sender.shared and source in self._junk)
            if sender.echoes:
                odd = clock is not None and clock.odd
                # A zero that is not newer than what another program of this identity sent, or that
                # a command overtook, is refused and arms nothing.
                certain &= sender.armed_ns > sender.old_ns and not odd
                if odd or now_ns - sender.old_ns < 2 * timeout_ns + MARGIN_NS:
                    causes.add("late")
            elif clock is None:
                certain &= not sender.stamped
            else:
                certain &= clock.is_proved(sender.armed_ns, timeout_ns)
                may_be_known = not sender.foreign or clock.may_be_known(now_ns, timeout_ns)
                if may_be_known and (not clock.steady or self._stood):
                    causes.add("late")
                # A foreign clock that was known is not new again, however late it becomes.
                if not (clock.is_proved(now_ns, timeout_ns) or (sender.foreign and clock.proved)):
                    causes.add("proof")
            since_ns = max(self._calm_ns, self._dropped_ns.get(source, -1) if sender.shared else -1)
            armed = sender.armed_ns > since_ns and certain
            if not (armed and sender.own) or source in witness.pausing:
                causes.add("neutral")
        if now_ns - self._stalled_ns < timeout_ns + MARGIN_NS and any(
            sender.arrived_ns <= self._stalled_ns for sender in self._heard.get(source, {}).values()
        ):
            # A stall prolongs the place of a sender that has not sent since.
            causes.add("stalled")
        mine = witness.priority[source]
        for other, priority in witness.priority.items():
            if other != source and priority >= mine and self._fresh_senders(other, now_ns):
                causes.add("priority")
        return causes

    def _fresh_senders(self, source: str, now_ns: int) -> list[_LastMessage]:
        """Return the senders of this source whose last command may still be fresh."""
        longest_ns = self.run.witness.timeout[source] + MARGIN_NS
        senders = self._heard.get(source, {}).values()
        return [sender for sender in senders if now_ns - sender.arrived_ns <= longest_ns]
