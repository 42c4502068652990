"""The promise that a wheel which does not obey its command is found, at every speed.

The judge knows the true speed of each wheel. A wheel that turns against its command, or on after a
stop, must be a latched fault before it has rolled `FACTOR` times 1 rad, 3 encoder counts and the
way in 0.2 s. Before that, the command must have been constant for 0.6 s and three response times. A
robot that drives 20 % faster than any command of that time must be stopped, too. `state` must name
a wheel that does not turn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, get_args

from acsard.core.tables.motor_codes import FaultCode
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS

FAULTS = frozenset(get_args(FaultCode))

MOTORS = {"reversed_motor", "swapped_motors", "runaway"}
"""Faults of the board with which a wheel may turn against its command, or on after a stop."""

ROLL_RAD, ROLL_COUNTS = 1.0, 3
"""A wheel that disobeys is found within the greater of both."""

FACTOR, TIMING_S, DEAD_TIME_NS = 2.6, 0.2, 3 * NS // 5

LEAST_COUNTS = 16
"""The counts of an encoder that the daemon assumes, if they are not configured."""

ROOM_RAD, ROOM_NS = 0.2, 3 * NS // 20
"""Allowed beside these bounds: the way of a line, and the window of the board's speeds."""

STEADY = 0.021
"""rad/s. A command that changes by less is constant: the lines are rounded to 0.01 rad/s."""

TURNS = 0.05
"""rad/s. A wheel that is slower has come to rest."""

TOO_FAST, FAST_NS = 1.25, 3 * NS // 2
"""Share of the fastest command, and the time, after which a robot is certainly too fast."""

FIFTH, BEYOND_RAD, BEYOND_COUNTS = 1.2, 0.3, 2.5
"""`feedback.response_time` of the manual: a fifth faster, by 0.3 rad and 2.5 counts, is a fault."""

SMOOTHED_COUNTS = 3
"""The daemon smooths the speed of a coarse encoder over three counts: it shows the way later."""

NAMED_S = 1.5
"""Within this time more, `state` names the wheel: a coarse encoder is smoothed over a second."""


class Wheels:
    """Compares the true speeds of the wheels with the commands on the wire."""

    def __init__(self, witness: Witness, state: Callable[[], dict[str, Any]]) -> None:
        self._state = state
        config = witness.config
        self._witness = witness
        counts = config.get("sim", {}).get("encoder_counts", 3200)
        response_s = config.get("feedback", {}).get("response_time", 0.2)
        lag_s = config.get("sim", {}).get("motor_time_constant", 0.1)
        self._response_ns = max(DEAD_TIME_NS, int(3 * max(response_s, lag_s) * NS))
        self._roll = max(ROLL_RAD, ROLL_COUNTS * math.tau / counts)
        declared = config["mcu"].get("encoder_counts") or LEAST_COUNTS
        self._count = math.tau / min(counts, declared)
        """The angle of a count, or the one that the daemon assumes, if that is more, rad."""
        self._step_ns = 0
        self._commands = [0.0] * 4
        """The command at the last change of each wheel, rad/s."""
        self._since_ns = [0] * 4
        """Since when the command of each wheel is constant, and nothing else happened."""
        self._rolled = [0.0] * 4
        """Way of each wheel against its command, or on after a stop, rad."""
        self._missed = [0.0] * 4
        """Commanded way of each wheel that does not turn, since `state` last named it, rad."""
        self._recent: list[tuple[int, float]] = []
        """Times and the fastest commands of the last three response times, rad/s."""
        self._fast_ns: int | None = None
        self._beyond = 0.0
        """Way beyond a fifth more than commanded, since then, rad."""

    def _forget(self, at_ns: int) -> None:
        self._since_ns, self._rolled, self._fast_ns = [at_ns] * 4, [0.0] * 4, None
        self._missed = [0.0] * 4

    def see(
        self, at_ns: int, speeds: list[float], causes: frozenset[str], lies: set[str], calm_ns: int
    ) -> None:
        """Judge the true speeds of the wheels.

        Args:
            at_ns: Time of this step.
            speeds: The true speed of each wheel, rad/s, in the order of the commands.
            causes: The codes of all latched causes.
            lies: The names of the present faults of the board.
            calm_ns: Until then something else happened, such as a stall or a lost link.
        """
        witness, passed_ns = self._witness, at_ns - self._step_ns
        self._step_ns = at_ns
        commands = witness.last
        fastest = max(map(abs, commands))
        while self._recent and self._recent[0][0] < at_ns - self._response_ns - ROOM_NS:
            del self._recent[0]
        self._recent.append((at_ns, fastest))
        motors = bool(lies) and lies <= MOTORS | {"gain", "dead_motor"}
        motors |= lies == {"stuck_encoder"}
        found = not causes.isdisjoint(FAULTS)
        unseen = passed_ns > NS // 5
        if not motors or found or unseen or calm_ns > at_ns - NS or not witness.linked:
            self._forget(at_ns)
            return
        for place, (command, speed) in enumerate(zip(commands, speeds, strict=True)):
            if abs(command - self._commands[place]) > STEADY:
                self._commands[place], self._since_ns[place] = command, at_ns
                self._rolled[place] = self._missed[place] = 0.0
            self._named(at_ns, place, passed_ns / NS, speed)
            against = abs(speed) > TURNS and speed * command <= 0.0
            if not against or at_ns - self._since_ns[place] < self._response_ns:
                self._rolled[place] = 0.0
                continue
            self._rolled[place] += abs(speed) * passed_ns / NS
            witness.counts["wheels against"] += 1
            most = FACTOR * (self._roll + TIMING_S * abs(speed))
            most += ROOM_RAD + abs(speed) * ROOM_NS / NS
            if self._rolled[place] > most:
                text = f"wheel {place} turns at {speed:.2f} rad/s for {command:.2f} rad/s"
                text += f", and has rolled {self._rolled[place]:.2f} rad"
                raise BrokenError("a wheel that does not obey is found", at_ns, text)
        self._too_fast(at_ns, min(map(abs, speeds)), passed_ns / NS)

    def _named(self, at_ns: int, place: int, seconds: float, speed: float) -> None:
        """Check that `state` names a wheel that does not turn, or seems not to."""
        if at_ns - self._since_ns[place] < self._response_ns:
            return
        if self._witness.lies == [("stuck_encoder", (self._witness.motors[place][0],))]:
            self._stuck(at_ns, place, seconds, abs(speed))
        if abs(speed) > TURNS:
            return
        command, motor = abs(self._commands[place]), self._witness.motors[place][0]
        faults = [name for name, values in self._witness.lies if values[:1] == (motor,)]
        if faults != ["dead_motor"] or command < 2 * TURNS:
            return
        self._missed[place] += command * seconds
        if self._missed[place] <= self._roll + ROOM_RAD + command * NAMED_S:
            return
        self._missed[place] = 0.0
        self._witness.counts["wheels named"] += 1
        text = self._state()["wheel_fault"]
        blocked = rf"\b{self._witness.names[place]} wheel is blocked|no wheel has begun"
        if not re.search(blocked, text):
            raise BrokenError("a wheel that does not turn is named", at_ns, f"{place}: {text!r}")

    def _stuck(self, at_ns: int, place: int, seconds: float, speed: float) -> None:
        """Check that `state` names a wheel that turns, and whose encoder shows nothing of it."""
        self._missed[place] += speed * seconds
        if self._missed[place] <= 2 * self._roll + ROOM_RAD + speed * NAMED_S:
            return
        self._missed[place] = 0.0
        self._witness.counts["wheels stuck"] += 1
        text, name = self._state()["wheel_fault"], self._witness.names[place]
        if not re.search(rf"\b{name} wheel", text):
            raise BrokenError("a stuck encoder is named", at_ns, f"{name}: {text!r}")

    def _too_fast(self, at_ns: int, slowest: float, seconds: float) -> None:
        """Check that a robot all of whose wheels are too fast is stopped.

        What counts is how far they rolled beyond a fifth more than commanded, not how far at all: a
        robot that is only a little too fast rolls far until a coarse encoder shows it.
        """
        fastest = max(command for _, command in self._recent)
        if fastest < 0.5 or slowest < TOO_FAST * fastest:
            self._fast_ns, self._beyond = None, 0.0
            return
        self._fast_ns = self._fast_ns or at_ns
        self._beyond += (slowest - FIFTH * fastest) * seconds
        most = max(BEYOND_RAD, BEYOND_COUNTS * self._count) + SMOOTHED_COUNTS * self._count
        if at_ns - self._fast_ns > FAST_NS + self._response_ns and self._beyond > most:
            text = f"all wheels turn at {slowest:.2f} rad/s, commanded were {fastest:.2f} rad/s"
            raise BrokenError("a robot that is too fast is stopped", at_ns, text)
