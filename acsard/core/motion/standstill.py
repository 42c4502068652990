"""Finds that no wheel moves: four equal verdicts are one, and it is not known whose fault it is.

All wheels turned and at once none shows any motion: the encoders or the supply have failed, or the
robot ran into something, which is a fault after `SUDDEN_S`. Wheels that do not begin may stand at a
kerb, have no power, or be told a speed that their motors ignore: a warning. Commands that a motor
obeys are given up after `BEGIN_S`, and the third time in a minute is a fault.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct, field

from acsard.core.codes import Reason, joined, reason
from acsard.core.values import Rad, RadPerS, Seconds

# All wheels turned this fast under such a command, and at once none shows any motion. Motors
# without power slow down. Slower commands may be too slow for the motors.
TURNS, AT_ONCE_S, SUDDEN_S = 2.0, 0.1, 1.0

REPORT_S, REPORT_ANGLE = 1.0, 1.0  # commanded in vain, both of them, until it is a warning
BEGIN_S, TRIES, TRIES_S = 3.0, 3, 60.0

COMMANDED = 0.005  # rad/s: a line to the board shows a lower one as 0.00

Verdict = Literal["", "reported", "given up", "fault"]


class Standstill(Struct):
    all_turned: bool = False  # at `TURNS` at least, until `AT_ONCE_S` before the last motion
    slow_s: Seconds = 0.0  # with any motion since then
    none_s: Seconds = 0.0  # without any, while a side is commanded
    none_angle: Rad = 0.0  # the most that was commanded meanwhile
    fast_s: Seconds = 0.0  # of it, with commands of `TURNS` at least
    why: Reason | None = None  # until a wheel turns
    tries: list[Seconds] = field(default_factory=list)  # the time since each of them

    def forget(self) -> None:
        self.all_turned, self.none_s, self.none_angle, self.fast_s = False, 0.0, 0.0, 0.0

    def add(
        self, angles: list[Rad], commands: tuple[RadPerS, RadPerS], s: Seconds, count: Rad
    ) -> Verdict:
        """Add a block: the angles of the wheels, and the commands of the left and right side."""
        turned, command = [abs(angle) for angle in angles], max(map(abs, commands))
        if self.tries:
            self.tries = [since + s for since in self.tries if since + s <= TRIES_S]
        if any(turned):
            if min(turned) >= TURNS * s:
                self.all_turned, self.slow_s = True, 0.0
            else:
                self.slow_s += s
                self.all_turned = self.all_turned and self.slow_s <= AT_ONCE_S
            self.none_s = self.none_angle = self.fast_s = 0.0
            self.why = None
            return ""
        # A command that is small, or ends, is no evidence: only motion is.
        self.all_turned = self.all_turned and command >= TURNS
        if command < COMMANDED:
            return ""
        self.none_s += s
        self.none_angle += command * s
        if command >= TURNS:
            self.fast_s += s
        if self.all_turned:
            if self.fast_s < SUDDEN_S:
                return ""
            self.why = _why("no_wheel_moves", commands, SUDDEN_S)
            self.all_turned, self.fast_s = False, 0.0
            return "fault"
        if self.fast_s >= BEGIN_S:
            self.tries.append(0.0)
            self.fast_s = 0.0
            self.why = _why("no_wheel_begins", commands, self.none_s)
            if len(self.tries) < TRIES:
                return "given up"
            self.tries = []
            return "fault"
        if self.why is None and self.none_s >= REPORT_S and self.none_angle >= REPORT_ANGLE + count:
            self.why = _why("no_wheel_begins", commands, self.none_s)
            return "reported"
        return ""


def _why(
    code: Literal["no_wheel_moves", "no_wheel_begins"],
    commands: tuple[RadPerS, RadPerS],
    seconds: Seconds,
) -> Reason:
    left, right = commands
    figures = f"(commanded {left:.2f} and {right:.2f}, measured 0 rad/s)"
    return joined(reason(code, seconds=seconds, figures=figures))
