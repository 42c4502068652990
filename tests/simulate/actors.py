"""Plays a plan: it acts as the senders, the networks, the operators, the board and the host.

Its times are true times, which continue while the host sleeps. `Run.play` returns how often each
kind of event occurred. It raises `BrokenError` at the first broken promise, and also if the daemon
raises an exception.
"""

from __future__ import annotations

import gc
import hashlib
import heapq
import json
import struct
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec

from tests.simulate.beats import Beats
from tests.simulate.board_inputs import Inputs, kinds
from tests.simulate.causes import Call, Cause, Causes
from tests.simulate.course import Course
from tests.simulate.damage import Damage
from tests.simulate.excess import Excess
from tests.simulate.followed import Followed
from tests.simulate.liveness import QUIET_FAULTS, TROUBLE_NS, Liveness
from tests.simulate.log_lines import LogLines
from tests.simulate.plan import Plan
from tests.simulate.plugging import Plugging
from tests.simulate.pose import LIARS, PoseWitness
from tests.simulate.product import START_NS, WALL_OFFSET_NS, Product, StepResult
from tests.simulate.promises import DIALECTS, INPUTS, BrokenError, Witness
from tests.simulate.reasons import Reasons
from tests.simulate.reports import Echo, HalfDuplex, Reports, judge_pose, judge_state
from tests.simulate.roads import (
    ECHOING,
    NS,
    Message,
    Sample,
    is_slewed,
    messages,
    parameters,
    read_reply,
    sample,
)
from tests.simulate.spread import Spread
from tests.simulate.wheels import FAULTS, Wheels

REPLAYED = 10
"""One plan in so many is recorded and replayed."""

RELEASING = {"clear", "activate", "deactivate", "set"}
"""Calls after which the robot may do more or less. Only the answer shows from when on. A `stop`
counts from its arrival on."""

PLACING = {"set_pose", "reset_odometry"}
"""Calls that set the pose."""

NO_TROUBLE = DIALECTS | INPUTS
"""Faults of the board that give no trouble."""


class Result(NamedTuple):
    """The result of a run."""

    seed: int
    finding: str
    """The promise that did not hold, when and how; "" if all did."""
    promise: str
    at_ns: int
    simulated_s: float
    cpu_s: float
    counts: Counter[str]


def collect_seldom() -> None:
    """Let Python collect garbage rarely, in a process that plays many plans.

    A run creates few reference cycles, and the usual collection takes 6 % of the time.
    """
    gc.freeze()
    gc.set_threshold(100_000)


def played(plan: Plan, log: Callable[[dict[str, Any]], None] | None = None) -> Result:
    """Play a plan in this process and return the result. `log` receives each step's outputs."""
    began = time.process_time()
    run = Run(plan, log)
    try:
        run.play()
        finding, promise, at_ns = "", "", run.true_ns
    except BrokenError as error:
        finding, promise, at_ns = str(error), error.promise, error.at_ns
    simulated_s = (run.true_ns - run.slept_ns) / NS
    cpu_s = time.process_time() - began
    return Result(plan["seed"], finding, promise, at_ns, simulated_s, cpu_s, run.counts)


def digest(plan: Plan) -> str:
    """Return a digest of all steps of a plan, which is the same in each product that acts alike."""
    steps = hashlib.sha256()
    # msgspec writes each float so that it can be read back to the last bit.
    played(plan, lambda step: steps.update(msgspec.json.encode(step)))
    return f"{plan['seed']} {steps.hexdigest()[:16]}"


class Run:
    """One run of a plan: the daemon, its surroundings, and the judges that check the promises."""

    def __init__(self, plan: Plan, log: Callable[[dict[str, Any]], None] | None = None) -> None:
        self.plan, self.log = plan, log
        self.slept_ns = 0
        self.resumed_ns = START_NS
        """Monotonic time of the last resume: before it nothing can have arrived."""
        self.witness = Witness(plan["config"])
        self.pose = PoseWitness(plan["config"])
        self.spread, self.log_lines = Spread(self.witness), LogLines()
        self.reports, self.echo, self.damage = Reports(), Echo(), Damage(plan["config"])
        self._asked_ns: int | None = None  # the daemon asked the board for its name
        self.half_duplex = HalfDuplex()
        self.followed, self.course = Followed(self.witness), Course(self.witness)
        self.wheels = Wheels(self.witness, lambda: self.product.state())
        self.excess = Excess(self.witness, lambda: self.product.state())
        self.causes = Causes()
        self.counts: Counter[str] = self.witness.counts
        self.liveness = Liveness(self)
        self.plugging = Plugging(self.witness)
        self.reasons = Reasons(self)
        self.inputs = Inputs(self.witness, bool(kinds(plan)))
        self.failure: BrokenError | None = None
        self.todo: list[tuple[int, int, Callable[[], None]]] = []
        self._order = 0
        self._calls: dict[int, tuple[dict[str, Any], int, Callable[[bytes], None]]] = {}
        """Calls without an answer: the event, its arrival and the function for the answer."""
        self.longest_reason = 0
        """Length of the longest reason that the daemon has given."""
        self._puts_ns: list[int] = []
        """Arrivals of stops that were put on the key, and that no step has read yet."""
        self._ticket = 0
        self._numbers: dict[int, int] = {}
        """Numbers of causes that operators have read in `state`, each with the last time."""
        self.active: list[tuple[str, tuple[Any, ...]]] = []
        self._names: set[str] = set()
        """Names of the active faults."""
        self._troubling: list[str] = []
        self._link = ""
        """Names of the active faults that the plan has begun, without dialects."""
        self._fed_ns = 0
        self._flipped = 0
        """Number of lines of the board up to one with a flipped bit, which may be lost or not."""
        self._ended = b""
        """The last byte of the board that reached the daemon."""
        self._rest = b""
        """The bytes of the newest line from the board, if its end has not arrived yet."""
        self._plain = "link_check" not in plan["config"]["mcu"]
        """The serial lines have no check, so that a whole line always counts."""
        self._begins = 1
        """Number of times that a board began, because it was plugged in or reset."""
        self._linked = False
        """This daemon has heard the board: before that, no event disarms a sender."""
        self._stalled_ns = -NS
        self._bus_ns = 0
        """Until then the bus delivers no command, because the whole process stood still. The
        commands that came meanwhile arrive together at this time."""
        self._refused: list[tuple[int, int, str]] = []
        """Clears without numbers that this step has refused: their true time, that by the robot's
        clock, and the answer."""
        self._full_ns = self._blocked_ns = -NS
        """When the disk was last seen full, and the output was last seen blocked."""
        self._hangs_until_ns = 0
        self._whole = False
        """The last step sent a whole line."""
        self.epilogue = False
        self.moved_ns = -1
        self.beats = Beats()
        self.product = Product(plan["config"], self._see)
        self._senders: set[str] = set()
        """The names of the senders of which a message has arrived."""
        self.product.fed = self._fed
        self.product.drops = self._dropped

    # time

    @property
    def true_ns(self) -> int:
        return self.product.now_ns - START_NS + self.slept_ns

    def at(self, at_ns: int, do: Callable[[], None]) -> None:
        """Call `do` at this true time."""
        self._order += 1
        heapq.heappush(self.todo, (at_ns, self._order, do))

    def run_to(self, true_ns: int) -> None:
        """Advance to this true time, and call each planned function at its time."""
        while self.todo and self.todo[0][0] <= true_ns:
            at_ns, _, do = heapq.heappop(self.todo)
            self._pass(at_ns)
            do()
            self._raise()
        self._pass(true_ns)
        self._raise()

    def _pass(self, true_ns: int) -> None:
        self.product.run_until(true_ns + START_NS - self.slept_ns)

    def _raise(self) -> None:
        if self.failure is not None:
            raise self.failure

    def _arrival(self, true_ns: int) -> int:
        """Convert a true arrival time to the robot's clock.

        Nothing can arrive before the last resume of the host or after the present.
        """
        return max(self.resumed_ns, min(self.product.now_ns, true_ns + START_NS - self.slept_ns))

    # the play

    def play(self) -> Counter[str]:
        """Play the plan to its end; raise `BrokenError` for a promise that does not hold."""
        if self.plan["seed"] % REPLAYED == 0:
            self.product.record()
        try:
            self._begin()
            self.run_to(int(self.plan["seconds"] * NS))
            self.liveness.end()
            if difference := self.product.replayed():
                raise BrokenError("a recording replays to the bit", self.true_ns, difference)
        except BrokenError:
            raise
        except Exception as error:
            kind = f"{type(error).__name__}: {error}"
            raise BrokenError("no exception ever", self.true_ns, kind) from error
        return self.counts

    def _begin(self) -> None:
        plan, clocks = self.plan, Counter[str]()
        if "moment" in plan:
            self.counts[f"moment {plan['moment']}"] += 1
        self.lasting = [(name, tuple(values)) for name, *values in plan["board"]]
        self.active = list(self.lasting)
        self._board()
        self._beat()
        for sender in plan["senders"]:
            self.counts[f"way {sender['way']}"] += 1
            for shape in sender["congestion"]:
                self.counts[f"congestion {shape[2]}"] += 1
            if sender["way"] in ("header", "bridged"):
                clocks[f"header native/{sender['source']}" if sender["way"] == "header"
                     else "session of the bridge"] += 1  # fmt: skip
            elif sender["way"] == "routed":
                clocks.update({name for _, name in sender["routers"]})
            else:
                for own in (sender["id"], f"session of {sender['id']}"):
                    clocks[own] += 1
            if sender["churn"]:
                self.witness.churned.add(sender["source"])
            queue = messages(sender, plan["seed"], plan["seconds"], START_NS + WALL_OFFSET_NS)
            queue.reverse()
            if queue:
                self._next(sender, queue)
        several = (name for name, count in clocks.items() if count > 1)
        self.witness.shared_clocks = frozenset(several)
        for event in plan["events"]:
            self.counts[f"event {event['do']} {event.get('verb', '')}".strip()] += 1
            self.at(int(event["at"] * NS), lambda event=event: self._do(event))  # type: ignore[misc]

    def _next(self, sender: dict[str, Any], queue: list[Message]) -> None:
        message = queue.pop()

        def arrive() -> None:
            if self.true_ns < self._bus_ns:
                self.at(self._bus_ns, arrive)
                return
            self.deliver(sender, message)
            if queue:
                self._next(sender, queue)

        self.at(message.arrives_ns, arrive)

    def deliver(self, sender: dict[str, Any], message: Message) -> None:
        """Deliver a message to the daemon if it runs, and tell all judges about it."""
        if not self.product.alive:
            return
        waited_ns = self._bus_ns if self._bus_ns <= self.true_ns else 0
        if sender["name"] not in self._senders:
            self._senders.add(sender["name"])
            self.counts["senders"] += 1
        if is_slewed(sender, message.sent_ns / NS):
            self.counts["slewed commands"] += 1
        at_ns = self._arrival(max(message.arrives_ns, waited_ns))
        command = self.sampled(sender, message)
        if command is None:
            return
        true_ns = at_ns - START_NS + self.slept_ns
        wish = self.witness.command(sender, message, command, true_ns)
        self.followed.command(sender, message, command, at_ns, wish)
        self.liveness.command(sender, command)
        self.reasons.command(sender, message, command)
        shared = command.clock in self.witness.shared_clocks
        self.reports.command(sender, message, command, at_ns, shared)
        boot_ns = true_ns + START_NS
        self.product.deliver(
            at_ns, command.key, command.payload, boot_ns=boot_ns, **command.options
        )

    def sampled(self, sender: dict[str, Any], message: Message) -> Sample | None:
        """Return a message as it arrives, None if its sender still waits for its first beat."""
        beat = None
        if sender["way"] in ECHOING:
            beat = self.beats.newest(sender, message.sent_ns)
            if beat is None:
                return None
        config, wall_ns = self.plan["config"], self.product.wall_ns
        return sample(sender, message, config, wall_ns, beat, START_NS)

    def _beat(self) -> None:
        """Note that a daemon starts, and give it the number of its run."""
        self.beats.begin(self.true_ns)
        self.product.begin_run(self.beats.run)

    def _dropped(self, key: str) -> None:
        """Note that the inbox dropped its oldest message of this key unread."""
        self.witness.dropped(key)
        self.reasons.dropped(key, self.true_ns)

    # operators

    def call(self, event: dict[str, Any]) -> None:
        """Let an operator call a service over a network that may lose, delay or repeat the call."""
        if event["lost"]:
            return
        numbers: list[int] | None = None
        read_ns = None
        if event.get("named") and self.product.shows_state:
            present = [cause["number"] for cause in self.product.state()["causes"]]
            numbers, read_ns = present, self.true_ns
            if "typed" in event:
                numbers, read_ns = [self._typed(present, event["typed"])], -1
            else:
                for number in present:
                    self._numbers.pop(number, None)
                    self._numbers[number] = read_ns
        end_ns = int(self.plan["seconds"] * NS)
        due_ns = self.true_ns + int(event["late"] * NS)
        times_ns = [int(n * event.get("gap", 0.0) * NS) for n in range(event.get("times", 1))]
        for extra_ns in [*times_ns, *([700_000_000] if event["twice"] else [])]:
            if due_ns + extra_ns < end_ns or self.epilogue:
                self.at(
                    due_ns + extra_ns,
                    lambda due=due_ns + extra_ns: self._call_service(event, due, numbers, read_ns),  # type: ignore[misc]
                )

    def _typed(self, present: list[int], place: int) -> int:
        """Return the number of a cause that an operator types by hand, and that holds no more.

        It is one of the last ones that `state` had before, or one that no cause ever had.
        """
        older = [number for number in self._numbers if number not in present]
        return older[-place] if 0 < place <= len(older) else 2**53 - 1

    def _call_service(
        self,
        event: dict[str, Any],
        due_ns: int,
        numbers: list[int] | None,
        read_ns: int | None,
    ) -> None:
        product, verb, witness = self.product, event["verb"], self.witness
        if "pose" not in verb and "odometry" not in verb:
            self.liveness.event(disarms=False)
        if not product.alive:
            return
        at_ns = self._arrival(due_ns)
        true_ns = at_ns - START_NS + self.slept_ns
        via, payload = event["via"], b""
        service = verb
        if verb == "set_pose" or numbers is not None:
            via = "native"
        if numbers is not None:
            payload = json.dumps({"numbers": numbers}).encode()
        elif verb == "set" and via != "native":
            payload = parameters(event["settings"])
            service = "parameters/set_parameters" + ("_atomically" if event["whole"] else "")
        elif verb == "set":
            payload = json.dumps({"settings": event["settings"]}).encode()
        elif verb == "set_pose":
            x, y, yaw = event["pose"]
            payload = json.dumps({"x": x, "y": y, "yaw": yaw}).encode()
        attachment = msgspec.msgpack.encode({"sender": event["by"]})
        if via == "rmw":
            gid = hashlib.sha256(event["by"].encode()).digest()[:16]
            attachment = struct.pack("<qqB16s", 1, 1_800_000_000 * NS, 16, gid)
        elif via == "bridge":
            attachment = b""
        if verb == "stop":
            witness.stops.append(true_ns)
            if event.get("put"):
                put_by = event["by"] if via == "native" else ""
                self.inputs.note_stop(true_ns, named(put_by, "native"))
                product.deliver(at_ns, "stop", b"", via="native", attachment=attachment)
                self._puts_ns.append(true_ns)
                return
        self._ticket += 1
        ticket = self._ticket

        chosen = None if numbers is None else tuple(numbers)
        self.causes.call(ticket, Call(verb, chosen, at_ns))

        def answered(reply: bytes) -> None:
            success, text = read_reply(reply, via, service.endswith("set_parameters"))
            self.causes.answered(ticket, success)
            if verb == "clear" and not success and numbers is None:
                self._refused.append((true_ns, at_ns, text))
            self.counts[f"{verb} {'done' if success else 'refused'}"] += 1
            if asks_for_zeros(verb, event, success, text):
                self.liveness.event()
            if not success:
                return
            match verb:
                case "stop":
                    self.inputs.note_stop(true_ns, named(event["by"], via))
                case "clear":
                    self.inputs.cleared(true_ns)
                    witness.cleared(true_ns, read_ns, text, event["by"])
                case "activate":
                    witness.activated(true_ns, read_ns, event["by"])
                    self.reasons.restart()
                case "deactivate":
                    witness.offs.append(true_ns)
                case "set":
                    if not text.startswith("nothing changed"):
                        witness.set_limits(self.true_ns, event["settings"], true_ns)
                case "set_pose" | "reset_odometry":
                    x, y, yaw = event.get("pose", (0.0, 0.0, 0.0))
                    at_once = self.true_ns - true_ns < 2 * witness.period_ns
                    self.pose.placed((x, y, yaw) if at_once else None)

        self._calls[ticket] = event, true_ns, answered
        product.call_service(at_ns, service, ticket, payload, via, attachment)

    def _judge_refusals(self) -> None:
        """Check that a clear without numbers works as soon as all causes have been shown."""
        held = bool(kinds(self.plan)) or self.witness.mode not in ("fault", "stopped")
        for true_ns, asked_ns, text in self._refused:
            if not held and self.causes.is_shown(asked_ns):
                promise = "a clear works two seconds behind the newest cause"
                raise BrokenError(promise, true_ns, text)
        self._refused.clear()

    # the board and the host

    def _do(self, event: dict[str, Any]) -> None:
        product = self.product
        if event["do"] not in ("wall", "disk", "call", "gyro"):
            self.liveness.event(disarms=disarms(event))
        lasts_ns = min(
            int(event.get("for", 0.0) * NS),
            max(0, int(self.plan["seconds"] * NS) - self.true_ns),
        )
        after_ns = self.true_ns + lasts_ns
        match event["do"]:
            case "call":
                self.call(event)
            case "board":
                name, *values = event["fault"]
                self.counts[f"board {name}"] += 1
                fault = (name, tuple(values))
                self.active.append(fault)
                self._troubled(name)
                self._board()
                if name == "echo":
                    self.echo.begin()
                elif name == "half_duplex":
                    self.half_duplex.begin()
                elif name == "mute":
                    self.at(self.true_ns + NS // 2 + 2 * self.witness.period_ns, self._check_state)
                self.at(after_ns, lambda: self._mended(fault))
            case "reset":
                product.reset(int(event["deaf"] * NS))
                self._begins += 1
                self.pose.doubt()
                self._troubled("reset")
                deaf_ns = int(event["deaf"] * NS)
                self.liveness.event(deaf_ns + TROUBLE_NS)
                if deaf_ns > 12 * NS // 10:
                    begins = self._begins
                    self.at(self.true_ns + deaf_ns, lambda: self._hears_again(begins))
            case "unplug":
                self.inputs.lost()
                product.unplug()
                self.pose.doubt()
                self.at(self.true_ns + NS // 2, self._check_state)
                self.at(after_ns, lambda: self.plug(event["new"], event.get("without", ())))
            case "block":
                self._block(True)
                self.at(after_ns, lambda: self._block(False))
            case "tear":
                product.tear(event["taken"])
            case "flip":
                product.flip(event["place"], event["mask"], event["behind"])
                self.pose.flip()
                self._flipped = event["behind"] + 1
                self._troubled("flip")
                self.damage.forget()
            case "stall" | "stall in step" if product.alive:
                self._stalled_ns = after_ns
                if "deaf" in event:
                    self._bus_ns = after_ns + int(event["deaf"] * NS)
                self.liveness.stalls(after_ns)
                self.witness.stalls(self.true_ns, after_ns)
                behind_another = self.true_ns > event["at"] * NS + NS // 1000
                if behind_another or self._link not in ("up", "stale"):
                    # One stall behind another: the daemon could read between, but take no step,
                    # so it does not know when the lines came. Nor does it know that for the first
                    # lines of a board, because their usual delay is not known yet.
                    self.pose.unknown_until(after_ns + NS // 5)
                if event["do"] == "stall":
                    product.stall(lasts_ns / NS)
                else:
                    product.stall_in_step(lasts_ns / NS)
            case "suspend":
                self._suspend(lasts_ns)
            case "gyro":
                self._spoil_gyro(event["fault"], after_ns)
            case "wall":
                product.step_wall(event["by"])
            case "disk":
                product.disk.fill(True)
                self.at(after_ns, lambda: product.disk.fill(False))
            case "restart":
                if product.alive:
                    self._restart(event, after_ns)

    def _spoil_gyro(self, fault: list[Any], until_ns: int) -> None:
        """Let the gyro report one wrong rate, or repeat its last rate until `until_ns`."""
        gyro, (name, *values) = self.product.gyro, fault
        self.counts[f"gyro {name}"] += 1
        if name == "wrong":
            gyro.spoil(*values)
            return
        gyro.hanging = True
        self._hangs_until_ns = max(until_ns, self._hangs_until_ns)

        def works() -> None:
            gyro.hanging = self.true_ns < self._hangs_until_ns

        self.at(until_ns, works)

    def _check_state(self) -> None:
        """Check the speeds and the pose in `state`.

        The check is left out shortly after the host stalled or slept: behind a stall, the daemon
        gives the board a third of the quiet time more.
        """
        product, witness = self.product, self.witness
        waits_ns = max(NS // 10, witness.quiet_ns // 3 + witness.period_ns)
        # An echo of zeros looks like a board at rest.
        if self.echo.on or not product.alive:
            return
        if self._stalled_ns < self.true_ns - waits_ns and self.resumed_ns < product.now_ns - NS:
            state, quiet_ns = product.state(), witness.quiet_ns + witness.period_ns
            judge_state(self.true_ns, state, self._fed_ns, quiet_ns)
            if self.pose.latest is not None and not self._calls:
                judge_pose(self.true_ns, state, self.pose.latest, self._fed_ns, quiet_ns)

    def _weigh(self) -> None:
        """Check that an endless line of the board has not filled the memory."""
        self.liveness.weigh()

    def _block(self, blocked: bool) -> None:
        self.liveness.event(disarms=not blocked)
        self.product.block(blocked)
        self.witness.blocked_ns = self.true_ns if blocked else None

    def _board(self) -> None:
        """Apply all active faults to the simulated board."""
        self.product.board(list(self.active))
        self._names = {name for name, _ in self.active}
        new = [entry for entry in self.active if entry not in self.lasting]
        self._troubling = [name for name, _ in new if name not in NO_TROUBLE]
        added = self.active[len(self.lasting) :]
        self.witness.lies = [fault for fault in added if fault[0] not in NO_TROUBLE]

    def _troubled(self, name: str) -> None:
        if name not in NO_TROUBLE:
            self.witness.troubles[name] = self.true_ns
        if name in LIARS:
            self.pose.doubt(name == "mute")

    def _mended(self, fault: tuple[str, tuple[Any, ...]]) -> None:
        if fault[0] == "endless" and self.product.alive:
            self._weigh()
        if fault not in self.active:
            return  # The board was replaced by one that does not report this input.
        self.active.remove(fault)
        self.liveness.event(TROUBLE_NS, disarms=fault[0] not in QUIET_FAULTS)
        self._troubled(fault[0])
        self.pose.mended(fault[0], self.true_ns)
        self._board()
        self.echo.on = "echo" in self._names
        self.half_duplex.on = "half_duplex" in self._names
        if fault[0] in ("echo", "half_duplex") and self.product.plugged:
            # The daemon asks for this, and drives no more until it was done.
            self.inputs.lost()
            self.product.unplug()
            self.at(self.true_ns + NS // 10, lambda: self.plug(False))

    def plug(self, new: bool, without: Sequence[str] = ()) -> None:
        """Plug the board in again, unless it is plugged in.

        `without` has the beginnings of fault names. A new board never reports the inputs of these
        faults.
        """
        self.liveness.event(TROUBLE_NS if new else 0)
        if not self.product.plugged:
            if without:
                names = tuple(without)
                self.lasting = [fault for fault in self.lasting if not fault[0].startswith(names)]
                self.active = [fault for fault in self.active if not fault[0].startswith(names)]
                self._board()
                self.inputs.replaced()
            self.product.plug(new)
            self.inputs.plugged(self.true_ns)
            self.witness.first, self._rest = True, b""
            self._begins += new
            if self.witness.blocked_ns is not None:
                self.witness.blocked_ns = self.true_ns  # The new port has taken no line either.
            self.damage.forget()
            self.echo.restart()
            self.half_duplex.restart()
            self._disarmed(self.true_ns)
            self._linked = False

    def _suspend(self, lasts_ns: int) -> None:
        """Let the host sleep: its monotonic clock stops, and its USB ports lose their power."""
        product, true_ns = self.product, self.true_ns
        if not product.alive or not product.plugged:
            return
        self.inputs.lost()
        product.unplug()
        product.reset(2 * NS)
        self.pose.doubt()
        self._troubled("suspend")
        self.beats.sleep(true_ns, true_ns + lasts_ns)
        self.slept_ns += lasts_ns
        self.resumed_ns = product.now_ns
        product.step_wall(lasts_ns / NS)
        self.witness.suspended(true_ns + lasts_ns)
        self.reasons.restart(stood=True)
        self.at(self.true_ns + 20_000_000, lambda: self.plug(False))

    def _restart(self, event: dict[str, Any], after_ns: int) -> None:
        product, witness = self.product, self.witness
        if event.get("stop"):
            product.stop_unseen()
            # A clear of the same moment came before it: the daemon has taken no step since.
            witness.stops.append(self.true_ns + 1)
        moving = witness.last
        if event["way"] == "term":
            witness.ending_ns = self.true_ns
        product.end(event["way"])
        self.beats.end(self.true_ns)
        self._raise()
        self.inputs.lost()
        if self._whole:
            witness.ended(self.true_ns, moving)
        self._take_answers()
        for call, arrived_ns, _ in self._calls.values():
            witness.unanswered(call["verb"], arrived_ns)
        self._calls.clear()
        for arrived_ns in self._puts_ns:
            witness.unanswered("stop", arrived_ns)
        self._puts_ns.clear()
        lost = product.disk.behind or "damage" in event or event["way"] != "kill"
        if product.disk.behind:
            witness.file_is_behind()

        def start() -> None:
            self.resumed_ns, self._rest = product.now_ns, b""
            if product.disk.full:
                # The daemon starts stopped, because it cannot write the latch file. A clear
                # releases this stop only if its sender has read `state` after the start.
                witness.stops.append(self.true_ns)
            if "damage" in event:
                product.disk.damage(event["damage"])
                witness.file_is_damaged(self.true_ns)
            product.start()
            self.causes.restart(lost)
            self._beat()
            self.liveness.event()
            self._linked = False
            witness.new_life(self.true_ns)
            self.reports, self.followed = Reports(), Followed(witness)
            self.log_lines = LogLines()
            self.spread.forget()
            self.inputs.new_life()
            self.echo.restart()
            self.half_duplex.restart()
            self.pose.latest = None
            self.damage.forget()
            self.reasons.restart()
            self.pose.new_life()

        self.at(after_ns + 1000, start)

    # steps and bytes of the product

    def _fed(self, at_ns: int, data: bytes) -> None:
        before, self._ended = self._ended, data[-1:]
        if b"!acsard-mcu " in data and b"\n!acsard-mcu " in before + data and data.endswith(b"\n"):
            named_ns, asked_ns = at_ns - START_NS + self.slept_ns, self._asked_ns
            self._asked_ns = None
            if asked_ns is None or named_ns - asked_ns > NS // 2:
                self._disarmed(named_ns)  # the board says that it has started
        if b"!acsard-mcu" in data:
            self.liveness.event()  # also as the first bytes of all, and if the line is damaged
        if self._plain:
            self.damage.fed(data)
        self.inputs.fed(at_ns, data)
        lines, end, rest = (self._rest + data).rpartition(b"\n")
        self._rest = rest[-99:]
        starts = self.product.reply_starts
        if not end or not any(line.startswith(starts) for line in lines.split(b"\n")):
            return  # The line has no end, or begins with noise, or the board greets.
        true_ns = at_ns - START_NS + self.slept_ns
        gap_ns = true_ns - self._fed_ns
        if self._flipped:
            self._flipped -= 1
            self.liveness.event(NS // 2)
            self.spread.trouble()
        if not self._plain and gap_ns > 6 * NS // 10:
            # The next good line is the first one with the check, for which the daemon asks again.
            self.liveness.event(NS // 2)
            self.witness.disarmed_ns = true_ns + NS // 2
        if gap_ns > 9 * NS // 10:
            # Behind a stall of the host the kernel may hold lines, so the link may not be lost.
            self.liveness.event()
            if gap_ns > 11 * NS // 10 and self._stalled_ns < self._fed_ns:
                self._disarmed(true_ns)
        self._fed_ns = true_ns

    def _hears_again(self, begins: int) -> None:
        # A daemon that hears itself cannot know that the board was deaf. Another board was not, and
        # a later reset ends the deaf time of an earlier one.
        if not self.echo.on and begins == self._begins:
            self._disarmed(self.true_ns)

    def _disarmed(self, true_ns: int) -> None:
        self.liveness.event()
        if self._linked:
            self.witness.arming(true_ns)

    def _see(self, snapshot: StepResult) -> None:
        if self.failure is not None:
            return
        try:
            self._judge(snapshot)
        except BrokenError as error:
            self.failure = error

    def _take_answers(self) -> None:
        """Hand each answer of the daemon to the call that it belongs to."""
        for ticket, reply in self.product.replies():
            if ticket in self._calls:
                _, _, answered = self._calls.pop(ticket)
                answered(reply)

    def _late_answers(self, true_ns: int) -> None:
        """Check that no call waits for more than 1 s.

        Times in which the host stalls or sleeps, or the disk is full, do not count.
        """
        woke_ns = self.resumed_ns - START_NS + self.slept_ns
        calm_ns = max(self._full_ns, self._stalled_ns, woke_ns)
        for call, arrived_ns, _ in self._calls.values():
            if true_ns - max(arrived_ns, calm_ns) > NS:
                text = f"{call['verb']} by {call['by']} came at {arrived_ns / NS:.3f} s"
                raise BrokenError("every call has an answer", true_ns, text)

    def _lines(self) -> int:
        """Return the number of good lines that the daemon has counted."""
        return int(self.product.state()["counters"]["lines"])

    def _judge(self, snapshot: StepResult) -> None:
        witness, offset = self.witness, self.slept_ns - START_NS
        true_ns = snapshot.at_ns + offset
        if snapshot.at_ns - snapshot.decided_ns > NS // 1000:
            # A stall in a step waits for a step that makes a line.
            self._stalled_ns = max(self._stalled_ns, true_ns)
        witness.read(called=bool(self._calls))
        self.longest_reason = max(self.longest_reason, len(snapshot.reason))
        if self._puts_ns:
            self._puts_ns = [
                at_ns for at_ns in self._puts_ns if at_ns > snapshot.decided_ns + offset
            ]
        if self.product.disk.full:
            self._full_ns = true_ns
        if witness.blocked_ns is not None:
            self._blocked_ns = true_ns
        calm_ns = max(self._stalled_ns - offset, self.resumed_ns)
        self.inputs.take(snapshot.decided_ns, offset, calm_ns)
        if self._calls:
            self._take_answers()
            self._late_answers(true_ns)
        present = {number: Cause(kind, key) for number, kind, key in snapshot.latched}
        self.causes.step(true_ns, snapshot.decided_ns, present)
        self._judge_refusals()
        if witness.pending:
            witness.pending = {}
        if self._calls and self.product.disk.full:
            waiting = {call["verb"]: at_ns for call, at_ns, _ in self._calls.values()}
            witness.pending = {verb: waiting[verb] for verb in RELEASING & waiting.keys()}
            if not PLACING.isdisjoint(waiting):
                self.pose.placed()
        for name in self._troubling:
            witness.troubles[name] = true_ns
        if snapshot.followed_ns is not None:
            self.reports.follows(true_ns, snapshot.followed_ns)
        witness.away = self.inputs.limiting
        if self.inputs.limiting:
            # Any command may disarm all senders, and the robot follows only a part of it.
            witness.disarmed_ns = max(witness.disarmed_ns, true_ns)
            self.followed.forget()
            self.liveness.event()
        self.followed.step(
            true_ns, snapshot.decided_ns, snapshot.followed_ns, snapshot.mode, snapshot.link
        )
        if any(name == "fault" for name, _, _ in snapshot.events):
            witness.faults.append(snapshot.decided_ns + offset)
        seen = snapshot.mode, snapshot.code, snapshot.reason, snapshot.source
        witness.step(snapshot.decided_ns + offset, *seen, self._fed_ns)
        if snapshot.link == "up" and self._link not in ("up", "stale"):
            # Commands that came before the link do not count.
            witness.disarmed_ns = max(witness.disarmed_ns, true_ns)
        if snapshot.link == "stale" and self._link == "up" and any(witness.last):
            self.counts["link is stale while moving"] += 1
        self._link = snapshot.link
        witness.linked = snapshot.link == "up"
        # Lines without the check that the configuration requires make no link.
        self._linked |= witness.linked
        witness.cut |= not witness.linked
        calm_ns = max(self._stalled_ns, self._blocked_ns) - offset
        self.plugging.see(true_ns, snapshot, self.product, calm_ns)
        self._whole = bool(snapshot.lines) and snapshot.lines[-1][1].endswith(b"\n")
        for at_ns, line in snapshot.lines:
            if line == b"?\r\n":
                self._asked_ns = true_ns
            before = witness.last
            witness.line(at_ns + offset, line, self._fed_ns, snapshot.decided_ns + offset)
            self.followed.line(true_ns, before, witness.last)
            if witness.linked:  # the daemon that has lost the link believes no line
                self.echo.line(at_ns + offset, witness.last)
                if self.half_duplex.on:
                    self.half_duplex.line(at_ns + offset, witness.last)
            if any(witness.last):
                self.moved_ns = at_ns + offset
        self._judge_excess(true_ns, snapshot, calm_ns + offset)
        driving = snapshot.mode == "driving" and not witness.pending and not self.inputs.limiting
        driven = self.followed.wish if driving else None
        whole = sum(line.endswith(b"\n") for _, line in snapshot.lines)
        self.course.step(true_ns, driven, witness.last, whole)
        self.liveness.judge(true_ns)
        self.reasons.judge(true_ns, self._stalled_ns)
        # The daemon that has found an echo hears no line until the port is opened again.
        if self._plain and not (self.echo.on or self.half_duplex.on):
            self.damage.judge(true_ns, self._lines, self._stalled_ns == true_ns)
        self.spread.roll(true_ns, self.product.angles())
        if snapshot.estimates:
            lies, truth = self._names, self.product.truth()
            self.pose.gyro(true_ns, self.product.gyro)
            self.pose.see(true_ns, snapshot.estimates, truth, offset, lies)
            if self.half_duplex.on:
                self.half_duplex.see(
                    true_ns, snapshot.mode, snapshot.estimates[-1][1:3], truth[1:3]
                )
            if self._stalled_ns > true_ns - NS:
                self.spread.forget()
            for estimate in snapshot.estimates:
                self.spread.see(true_ns, estimate, lies)
            witness.wheels(true_ns, truth[4])
            others = (at for name, at in witness.troubles.items() if name not in self._names)
            quiet_ns = max(calm_ns + offset, *others, 0)
            lies = set(self._troubling)
            self.wheels.see(true_ns, self.product.wheels(), snapshot.causes, lies, quiet_ns)
        if self.pose.end_step():
            self.spread.forget()
        self.log_lines.see(true_ns, snapshot)
        calm = snapshot.decided_ns - calm_ns > 3 * witness.period_ns
        self.inputs.step(true_ns, snapshot, offset, calm, self.product.state)
        if self.log is not None:
            self.log(
                {
                    "at": snapshot.at_ns, "mode": snapshot.mode, "reason": snapshot.reason,
                    "lines": [[at, line.decode("latin-1")] for at, line in snapshot.lines],
                    "odometry": snapshot.estimates,
                }
            )  # fmt: skip

    def _judge_excess(self, true_ns: int, snapshot: StepResult, calm_ns: int) -> None:
        witness = self.witness
        self.excess.count()
        if "runaway" in self._names and self.product.plugged:
            allowed = "runaway", "mute"
            others = (at for name, at in witness.troubles.items() if name not in allowed)
            latched = not snapshot.causes.isdisjoint(FAULTS)
            quiet_ns = max(calm_ns, *others, 0)
            self.excess.see(true_ns, self.product.angles(), latched, quiet_ns)
        else:
            self.excess.forget()


def named(by: str, via: str) -> str:
    """Return the words by which `state` names the client that stopped the robot.

    A client on a native key is named by the SHA-256 of its id. A client without an id, and any
    client on another key, is "unnamed".
    """
    if via == "native" and by:
        return hashlib.sha256(by.encode()).hexdigest()[:16]
    return f"unnamed ({via}"


def disarms(event: dict[str, Any]) -> bool:
    """Return whether the start of this event may disarm all senders."""
    if event["do"] == "board":
        return event["fault"][0] not in QUIET_FAULTS
    return event["do"] not in ("stall", "stall in step", "block", "tear", "flip")


def asks_for_zeros(verb: str, event: dict[str, Any], success: bool, text: str) -> bool:
    """Return whether a call with this answer may have disarmed all senders."""
    match verb:
        case "clear":
            return success and not text.startswith("nothing")
        case "activate":
            return success
        case "set":
            return any(key.startswith("commands.") for key in event["settings"])
    return False
