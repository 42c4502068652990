"""The microcontroller's own last safety: does it stop the motors when the host falls silent?

And when what it hears is no line: a watchdog that any byte feeds is none on a half-broken cable.
How long it takes is measured by `silence.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup.bench import SPEED, Bench
from acsard.checkup.findings import Finding
from acsard.checkup.silence import UNKNOWN, Silence, at_speed, command, measured, tell
from acsard.checkup.turning import mean
from acsard.values import NS_PER_S

CONTRACT_S = 0.3
LEAST_S, MOST_S = 0.1, 0.5
"""What the MCU contract takes."""

NAME = "watchdog"

BROKEN_S = 0.8
"""So long come broken lines instead of silence, besides the motors' own run-out."""

FED = 0.75
"""Of the full speed, over all of that time: a watchdog that is right leaves less."""


def finding(bench: Bench, motors: Sequence[int]) -> Finding:
    """Measure it with these motors, which turn as told; they stand again afterwards."""
    if not motors:
        return Finding(NAME, "SKIPPED", "", "no motor turns as told, so none can show it")
    found = measured(bench, motors)
    if found.most == UNKNOWN:
        return Finding(
            NAME,
            "FAIL",
            f"none within {found.least:.1f} s",
            "the motors run on when the host falls silent: a pulled cable or a hung computer "
            "leaves the robot driving",
            "the firmware must stop the motors 300 ms after the last valid line",
        )
    judged = _judged(found)
    if judged.verdict != "FAIL" and _fed(bench, motors, found.most):
        return Finding(
            NAME,
            "FAIL",
            f"{judged.figure}, but fed by broken lines",
            "it stops the motors when the line is silent, but not when it brings only lines that "
            "are none: a robot on a half-broken cable drives on",
            "only a whole valid line may feed the firmware's watchdog",
        )
    return judged


def _judged(found: Silence) -> Finding:
    middle, half = (found.least + found.most) / 2, (found.most - found.least) / 2
    figure = f"{middle * 1000:.0f} ms"
    if half >= 0.005:
        figure += f" ± {half * 1000:.0f}"
    mend = f"set the firmware's watchdog to {CONTRACT_S * 1000:.0f} ms"
    if found.least > MOST_S:
        text = (
            f"the robot drives on for {middle:.1f} s after a pulled cable: at 1 m/s as many metres"
        )
        return Finding(NAME, "FAIL", figure, text, mend)
    if found.most < LEAST_S:
        text = "so short that a host that is late once stops the robot"
        return Finding(NAME, "WARN", figure, text, mend)
    if found.most > MOST_S:
        text = (
            f"it stops the motors, but whether within {MOST_S * 1000:.0f} ms cannot be told this "
            "coarsely"
        )
        return Finding(NAME, "WARN", figure, text, "look it up in the firmware: 300 ms is right")
    return Finding(NAME, "PASS", figure, f"contract {CONTRACT_S * 1000:.0f} ms")


def _fed(bench: Bench, motors: Sequence[int], stopped_s: float) -> bool:
    """Whether broken lines instead of silence, which stops them in so long, keep them running."""
    length_s = max(BROKEN_S, 2 * stopped_s) + bench.slowest_rest_s
    at_speed(bench, motors)
    end_ns = bench.wire.now_ns() + int(length_s * NS_PER_S)
    number = 0
    while bench.wire.now_ns() < end_ns:
        bench.wire.send(_broken(bench, motors, number))
        bench.listen(bench.period_s)
        number += 1
    since_ns = bench.wire.now_ns() - max(0.2, 2.5 * bench.gap_s) * NS_PER_S
    seen = [reply for reply in bench.replies if reply.at_ns > since_ns]
    if len(seen) >= 2:  # it speaks all the same
        shown = mean(seen)
        turned = max(abs(shown[motor]) for motor in motors) > SPEED / 2
    else:
        first, second = tell(bench, motors)
        turned = first >= FED or second >= 0.5
    bench.rest()
    return turned


def _broken(bench: Bench, motors: Sequence[int], number: int) -> bytes:
    """A command with a fault, another each time; no way to read it tells more than `SPEED`."""
    good = bench.line(command(motors))
    if number % 3 == 0:
        return good[:20] + b"\r\n"
    if number % 3 == 1:
        return good.replace(b"b", b"x", 1)
    return good.replace(b"p", b"q", 1)
