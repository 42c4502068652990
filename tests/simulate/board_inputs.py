"""Plans whose board reports inputs, and the judge of the promises about them.

The inputs are the emergency stop, bumpers, motor drivers and the battery.
`reference/status-line.md` of the manual defines the lines. `Inputs` reads the same bytes as the
daemon and handles each line at the step in which the daemon reads it. If the documentation leaves
open whether a line or a silence counts, `Inputs` judges nothing. These plans have separate random
generators, so the plans without inputs stay the same.
"""

from __future__ import annotations

import binascii
import random
import re
from bisect import insort
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from tests.simulate.ages import MARGIN_NS
from tests.simulate.product import StepResult
from tests.simulate.promises import ZERO, BrokenError, Witness
from tests.simulate.roads import NS

Plan = dict[str, Any]

SHARE, OTHERS = 0.08, 1 / 15
"""Share of the plans that have bumpers which stop the robot, and share of each other kind."""

PLACES = ("front", "rear", "left", "right")

AWAY = {"front": -1, "rear": 1}
"""The sign of the speeds that lead away from a bumper. No speed leads away from the others."""

AWAY_SPEED = 0.1
"""Highest speed away from a pressed bumper, m/s."""

KEPT = ("call", "wall", "stall", "stall in step")
"""Events that a plan keeps whose bumpers stop the robot."""

SILENT_NS, EXCUSE_NS = NS // 2, NS // 10
"""An input that is not reported for the first time counts as pressed. Behind a stall of the host
the daemon waits for the second time, because the lines of that time come with it."""

FORGET_NS = 3 * NS
"""Least time behind a plugging after which the daemon forgets an input that no line reports."""

STOPPED = {"stopped", "fault", "shutdown"}
"""Modes of a robot that is stopped: a fault and the end of the daemon come before a stop."""

MAX_CLIENTS = 31
"""Number of clients that the reason of a stop names beside the last cause. It leaves out a client
only if it names this many others."""

CLIENT = re.compile(r"\bstopped (?:by|when the daemon started)\b")
"""A client in the reason of a stop. The daemon counts as one if it has set a stop at its start."""

NEVER_S = 1e6
"""Time after which a board without a fault of a motor driver would report one, s."""

LONGEST = 4096
"""Bytes of a line that are kept. A status line is much shorter."""

FIELD = (
    rb"(?:estop=(?:ok|pressed)|bumpers=[.X]{1,4}|driver=(?:ok|fault)|volts=\d{1,2}\.\d\d"
    rb"|amps=-?\d{1,3}\.\d\d|charge=(?:100|\d{1,2})%|temp=-?\d{1,3}\.\d)"
)
STATUS = re.compile(rb"(!status(?: " + FIELD + rb")+)(?:\*([0-9A-F]{4}))?\s*")
"""White space at the end does not count, also if it is a line end that was damaged."""

CLEAR = {
    "do": "call", "verb": "clear", "late": 0.01, "lost": False, "twice": False, "by": "op9",
    "via": "native",
}  # fmt: skip


# plans


def add(plan: Plan) -> None:
    """Give some plans inputs, and operators who clear the stops."""
    dice = random.Random(f"board inputs {plan['seed']}")
    # A line without a checksum does not count once the link has the check.
    if dice.random() <= SHARE and "link_check" not in plan["config"]["mcu"]:
        _bumpers(plan, dice)
    more = {
        "emergency stop": _emergency_stop, "away": _away, "battery": _battery, "driver": _driver,
    }  # fmt: skip
    for name, give in more.items():
        dice = random.Random(f"{name} {plan['seed']}")
        if dice.random() < OTHERS:
            give(plan, dice)
    plan["events"].sort(key=lambda event: event["at"])


def _bumpers(plan: Plan, dice: random.Random) -> None:
    """Add bumpers that stop the robot, and remove most other events of the plan."""
    places = [dice.choice(PLACES) for _ in range(dice.randint(1, 4))]
    plan["config"]["safety"] = {"bumpers": places}
    plan["board"].append(["bumpers"])
    events = [event for event in plan["events"] if event["do"] in KEPT]
    for _ in range(1 + int(plan["seconds"] / 15)):
        at, lasts = dice.uniform(2.0, plan["seconds"]), dice.choice((0.03, 0.3, 2.0, 6.0))
        fault = ["bumper_pressed", dice.randint(1, len(places)), 0.0, 0.0]
        events.append({"at": round(at, 3), "do": "board", "for": lasts, "fault": fault})
        _clears(dice, events, at, lasts)
    plan["events"] = events


def _clears(dice: random.Random, events: list[Any], at: float, lasts: float) -> None:
    """Add operators who clear during an event of the board, and one who clears afterwards."""
    for _ in range(dice.randrange(4)):
        early = round(at + dice.uniform(0.0, lasts + 1.0), 3)
        events.append({"at": early, **CLEAR, "named": dice.random() < 0.7})
    late = round(at + lasts + dice.uniform(0.1, 2.0), 3)
    events.append({"at": late, **CLEAR, "named": True})


def _moment(plan: Plan, dice: random.Random) -> float:
    """Return a time, mostly one at which a sender drives."""
    drives = [p[0] for s in plan["senders"] for p in s["phases"] if p[1]]
    if drives and dice.random() < 0.7:
        return float(min(dice.choice(drives) + dice.uniform(0.2, 3.0), plan["seconds"]))
    return dice.uniform(1.0, plan["seconds"])


def _pressed(
    plan: Plan, dice: random.Random, press: str, silent: str, number: int = 0, longest: float = 6.0
) -> tuple[float, float]:
    """Add a press of an input, or a silence of it, often together with other trouble.

    The fault itself contains its start and its length, so that the input also changes during a
    stall of the host. Returns the start and the whole length in s.
    """
    events, at = plan["events"], _moment(plan, dice)
    name, lasts = press, dice.choice((0.005, 0.03, 0.3, 2.0, longest))
    if dice.random() < 0.25:
        name, lasts = silent, dice.choice((0.3, 0.48, 0.6, 2.0))
    after = dice.choice((0.0, 0.0, 0.0, dice.uniform(0.0, 0.5)))
    numbers = [number] if number and name == press else []
    fault = [name, *numbers, round(after, 3), lasts]
    whole = round(after + lasts + 0.3, 3)
    events.append({"at": round(at, 3), "do": "board", "for": whole, "fault": fault})
    beside = round(max(1.0, at + dice.choice((-0.3, 0.001, 0.05)) * dice.random()), 3)
    length = dice.choice((0.05, 0.4, 1.2))
    match dice.randrange(10):
        case 0 | 1:
            how = dice.choice(("stall", "stall in step"))
            events.append({"at": beside, "do": how, "for": length})
        case 2:
            wire = dice.choice((["mute"], ["noise"], ["partial_line"], ["bit_errors", 3]))
            events.append({"at": beside, "do": "board", "for": 2 * length, "fault": wire})
        case 3:
            events.append({"at": beside, "do": "unplug", "for": length, "new": False})
    _clears(dice, events, at, after + lasts)
    return at, after + lasts


def _emergency_stop(plan: Plan, dice: random.Random) -> None:
    plan["board"].append(["estop"])
    if dice.random() < 0.3:
        plan["config"].setdefault("safety", {})["estop"] = "required"
    for _ in range(1 + int(plan["seconds"] / 12)):
        _pressed(plan, dice, "estop_pressed", "estop_silent")
    # One more begins and ends while the host stalls.
    at, length = round(_moment(plan, dice), 3), dice.choice((0.1, 0.4, 1.2))
    fault = ["estop_pressed", length / 4, length / 4]
    plan["events"] += [
        {"at": at, "do": "board", "for": 2 * length, "fault": fault},
        {"at": round(at + 0.001, 3), "do": "stall", "for": length},
    ]
    _clears(dice, plan["events"], at, length)


def _away(plan: Plan, dice: random.Random) -> None:
    """Add bumpers that let the robot drive away, often with a sender that drives against them."""
    safety = plan["config"].setdefault("safety", {})
    if "bumpers" in safety:
        return
    places = [dice.choice((*PLACES, "front", "rear")) for _ in range(dice.randint(1, 4))]
    safety.update(bumpers=places, bumper="away")
    plan["board"].append(["bumpers"])
    alone = dice.random() < 0.6
    if alone:
        best = max(plan["config"]["commands"]["sources"], key=lambda s: s["priority"])["name"]
        usual = {"way": "plain", "source": best, "junk": 0.0, "churn": False, "bad_stamps": 0.0}
        plan["senders"] = [plan["senders"][0] | usual]
    for _ in range(1 + int(plan["seconds"] / 15)):
        number = dice.randint(1, len(places))
        at, lasts = _pressed(plan, dice, "bumper_pressed", "bumpers_silent", number, 9.0)
        if alone and lasts > 6.0:
            # Behind a zero that counts the sender pushes, and does so through the release.
            (sender,) = plan["senders"]
            speed = round(dice.choice((-1, 1)) * dice.uniform(0.1, 1.0), 3)
            push = [round(at + 3.0, 3), speed, speed * (number % 2)]
            others = [p for p in sender["phases"] if not at <= p[0] < at + lasts + 2.0]
            sender["phases"] = sorted([*others, [round(at + 0.5, 3), 0.0, 0.0], push])


def _driver(plan: Plan, dice: random.Random) -> None:
    """Add faults of a motor driver."""
    plan["board"].append(["driver_fault", NEVER_S, 1.0])
    for _ in range(1 + int(plan["seconds"] / 15)):
        _pressed(plan, dice, "driver_fault", "driver_fault")


def _battery(plan: Plan, dice: random.Random) -> None:
    """Add a battery that is nearly full, and becomes nearly empty for some time."""
    battery: dict[str, Any] = {"measure": "percent"}
    bounds: tuple[float, ...] = (60.0, 30.0)
    if dice.random() < 0.7:
        battery, bounds = {"measure": "volts"}, (23.4, 22.6)
    for name, below in zip(("warning", "stop"), bounds, strict=True):
        battery[f"{name}_below"] = below
    plan["config"]["battery"] = battery
    plan["board"].append(["battery", 90, 600])
    for _ in range(1 + int(plan["seconds"] / 30)):
        at, lasts = _moment(plan, dice), dice.choice((0.4, 5.0, 15.0, 30.0))
        fault = ["battery", dice.choice((0, 0, 5, 45)), 600]
        plan["events"].append({"at": round(at, 3), "do": "board", "for": lasts, "fault": fault})
        _clears(dice, plan["events"], at, lasts + 10.0)


def kinds(plan: Plan) -> set[str]:
    """Return the kinds of inputs in a plan: `estop`, `stop`, `away`, `battery` and `driver_fault`.

    `stop` and `away` are bumpers that stop the robot, or from which it may drive away.
    """
    safety, names = plan["config"].get("safety", {}), {name for name, *_ in plan["board"]}
    inputs = names & {"estop", "battery", "driver_fault"}
    return inputs | ({safety.get("bumper", "stop")} if "bumpers" in safety else set())


# judges


class _Input:
    """The state of the emergency stop or all bumpers, from the lines that the daemon has read."""

    def __init__(self) -> None:
        self.marks = b""
        """`X` for each pressed one in the last line, empty before the first line."""
        self.reported_ns: int | None = None
        """Arrival of the last line that may count, by the robot's clock."""
        self.awaited = True
        """No line that may count has come since the board was plugged in."""
        self.counted_ns = 0
        """Arrival of the last line that certainly counts."""
        self.pressed_ns: int | None = None
        """True time since when one certainly counts as pressed."""
        self.sure = True
        """The last line certainly counted."""
        self.silent = ""
        """`maybe` or `surely` if the board is silent about it."""

    @property
    def is_known(self) -> bool:
        """Whether the daemon certainly knows which of these inputs are pressed."""
        return self.sure and not self.silent and self.reported_ns is not None


class _Mean:
    """The mean of the battery's voltage or charge.

    It also has the battery levels that `state` must have reached, and those that it may have
    reached.
    """

    def __init__(self, config: dict[str, Any], emptied: bool) -> None:
        """`emptied` says whether the daemon may have started with the stop of an empty battery.

        The battery then counts as empty until its mean rises.
        """
        names = [name for name in ("warning", "stop") if config.get(f"{name}_below")]
        self.bounds = {name: config[f"{name}_below"] for name in names}
        self._room = 0.05 if config.get("measure", "volts") == "volts" else 0.5
        self._rise = 0.5
        self.must = dict.fromkeys(self.bounds, False)
        self.may = dict.fromkeys(self.bounds, emptied)
        self.mean = self.stood_s = 0.0
        self.at_ns: int | None = None
        self.sure = True

    @property
    def level(self) -> set[str]:
        """The set of battery levels that the daemon may report for this mean."""
        names = ["ok", *self.bounds]
        least = max([names.index(name) for name in self.bounds if self.must[name]], default=0)
        most = max([names.index(name) for name in self.bounds if self.may[name]], default=0)
        return set(names[least : most + 1])

    def take(self, at_ns: int, value: float) -> None:
        """Add a report to the mean.

        A report has a weight of at most 0.3 s. After a silence of 5 s the mean restarts.
        """
        gap_s = 0.0 if self.at_ns is None else (at_ns - self.at_ns) / NS
        if self.at_ns is None or gap_s > 5.0:
            self.mean, self.stood_s = value, 0.0
        self.sure &= not 4.8 < gap_s < 5.3
        stood_s = min(gap_s, 0.3) if gap_s <= 5.0 else 0.0
        self.stood_s += stood_s
        self.mean += (value - self.mean) * stood_s / max(1e-9, min(10.0, self.stood_s))
        self.at_ns = at_ns
        if self.stood_s < 2.9:
            return
        for name, below in self.bounds.items():
            below_s = self.stood_s > 3.1
            self.must[name] |= below_s and self.mean < below - self._room
            self.must[name] &= self.mean < below + self._rise - self._room
            self.may[name] |= self.mean < below + self._room
            self.may[name] &= self.mean < below + self._rise + self._room


class Inputs:
    """Judges what the robot does while an input counts as pressed or the battery is empty."""

    def __init__(self, witness: Witness, reports: bool) -> None:
        """`reports` says whether the board ever reports an input."""
        self._witness = witness
        self._reports = reports
        config = witness.config
        safety = config.get("safety", {})
        self._places: list[str] = safety.get("bumpers", [])
        self._away = safety.get("bumper") == "away"
        self._needed = ["bumpers"] * bool(self._places)
        self._needed += ["estop"] * (safety.get("estop") == "required")
        self._checked = "link_check" in config["mcu"]
        self._powered = True
        """Whether a fault of a motor driver certainly counts: no emergency stop was pressed since
        the robot was last released. This outlasts a restart of the daemon."""
        self._estopped = False
        """Whether a board has reported a pressed emergency stop. This outlasts a restart."""
        self._emptied = False
        """Whether an empty battery may have stopped the robot. This outlasts a restart."""
        measure = config.get("battery", {}).get("measure", "volts")
        self._field = b"volts" if measure == "volts" else b"charge"
        self.new_life()

    def new_life(self) -> None:
        """Note that a daemon starts, which has received no report of an input yet."""
        self.estop, self.bumpers, self.driver = _Input(), _Input(), _Input()
        self._driver_faulted = False
        """Whether a line of this step certainly reports a fault of a motor driver that counts."""
        self._cut_ns: int | None = None
        """True time of a press that certainly has cut this power, or None."""
        self.battery = _Mean(self._witness.config.get("battery", {}), self._emptied)
        self._mode = ""
        self._looked_ns = self._stepped_ns = 0
        self._plugged_ns = 0
        """True time at which a board was last plugged in."""
        self._due_ns: int | None = None
        """A line must leave until then, because an input was pressed."""
        self._fresh = self._latches = self._doubtful = False
        self._before: tuple[tuple[float, ...], int] = ZERO, 0
        """Wheel speeds and time of the last line before the present step."""
        self._empty_ns: int | None = None
        """True time since when the battery certainly is empty."""
        self._came: deque[tuple[int, bytes]] = deque()
        self._held = b""
        self._names: list[tuple[int, str]] = []
        """Arrivals of the stops that clients have asked for since the last clear, and their
        names."""

    def replaced(self) -> None:
        """Note that the board was replaced by one that may not report these inputs."""
        self.estop, self.driver = _Input(), _Input()
        self._powered, self._cut_ns = False, None
        self._doubt()

    def note_stop(self, asked_ns: int, name: str) -> None:
        """Note that the daemon has executed a stop of the client with this name."""
        self._names.append((asked_ns, name))

    def fed(self, at_ns: int, data: bytes) -> None:
        """Add bytes that reached the port. `at_ns` is their time on the robot's clock."""
        if self._reports:
            self._came.append((at_ns, data))

    def lost(self) -> None:
        """Note that the daemon may not have read all bytes, because its port closed or it ended."""
        if self._came:
            self._doubt()
            self.driver.sure = False
        self._came.clear()
        self._held = b""

    def plugged(self, true_ns: int) -> None:
        """Note that a board was plugged in, which must first report the required inputs."""
        self.estop.awaited = self.bumpers.awaited = True
        self._plugged_ns = true_ns

    @property
    def limiting(self) -> bool:
        """Whether a bumper may be pressed from which the robot may only drive away."""
        free = self.bumpers.is_known and b"X" not in self.bumpers.marks
        return self._away and (self._fresh or not free)

    def take(self, decided_ns: int, offset: int, calm_ns: int) -> None:
        """Read the same bytes as the daemon's step that began at `decided_ns` on the robot's clock.

        Args:
            decided_ns: Start of the step.
            offset: True time minus the robot's time, ns.
            calm_ns: End of the last stall of the host, on the robot's clock.
        """
        self._fresh = self._latches = self._driver_faulted = False
        self._witness.driver_fault = False
        while self._came and self._came[0][0] <= decided_ns:
            at_ns, data = self._came.popleft()
            *lines, self._held = (self._held + data).split(b"\n")
            self._held = self._held[:LONGEST]
            for line in lines:
                self._line(line, at_ns, at_ns + offset)
        for known in (self.estop, self.bumpers):
            if known.reported_ns is not None and decided_ns - known.reported_ns > SILENT_NS:
                self._silence(known, decided_ns, offset, calm_ns)
            elif not known.sure and decided_ns - known.counted_ns > SILENT_NS:
                self._doubt()  # the last line may not have ended the silence
        if self._fresh:
            # A line that a command made early leaves in the place of the next period's line. A
            # robot that has got a zero already may then get the next one a period later.
            periods = 1 if any(self._witness.last) else 2
            self._due_ns = decided_ns + periods * self._witness.period_ns + MARGIN_NS // 6

    def _line(self, line: bytes, at_ns: int, true_ns: int) -> None:
        match = STATUS.fullmatch(line)
        if match is None:
            return
        pairs = [field.split(b"=") for field in match[1].split()[1:]]
        fields = dict(pairs)
        wrong = match[2] is not None and int(match[2], 16) != binascii.crc_hqx(match[1], 0)
        if wrong or len(fields) < len(pairs):
            return
        # Whether the link already has the check decides whether a line without one counts.
        certain = match[2] is not None or not self._checked
        if b"estop" in fields:
            mark = b"X" if fields[b"estop"] == b"pressed" else b"."
            self._report(self.estop, mark, certain, at_ns, true_ns)
        if b"bumpers" in fields and len(fields[b"bumpers"]) == len(self._places):
            self._report(self.bumpers, fields[b"bumpers"], certain, at_ns, true_ns)
        if b"driver" in fields:
            self._driver(fields[b"driver"] == b"fault", certain, true_ns)
        if self._field in fields:
            self.battery.sure &= certain
            self.battery.take(at_ns, float(fields[self._field].rstrip(b"%")))

    def _report(self, known: _Input, marks: bytes, certain: bool, at_ns: int, true_ns: int) -> None:
        """Handle the emergency stop or the bumpers in a status line.

        A new press stops the robot, or disarms all senders if the robot may drive away.
        """
        known.reported_ns, known.awaited = at_ns, False
        before, was_sure, was_silent = known.marks, known.sure, known.silent
        known.marks, known.sure, known.silent = marks, certain, ""
        if known is self.estop and marks != b".":
            self._powered, self._estopped = False, True
            if certain and self._cut_ns is None:
                self._cut_ns = true_ns
        if not certain:
            known.pressed_ns = None
            self._doubt()
            return
        known.counted_ns = at_ns
        if (was_silent == "surely" and known is self.bumpers) or not before:
            # A pressed emergency stop that was silent still is the same press.
            before = b"." * len(marks)
        if b"X" not in marks:
            known.pressed_ns = None
        elif known.pressed_ns is None:
            known.pressed_ns = true_ns
        if not was_sure:
            self._doubt()
        elif any(now > then for now, then in zip(marks, before, strict=True)):
            self._press(known, true_ns, self._away and known is self.bumpers)

    def _driver(self, faulty: bool, certain: bool, true_ns: int) -> None:
        """Handle the report about the motor drivers in a status line.

        The report is valid until the next one. A fault while the emergency stop is pressed latches
        nothing.
        """
        driver, estop = self.driver, self.estop
        driver.marks, driver.sure = b"X" if faulty else b".", certain
        if not faulty or not certain:
            driver.pressed_ns = None
        elif driver.pressed_ns is None:
            driver.pressed_ns = true_ns
        self._witness.driver_fault |= faulty and not (estop.sure and estop.marks == b"X")
        free = not estop.marks or (estop.is_known and estop.marks == b".")
        self._driver_faulted |= faulty and certain and free and self._powered

    def _silence(self, known: _Input, decided_ns: int, offset: int, calm_ns: int) -> None:
        """Handle an input that the board has not reported for a while: it counts as pressed.

        The daemon may detect the silence a little later after a stall of the host.
        """
        reported_ns, witness = known.reported_ns or 0, self._witness
        if known.awaited and decided_ns + offset > self._plugged_ns + FORGET_NS:
            # The daemon may have forgotten the input, because another board may lack it.
            known.counted_ns, known.pressed_ns = 0, None
        latest_ns = max(reported_ns + SILENT_NS, calm_ns + EXCUSE_NS)
        early = decided_ns < latest_ns + 2 * witness.period_ns + MARGIN_NS
        if early or not known.counted_ns:  # an input that never was reported is not silent
            known.silent = "maybe"
            self._doubt()
        elif known.silent != "surely":
            known.silent = "surely"
            # A pressed emergency stop that falls silent is no new press.
            if known is self.bumpers or b"X" not in known.marks:
                self._press(known, reported_ns + SILENT_NS + offset, False)
            # A clear is obeyed until the silence surely counts, for example behind a stall, and
            # while a bumper is pressed that lets the robot drive away.
            limits = self._away and known is self.bumpers
            if limits or known.pressed_ns is None:
                known.pressed_ns = decided_ns + offset

    def _press(self, known: _Input, true_ns: int, away: bool) -> None:
        witness = self._witness
        witness.counts["emergency stop" if known is self.estop else "bumper pressed"] += 1
        # The robot does not ramp down: its motors have no voltage, or it touches an obstacle.
        witness.cut = self._fresh = True
        if away:
            witness.arming(true_ns)
        else:
            self._latches = True
            insort(witness.stops, true_ns)

    def _doubt(self) -> None:
        """Note that it is uncertain whether an input has stopped the robot."""
        self._doubtful = self._witness.cut = True
        self._witness.perhaps_latched.add("clear")

    # promises

    def step(
        self,
        true_ns: int,
        snapshot: StepResult,
        offset: int,
        calm: bool,
        state: Callable[[], dict[str, Any]],
    ) -> None:
        """Judge a step of the daemon after `take` has read its bytes.

        `calm` is true if the host has not stalled shortly before.
        """
        if not self._reports:
            return
        witness, moving = self._witness, self._moving(snapshot.lines)
        for name, pressed_ns in self._stopping():
            since = f"pressed since {pressed_ns / NS:.3f} s"
            if moving:
                text = f"{moving}, {since}"
                raise BrokenError(f"nothing moves while {name} is pressed", true_ns, text)
            if snapshot.mode not in STOPPED:
                text = f"{snapshot.mode}: {snapshot.reason}, {since}"
                raise BrokenError(f"{name} that is pressed stops the robot", true_ns, text)
        if self._latches and snapshot.mode not in STOPPED:
            text = f"{snapshot.mode}: {snapshot.reason}"
            raise BrokenError("a press stops the robot, however short", true_ns, text)
        if self._fresh and moving:
            raise BrokenError("a press is a zero at once", true_ns, str(moving))
        if self._away and self.bumpers.is_known and b"X" in self.bumpers.marks:
            self._drives_away(true_ns, moving)
            self._pushes(snapshot.decided_ns + offset)
        if not self._mode and self._estopped and "emergency_stop" in snapshot.causes:
            # A new daemon knows a stop of the emergency stop from its latch file. Only `clear` ends
            # it, also if a full disk has lost the `clear` of the daemon before.
            self._powered = self._driver_faulted = False
        self._drivers(true_ns, snapshot)
        self._answers(true_ns, snapshot, calm)
        self._keeps_names(true_ns, snapshot)
        for name in self._needed:
            known = self.estop if name == "estop" else self.bumpers
            if known.awaited and (moving or snapshot.mode in ("ready", "driving")):
                text = f"{snapshot.mode}, and the board has not reported {name}"
                raise BrokenError("a robot waits for its inputs", true_ns, text)
        self._empty(true_ns, snapshot)
        if self._doubtful:  # a clear that is answered only now may be older than the doubt
            witness.perhaps_latched.add("clear")
        causes = witness.stops or witness.perhaps_latched or witness.pending
        if snapshot.mode == "stopped" and self._mode not in (*STOPPED, "") and not causes:
            raise BrokenError("no stop without a cause", true_ns, snapshot.reason)
        maybe = "maybe" in (self.estop.silent, self.bumpers.silent)
        if self._doubtful and not maybe and snapshot.mode in ("ready", "driving"):
            self._doubtful = False
            witness.perhaps_latched.discard("clear")
        self._mode, self._stepped_ns = snapshot.mode, true_ns
        self._before = witness.last, witness.last_ns
        self._looked_ns = self._looked_ns or snapshot.decided_ns
        if snapshot.decided_ns - self._looked_ns > NS:
            self._looked_ns = snapshot.decided_ns
            self._state(true_ns, state(), snapshot.decided_ns)

    def _keeps_names(self, true_ns: int, snapshot: StepResult) -> None:
        """Check that the reason names a client that has stopped the robot, until a clear.

        The judge learns a client's name from the answer to its stop, and forgets all names when the
        daemon ends. The reason names only a few clients. If it names the maximum number, the
        clients known to the judge may be missing.
        """
        if not self._names or snapshot.mode not in STOPPED:
            self._names.clear()
        elif snapshot.mode == "stopped" and not self._witness.pending:
            self._witness.counts["names of stops"] += 1
            known = any(name in snapshot.reason for _, name in self._names)
            if not known and len(CLIENT.findall(snapshot.reason)) < MAX_CLIENTS:
                text = f"{[name for _, name in self._names]} asked, and it is {snapshot.reason!r}"
                raise BrokenError("a stop keeps the name of its client", true_ns, text)

    def _drivers(self, true_ns: int, snapshot: StepResult) -> None:
        """Check that a fault of a motor driver stops the robot.

        A pressed emergency stop removes the drivers' power, and the fault that they then report
        does not count.
        """
        estop = self.estop
        free = not estop.marks and not self._fresh
        free |= estop.is_known and estop.marks == b"." and not self._fresh
        pressed = estop.pressed_ns is not None and estop.pressed_ns < self._stepped_ns
        pressed |= not self._witness.driver_fault
        began = snapshot.mode == "fault" != self._mode and snapshot.code == "driver_fault"
        if self._driver_faulted and free:
            if snapshot.mode not in ("fault", "shutdown"):
                text = f"{snapshot.mode}: {snapshot.reason}"
                raise BrokenError("a fault of a motor driver stops the robot", true_ns, text)
            if began:
                self._witness.counts["driver fault"] += 1
                self._ramps(true_ns, "a fault of a motor driver")
        pressed |= self._cut_ns is not None and self._cut_ns < self._stepped_ns
        if snapshot.mode not in STOPPED:  # a clear ends the excuse
            self._cut_ns = None
            self._powered |= snapshot.mode in ("ready", "driving")
        if began and pressed and self._mode:
            text = f"{snapshot.reason}, the emergency stop was pressed at {self._cut_ns} ns"
            raise BrokenError("drivers without power are no fault", true_ns, text)

    def _stopping(self) -> Iterator[tuple[str, int]]:
        """Yield each input that certainly stops the robot, with the true time of its press."""
        if self.estop.pressed_ns is not None:
            yield "an emergency stop", self.estop.pressed_ns
        latches = not self._away or self.bumpers.silent == "surely"
        if latches and self.bumpers.pressed_ns is not None:
            yield "a bumper", self.bumpers.pressed_ns

    def _moving(self, lines: list[tuple[int, bytes]]) -> list[tuple[float, ...]]:
        """Return the wheel speeds of each line that moves a wheel."""
        speeds = []
        pattern = self._witness.line_pattern
        for match in filter(None, (pattern.match(line) for _, line in lines)):
            motors = [float(g[1:]) * (1 if g[:1] == b"p" else -1) for g in match.groups()]
            speeds.append(tuple(motors[place] * sign for place, sign in self._witness.motors))
        return [wheels for wheels in speeds if any(wheels)]

    def _answers(self, true_ns: int, snapshot: StepResult, calm: bool) -> None:
        """Check that the daemon sends a line within a period after a press."""
        if self._due_ns is None:
            return
        if snapshot.lines or not calm or snapshot.link != "up":
            self._due_ns = None
        elif snapshot.decided_ns > self._due_ns:
            text = f"no line until {self._due_ns / NS:.3f} s of its clock"
            raise BrokenError("a press is a zero within a period", true_ns, text)

    def _sign(self) -> int:
        """Return the sign of the speeds that lead away from all pressed bumpers, 0 for none."""
        marks = zip(self._places, self.bumpers.marks, strict=True)
        signs = {AWAY.get(place, 0) for place, mark in marks if mark == ord("X")}
        return signs.pop() if len(signs) == 1 else 0

    def _drives_away(self, true_ns: int, moving: list[tuple[float, ...]]) -> None:
        witness, sign = self._witness, self._sign()
        room = 0.011 * witness.radius
        for wheels in moving:
            v, w = witness.twist(wheels)
            straight = abs(w) <= room / witness.half
            if not (sign and straight and -room <= v * sign <= AWAY_SPEED + room):
                text = f"{v:.3f} m/s, {w:.3f} rad/s, {self._places} are {self.bumpers.marks!r}"
                raise BrokenError("nothing drives towards a pressed bumper", true_ns, text)

    def _pushes(self, now_ns: int) -> None:
        """Disarm a sender whose command certainly does not lead away from the pressed bumpers.

        It must send a zero before it can move the robot again.
        """
        witness, sign = self._witness, self._sign()
        latest: set[tuple[str, str]] = set()
        for source, wish in reversed(witness.wishes):
            if wish.arrived_ns <= self._stepped_ns:
                return
            sender, mine = (source, wish.identity), witness.priority[source]
            rivals = [rival for rival in witness.senders if witness.priority[rival[0]] >= mine]
            live = now_ns - wish.arrived_ns < witness.timeout[source] - MARGIN_NS
            elsewhere = (wish.v or wish.w) and (not sign or wish.v * sign < -0.01)
            if sender not in latest and rivals == [sender] and wish.certain and live and elsewhere:
                known = witness.senders[sender]
                known.armed_ns = wish.armed_ns = -1
                known.zeros.clear()
                witness.counts["pushes against a bumper"] += 1
            latest.add(sender)

    def _empty(self, true_ns: int, snapshot: StepResult) -> None:
        """Check the stop of an empty battery. The judge allows a small error of the mean."""
        battery, witness = self.battery, self._witness
        if not battery.bounds:
            return
        self._emptied |= battery.may["stop"] or not battery.sure
        if not battery.sure:
            self._doubtful = True
            witness.perhaps_latched.add("clear")
            return
        if snapshot.decided_ns - (battery.at_ns or 0) > 4.8 * NS:
            # A battery that is no longer reported does not refuse a clear.
            battery.must["stop"] = False
        if battery.may["stop"] and snapshot.mode == "stopped" != self._mode and not witness.stops:
            witness.counts["battery empty"] += 1
            witness.stops.append(true_ns)
            self._ramps(true_ns, "an empty battery")
        self._empty_ns = (self._empty_ns or true_ns) if battery.must["stop"] else None
        if battery.must["stop"] and snapshot.mode not in STOPPED:
            text = f"{snapshot.mode}: {snapshot.reason}, the mean is {battery.mean:.2f}"
            raise BrokenError("an empty battery stops the robot", true_ns, text)

    def _ramps(self, true_ns: int, cause: str) -> None:
        """Check that a stop with this cause ramps down instead of sending zeros at once."""
        witness, (before, before_ns) = self._witness, self._before
        even = witness.last_ns - before_ns < 3 * witness.period_ns
        if witness.last != ZERO or witness.cut or not even:
            return
        if witness.ramp_ns(True, before) > 5 * witness.period_ns + NS // 20:
            raise BrokenError(f"{cause} stops the robot with a ramp", true_ns, str(before))

    def cleared(self, asked_ns: int) -> None:
        """Check that no input forbade a clear that the daemon has executed."""
        self._names = [entry for entry in self._names if entry[0] > asked_ns]
        for name, pressed_ns in self._stopping():
            if asked_ns > pressed_ns:
                text = f"pressed since {pressed_ns / NS:.3f} s"
                raise BrokenError(f"no clear works while {name} is pressed", asked_ns, text)
        driver = self.driver
        if driver.sure and driver.pressed_ns is not None and asked_ns > driver.pressed_ns:
            text = f"the last report of a fault began at {driver.pressed_ns / NS:.3f} s"
            raise BrokenError("no clear works while a motor driver has a fault", asked_ns, text)
        if self.battery.sure and self._empty_ns is not None and asked_ns > self._empty_ns:
            text = f"the mean is {self.battery.mean:.2f}"
            raise BrokenError("no clear works while the battery is empty", asked_ns, text)

    def _state(self, true_ns: int, state: dict[str, Any], decided_ns: int) -> None:
        """Compare the inputs in `state` with the lines of the board."""
        if self.estop.is_known:
            expected = "pressed" if self.estop.marks == b"X" else "released"
            self._same(true_ns, "the emergency stop", state["emergency_stop"], {expected})
        if self.bumpers.is_known:
            pressed = str([mark == ord("X") for mark in self.bumpers.marks])
            self._same(true_ns, "the bumpers", str(state["bumpers"]), {pressed})
        battery = self.battery
        late_ns = decided_ns - (battery.at_ns or 0)
        if battery.sure and battery.bounds and battery.stood_s > 3.2 and late_ns < 4 * NS:
            name = f"the level of the battery of mean {battery.mean:.2f}"
            self._same(true_ns, name, state["battery"]["level"], battery.level)

    def _same(self, true_ns: int, name: str, value: str, expected: set[str]) -> None:
        self._witness.counts["input looks"] += 1
        if value not in expected:
            text = f"{name} is {value}, allowed is {sorted(expected)}"
            raise BrokenError("state has the inputs of the board", true_ns, text)
