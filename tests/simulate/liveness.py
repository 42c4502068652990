"""The promises that the robot does drive, and that each lost message is counted.

A lawful sender obeys all rules and has the highest priority. During a plan it must move the robot
if nothing else has happened for 3 s. Only the events that the documentation names disarm it. At the
end of each plan all faults end, an operator releases all latches, and a lawful sender must drive.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from tests.simulate.ages import MARGIN_NS, Wish
from tests.simulate.product import START_NS, WALL_OFFSET_NS
from tests.simulate.promises import BrokenError
from tests.simulate.reports import judge_counts
from tests.simulate.roads import ECHOING, FOREIGN, NS, Message, Sample

if TYPE_CHECKING:
    from tests.simulate.actors import Run

MOST_HELD = 1500
"""Most entries that a container of the daemon may have.

The largest one has the last 1024 sender ids with their certificates.
"""

LONGEST_BUFFER = 1024
"""Longest byte buffer that the daemon may hold.

A board sends more than that in 3.5 s without an end of line.
"""

LONGEST_TEXT = 1024
"""Longest text that the daemon may hold if it has given no long reason. A reason with several
causes of a fault is longer, and other texts quote it."""

LONGEST_REASON = 4096
"""Longest reason that the daemon may give."""

SETTLES_NS = 3 * NS
"""After the last event a lawful sender drives within this time."""

SILENT_NS = 10 * NS - MARGIN_NS
"""After a silence of this length a sender may have to send a zero again."""

PROOF_NS = 2 * NS
"""A new sender shows a steady delay for this time before its commands count, or for the timeout of
its source and a second, if that is longer."""

CHARGED_NS = 15 * NS
"""The mean of a battery that was empty rises above all thresholds within this time."""

PAUSE_NS = 3 * NS // 20
"""Longest time between two commands of a sender that does not pause, unless it sends more seldom
than ten times a second."""

PROOF_COUNT = 4
"""Number of commands that a new sender needs for its proof, if it sends so seldom that they take
longer than `PROOF_NS`."""

UNSHARED = (*ECHOING, "plain", "bridge")
"""Ways without a foreign clock, whose adjustment would ask its sender for a zero."""

QUIET_FAULTS = {
    "mute", "pushed", "slow_reply", "ftdi", "stalls", "sparse_replies", "lost_replies",
    "stuck_encoder", "frozen_encoder", "reversed_motor", "reversed_encoder", "bias",
    "swapped_motors", "swapped_encoders", "late_watchdog", "no_watchdog",
}  # fmt: skip
"""Faults of the board that ask no sender for a zero, unless the board is silent for 1 s or a fault
is latched. Others damage lines, so that they may look like a silent board or a reset, or no wheel
begins to move, which asks for one after 3 s."""

TROUBLE_NS = 2 * NS
"""After another fault of the board, and after a reset, the daemon knows within this time that the
link was lost or that the board has started again."""

ASKS_NS = 3 * NS // 2
"""Longest time for which the daemon asks a board without a check for its check."""


class Liveness:
    """Judges that a lawful sender drives, and judges counters and memory at the end of a plan."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._event_ns = 0
        self._disarmed_ns = 0
        """Until then an event may ask each sender for a zero."""
        self._stall = -NS, -NS
        """Begin and end of the host's last stall. Zeros that came meanwhile may be lost."""
        self._interrupted: dict[str, int] = {}
        """Arrival of each sender's last zero that a stall may have taken, or its pause."""
        self._armed: dict[str, int] = {}
        """Arrival of the zero by which each lawful sender is certainly armed."""
        self._since: dict[str, int] = {}
        """Since when each lawful sender has wished a speed without a pause."""
        self._began: dict[str, int] = {}
        """Time of the first command behind each lawful sender's last silence."""
        self._latest: dict[str, tuple[int, str]] = {}
        self._silent_ns: dict[str, int] = {}
        """Arrival of each lawful sender's last command before a silence that disarms it."""
        self._pauses = {
            sender["name"]: max(PAUSE_NS, int(1.2 * NS / sender["hz"]))
            for sender in run.plan["senders"]
        }
        """Longest time between two commands of each sender that does not pause."""
        self._proofs = {
            sender["name"]: max(
                PROOF_NS,
                NS + run.witness.timeout[sender["source"]],
                int(PROOF_COUNT * NS / sender["hz"]),
            )
            for sender in run.plan["senders"]
            if sender["way"] in FOREIGN
        }
        self._followed_ns: dict[str, int] = {}
        """When the robot last followed each of these senders."""

    @property
    def event_ns(self) -> int:
        """The time of the last event."""
        return self._event_ns

    def event(self, lasts_ns: int = 0, *, disarms: bool = True) -> None:
        """Note an event that is not a command.

        If it `disarms`, it may disarm all senders at any time in the next `lasts_ns`.
        """
        now_ns = self._event_ns = self.run.true_ns
        if disarms:
            # The daemon sees it behind a stall only.
            until_ns = max(now_ns + lasts_ns, self._stall[1])
            self._disarmed_ns = max(self._disarmed_ns, until_ns)

    def stalls(self, until_ns: int) -> None:
        """Note that the host stalls until `until_ns`, so the daemon reads recent messages late."""
        now_ns = self.run.true_ns
        begun_ns = self._stall[0] if now_ns <= self._stall[1] else now_ns
        self._stall = begun_ns, max(self._stall[1], until_ns)
        if self._disarmed_ns > now_ns - self._tick_ns:
            self._disarmed_ns = max(self._disarmed_ns, until_ns)
        for name, zero_ns in list(self._armed.items()):
            if zero_ns > begun_ns - self._tick_ns:
                del self._armed[name]

    @cached_property
    def lawful(self) -> set[str]:
        """The names of the senders that obey all rules and have no rival."""
        return {sender["name"] for sender in self.run.plan["senders"] if self._keeps_rules(sender)}

    @property
    def _tick_ns(self) -> int:
        return self.run.witness.period_ns + MARGIN_NS

    def command(self, sender: dict[str, Any], sample: Sample) -> None:
        """Record a command of a lawful sender."""
        name = sender["name"]
        if name not in self.lawful:
            return
        wish = self.run.witness.wishes[-1][1]
        before_ns, _ = self._latest.get(name, (0, ""))
        if wish.arrived_ns - before_ns > SILENT_NS:
            self._silent_ns[name] = before_ns
        if wish.arrived_ns - before_ns > self._pauses[name]:
            self._since.pop(name, None)
            self._began[name] = wish.arrived_ns
        self._take_zero(name, wish)
        if not self._is_armed(name) or not (wish.v or wish.w):
            self._since.pop(name, None)
        else:
            proved_ns = self._began.get(name, 0) + self._proofs.get(name, 0)
            self._since.setdefault(name, max(wish.arrived_ns, proved_ns))
        self._latest[name] = wish.arrived_ns, sample.identity

    def _is_armed(self, name: str) -> bool:
        zero_ns = self._armed.get(name, -1)
        disarmed_ns = self._disarmed_ns + self._tick_ns
        return zero_ns > max(disarmed_ns, self._silent_ns.get(name, -1))

    def _take_zero(self, name: str, wish: Wish) -> None:
        """Record the zero that arms this sender, unless a stall may have hidden it."""
        zero_ns, (begun_ns, ended_ns) = wish.armed_ns, self._stall
        if self._is_armed(name) or zero_ns <= self._silent_ns.get(name, -1):
            return
        settled_ns = zero_ns + (NS if wish.shared else 0)
        if zero_ns <= ended_ns and settled_ns >= begun_ns - self._tick_ns:
            self._interrupted[name] = zero_ns
        elif self._interrupted.get(name) != zero_ns:
            self._armed[name] = zero_ns

    def _keeps_rules(self, sender: dict[str, Any]) -> bool:
        """Return whether this sender has a good network, an unshared clock and no rival."""
        run = self.run
        priority = run.witness.priority
        rivals = [
            rival
            for rival in run.plan["senders"]
            if rival["name"] != sender["name"]
            and not ("even" in sender and ("refused" in rival or rival["to"] < sender["from"]))
        ]
        return (
            (sender["way"] in UNSHARED or "seldom" in sender or "even" in sender)
            and not any(sender[bad] for bad in ("junk", "churn", "loss", "twice", "swap"))
            and not sender["congestion"]
            and not sender.get("bad_stamps")
            and sender["jitter"] < 0.01
            and (sender["hz"] >= 10.0 or "seldom" in sender)
            and sender["hz"] * run.witness.timeout[sender["source"]] / NS > 2.0
            and not (sender["way"] in ECHOING and self._round_trip_s(sender) < 2 * sender["delay"])
            and not any(rival["junk"] or rival["churn"] for rival in rivals)
            and all(priority[r["source"]] < priority[sender["source"]] for r in rivals)
        )

    def _round_trip_s(self, sender: dict[str, Any]) -> float:
        """Return the longest way of a beat and back with which the echo is surely young enough."""
        timeout_ns: int = self.run.witness.timeout[sender["source"]]
        return (timeout_ns - MARGIN_NS) / NS

    def judge(self, now_ns: int) -> None:
        """Check that the robot drives if a lawful sender has sent speeds for long enough."""
        run = self.run
        self._stays_armed(now_ns)
        if not self._since or run.active != run.lasting or run.witness.must_rest is not None:
            return
        # A `deactivate` that waits for the disk is in force before its answer.
        if not run.product.plugged or run.witness.perhaps_latched or run.witness.pending:
            return
        for name, since_ns in self._since.items():
            heard_ns, identity = self._latest[name]
            quiet = now_ns - self._event_ns > SETTLES_NS
            if quiet and now_ns - since_ns > NS and now_ns - heard_ns < self._pauses[name]:
                run.counts["lawful looks"] += 1
                if now_ns - run.moved_ns > NS // 2:
                    text = f"{identity} since {since_ns / NS:.3f} s; {run.witness.reason}"
                    raise BrokenError("a lawful sender drives", now_ns, text)

    def _stays_armed(self, now_ns: int) -> None:
        """Check that a sender that the robot has followed stays armed until an event disarms it.

        The robot must have followed a speed. If it follows only a zero, the sender's clock may
        still turn out to be unproven.
        """
        run = self.run
        sender = run.followed.sender
        # Behind a stall the daemon may ask the board for its check, and finds the loss only then.
        asks = run.witness.mode == "waiting" and now_ns < self._stall[1] + ASKS_NS
        sole = sender is not None and self._sole_senders.get(sender["source"]) == sender["name"]
        if sender is not None and any(run.followed.wish or ()) and sole and not asks:
            self._followed_ns[sender["source"]] = now_ns
        witness = run.witness
        if witness.mode != "ready" or witness.code != "neutral" or witness.pending:
            return
        source = witness.source
        if not QUIET_FAULTS.issuperset(name for name, _ in run.active[len(run.lasting) :]):
            return
        followed_ns = self._followed_ns.get(source, -1)
        if now_ns - followed_ns > SILENT_NS - witness.timeout.get(source, 0):
            return
        if followed_ns > max(self._disarmed_ns, self._stall[1]) + self._tick_ns:
            text = f"{source} was followed at {followed_ns / NS:.3f} s; {witness.reason}"
            raise BrokenError("an armed sender stays armed", now_ns, text)

    @cached_property
    def _sole_senders(self) -> dict[str, str]:
        """Maps each source with only one sender to this sender's name. Foreign clocks are left out.

        The reason in `state` names a source but no sender, so with several senders it is ambiguous.
        """
        names: dict[str, str] = {}
        senders = self.run.plan["senders"]
        for source in {sender["source"] for sender in senders} - self.run.witness.churned:
            sender, *others = [sender for sender in senders if sender["source"] == source]
            if not others and sender["way"] in UNSHARED and not sender.get("bad_stamps"):
                names[source] = sender["name"]
        return names

    def end(self) -> None:
        """End all faults, release all latches, and check that a lawful sender drives."""
        run = self.run
        run.epilogue = True
        product, end_ns = run.product, run.true_ns
        if not product.alive:
            run.run_to(max(at for at, _, _ in run.todo) if run.todo else end_ns)
        run.run_to(run.true_ns + NS // 2)
        # Messages that came while a step stalled wait for the next step.
        run.run_to(run.true_ns + NS // 10)
        if not product.plugged:
            run.plug(False)
        product.disk.fill(False)
        judge_counts(run.true_ns, product.state(), run.witness.delivered - product.dropped)
        run.reports.judge_junk(run.true_ns, product.state(), product.dropped)
        self.weigh()
        boots_ns = int(2.5 * NS)
        # The last sender of a source keeps it for the source's timeout.
        run.run_to(run.true_ns + max(boots_ns, *run.witness.timeout.values()))
        if "battery" in run.plan["config"]:
            run.run_to(run.true_ns + CHARGED_NS)
        clears_ns = run.true_ns
        for _ in range(3):
            verbs = {"fault": "clear", "stopped": "clear", "inactive": "activate"}
            verb = verbs.get(product.state()["mode"])
            if verb:
                run.call({"verb": verb, "named": True, "by": "op", "via": "native",
                            "late": 0.0, "lost": False, "twice": False})  # fmt: skip
            run.run_to(run.true_ns + NS // 10)
        self._drive_lawfully(clears_ns)

    def weigh(self) -> None:
        """Check that no container, text or buffer in the daemon has grown too large."""
        run = self.run
        size, kind, text, buffer = run.product.largest()
        for name, length in (("container", size), ("text", text), ("buffer", buffer)):
            run.counts[f"largest {name}"] = max(run.counts[f"largest {name}"], length)
        if size > MOST_HELD:
            raise BrokenError("memory is bounded", run.true_ns, f"a {kind} of {size} entries")
        longest = LONGEST_TEXT + 2 * min(run.longest_reason, LONGEST_REASON)
        if text > longest or buffer > LONGEST_BUFFER:
            sizes = f"a text of {text} letters, a buffer of {buffer} bytes"
            raise BrokenError("memory is bounded", run.true_ns, sizes)

    def _drive_lawfully(self, clears_ns: int) -> None:
        """Let a lawful sender send zeros and a speed, and check that the robot drives.

        An operator has released the latches since `clears_ns`.
        """
        run = self.run
        plan, begin_ns = run.plan, run.true_ns
        source = plan["config"]["commands"]["sources"][0]["name"]
        sender = {
            "name": "lawful", "id": "lawful/1", "way": "client", "source": source, "wheels": False,
            "form": "json", "ahead": 0.0, "drift": 0.0, "clock": [], "churn": False, "delay": 0.002,
        }  # fmt: skip
        own = [
            candidate
            for candidate in plan["senders"]
            if candidate["way"] in ("client", "page")
            and not (
                candidate["churn"]
                or candidate["junk"]
                or candidate.get("bad_stamps")
                or candidate["id"] in run.witness.shared_clocks
            )
        ]
        number = 10**6
        if plan["lawful"] != "a new client" and own:
            sender = own[0]
        zeros_s = 2.0
        step_ns = min(50_000_000, run.witness.timeout[sender["source"]] // 4)
        # A share above 1 shows whether the limits of before a restart are still in force.
        share = plan.get("share", 0.5)
        speed = share * run.witness.limits["linear_speed"]
        turn = share / 2 * run.witness.limits["angular_speed"]
        end_ns = begin_ns + int((zeros_s + 3.0) * NS)
        while run.true_ns < end_ns:
            zero = run.true_ns - begin_ns < zeros_s * NS
            now_ns = run.true_ns
            t = now_ns / NS
            number += 1
            v, w = (0.0, 0.0) if zero else (speed, turn)
            stamp_ns = (
                START_NS + WALL_OFFSET_NS + int((t + sender["ahead"] + sender["drift"] * t) * NS)
            )
            delay_ns = int(sender["delay"] * NS)
            message = Message(now_ns, now_ns + delay_ns, v, w, stamp_ns, number, "")
            run.at(now_ns + delay_ns, lambda m=message: run.deliver(sender, m))  # type: ignore[misc]
            run.run_to(now_ns + step_ns)
        mode, reason = run.witness.mode, run.witness.reason
        moving = run.true_ns - run.moved_ns < NS // 5
        if mode == "stopped" and run.witness.stops and run.witness.stops[-1] > clears_ns:
            return  # a stop of the plan was still under way
        if mode == "inactive" and run.witness.offs and run.witness.offs[-1] > begin_ns:
            return  # a switching off of the plan was still under way (seed 182028330)
        if run.witness.armed_since_ns > begin_ns:
            return  # an event of the plan that came late asks each sender for a new zero
        if mode != "driving" or not moving:
            raise BrokenError("a lawful sender drives", run.true_ns, f"{mode}: {reason}")
        self._check_course(speed, turn)
        run.counts["lawful drives"] += 1
        run.run_to(run.true_ns + NS)

    def _check_course(self, speed: float, turn: float) -> None:
        """Check that the robot drives as commanded, or slower on the same curve."""
        run = self.run
        witness, limits = run.witness, run.witness.limits
        twist, target = witness.twist(witness.last), witness.clamped(speed, turn)
        takes_s = (
            target[0] / limits["linear_acceleration"] + target[1] / limits["angular_acceleration"]
        )
        if takes_s > 2.5 or limits.get("linear_jerk") or limits.get("angular_jerk"):
            return
        room = witness.radius * 0.02, witness.radius * 0.02 / witness.half
        if any(abs(a - b) > r for a, b, r in zip(twist, target, room, strict=True)):
            raise BrokenError("the robot drives as told", run.true_ns, f"{twist} for {target}")
