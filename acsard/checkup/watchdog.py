"""The microcontroller's own last safety: does it stop the motors when the host falls silent?

And when what it hears is no line: a watchdog that any byte feeds is none on a half-broken cable.
How long it takes is measured by `silence.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from acsard.checkup import manual
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.limits import CUT_S, WATCHDOG_LEAST_S, WATCHDOG_MOST_S
from acsard.checkup.silence import UNKNOWN, Silence, command, measured, run

FED = 0.75
"""Of the full speed, over all of that time: a watchdog that is right leaves less."""


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Measure it with these motors, which turn as told; they stand again afterwards."""
    if not motors:
        return manual.find("watchdog: untested")
    found = measured(board, motors)
    judged = _judged(found)
    if judged.verdict != "FAIL" and _fed(board, motors, found.most):
        return manual.find("watchdog: fed", figure=judged.figure)
    return judged


def _judged(found: Silence) -> Finding:
    if found.most == UNKNOWN:
        return manual.find("watchdog: none", seconds=found.least)
    middle, half = (found.least + found.most) / 2, (found.most - found.least) / 2
    figure = f"{middle * 1000:.0f} ms" + (f" ± {half * 1000:.0f}" if half >= 0.005 else "")
    least, most = round(found.least, 2), round(found.most, 2)  # it is measured no finer
    if least > WATCHDOG_MOST_S:
        outcome = "late"
    elif most < WATCHDOG_LEAST_S:
        outcome = "early"
    elif most > WATCHDOG_MOST_S:
        outcome = "unclear"
    else:
        outcome = "right"
    return manual.find(f"watchdog: {outcome}", figure=figure, seconds=middle)


def _fed(board: Board, motors: Sequence[int], stopped_s: float) -> bool:
    """Whether broken lines instead of silence, which stops them in so long, keep them running."""
    length_s = max(CUT_S, 2 * stopped_s) + board.slowest_rest_s
    fed = run(board, motors, length_s, _broken(board, motors))
    return fed.ran_s >= FED * fed.silent_s


def _broken(board: Board, motors: Sequence[int]) -> Iterator[bytes]:
    """Commands with a fault, another each time; no way to read them tells more than `SPEED`."""
    while True:
        yield board.line(command(motors))[:20] + b"\r\n"
        yield board.line(command(motors)).replace(b"b", b"x", 1)
        yield board.line(command(motors)).replace(b"p", b"q", 1)
