"""Tests whether the board's watchdog stops the motors when no valid lines arrive.

The check brings the motors to speed, sends nothing or damaged lines for some time, and then zeros.
The distance that the motors run on, beyond that of an ordinary stop, gives the delay of the
watchdog. Firmware that replies only to lines, with momentary speeds, does not show it: then
silences of different durations are tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import cycle

from msgspec import Struct

from acsard.checkup import damage, encoder_counts, motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError
from acsard.checkup.motion import BoardReply
from acsard.checkup.motor_channels import run_up
from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.values import Seconds

# Kinds of damaged lines that must not feed the watchdog. The check sends lines of these kinds.
DAMAGE_KINDS = ("a wrong letter", "neither p nor n", "cut short")

# Of the speed before: from `TURNING` on a motor has not slowed down, below `STOPPED` it stands.
TURNING, STOPPED = 0.9, 0.1

# Upper bound of the watchdog's delay if the motors did not stop even in the longest silence.
NOT_MEASURED = math.inf

# Pair: a lower and an upper bound of the time for which motors run on after the last line, s.
Bounds = tuple[float, float]


class Run(Struct, frozen=True):
    """Behavior of the motors during and after a silence, up to the zeros that end it."""

    # Duration of the silence. It is about 0 for an ordinary stop, without a silence.
    silent_s: Seconds
    # How far the motors ran on before they stood still, as a time.
    ran_s: Seconds
    # From the last line that turned the motors (of an ordinary stop: from the zeros) to rest.
    slow_s: Seconds
    # Speed in the first reply after the silence, of the commanded one: the momentary one, or the
    # mean of the silence if the firmware computes it from the movement since the previous line.
    first: float
    # Speed in the second reply after the silence, as a fraction of the commanded speed.
    second: float
    # Resolution of the reported speeds, expressed as a time (`motion.grain_s`). In this time, a
    # motor at the commanded speed turns by one jump of the reported movement.
    grain_s: Seconds


def finding(board: Board, motors: Sequence[int]) -> Finding:
    """Measure the delay of the watchdog with `motors`, and return the finding.

    Unless it is FAIL, also test damaged lines. At the end, all motors stand still. Raises
    `StoppedError` if no motor turns.
    """
    if not motors:
        return outcomes.find("watchdog: untested")
    stop = run(board, motors, 0.0)
    least_s, most_s = measured(board, motors, stop)
    judged = _judged(least_s, most_s)
    if judged.verdict == "FAIL":
        return judged
    lines = damage.broken_lines(board, motors)
    broken = cycle(line for what, line in lines if what in DAMAGE_KINDS)
    fed = run(board, motors, max(motion.WATCHDOG_SILENCE_S, 2 * most_s) + stop.slow_s, broken)
    if fed.ran_s >= 0.75 * fed.silent_s:
        # The motors ran on during most of the silence, so the damaged lines fed the watchdog.
        # Without them, the watchdog stops the motors after a smaller distance.
        beyond_s = fed.ran_s - stop.ran_s - most_s
        return outcomes.find("watchdog: fed", figure=judged.figure, margin_s=beyond_s)
    return judged


def _judged(least_s: float, most_s: float) -> Finding:
    if most_s == NOT_MEASURED:
        return outcomes.find("watchdog: none", seconds=least_s)
    middle_s, half_s = (least_s + most_s) / 2, (most_s - least_s) / 2
    figure = f"{middle_s * 1000:.0f} ms" + (f" ± {half_s * 1000:.0f}" if half_s >= 0.005 else "")
    # The measurement is not more accurate than 0.01 s.
    least_s, most_s = round(least_s, 2), round(most_s, 2)
    beyond_s = least_s - motion.MAX_WATCHDOG_S
    outcome: outcomes.Outcome = "watchdog: right"
    if beyond_s > 0:
        outcome = "watchdog: late"
    elif most_s < motion.MIN_WATCHDOG_S:
        outcome = "watchdog: early"
    elif most_s > motion.MAX_WATCHDOG_S:
        outcome = "watchdog: unclear"
    return outcomes.find(outcome, figure=figure, seconds=middle_s, margin_s=max(0.0, beyond_s))


def measured(board: Board, motors: Sequence[int], stop: Run) -> Bounds:
    """Return a lower and an upper bound of the time for which motors run on without lines, s.

    The upper bound is `NOT_MEASURED` if the longest silence does not stop them. `stop` is an
    ordinary stop.
    """
    least_s = 0.0
    for length_s in (
        motion.WATCHDOG_SILENCE_S + stop.slow_s,
        motion.STANDSTILL_TIMEOUT_S + stop.slow_s,
    ):
        trial = run(board, motors, length_s)
        ran_on_s = trial.ran_s - stop.ran_s
        if ran_on_s < 0.95 * trial.silent_s:
            break
        least_s = trial.silent_s
    else:
        return motion.STANDSTILL_TIMEOUT_S, NOT_MEASURED
    by_counts = _per_turn(board, motors) > 0
    if not (board.own_clock or by_counts or trial.first >= STOPPED):
        return _bisect_timeout(board, motors, stop, (least_s, trial.silent_s))
    # Each of the two distances may be wrong by one jump of the reported speeds, and a motor that
    # slows down may add half a jump.
    about_s = max(2.5 * stop.grain_s, 0.0 if by_counts else board.gap_s / 2)
    return max(0.0, ran_on_s - about_s), max(0.0, ran_on_s + about_s)


def _bisect_timeout(board: Board, motors: Sequence[int], stop: Run, bounds: Bounds) -> Bounds:
    least_s, most_s = bounds
    # Each run halves the interval between the bounds, unless this computer is late.
    for _ in range(8):
        if most_s - least_s <= max(0.03, 0.1 * most_s):
            break
        answer = run(board, motors, (least_s + most_s) / 2)
        if answer.first >= TURNING or answer.second >= STOPPED:
            least_s = max(least_s, answer.silent_s)
        else:
            most_s = min(most_s, answer.silent_s)
    # The motors need `stop.slow_s` to slow down after the watchdog acts, but `second` is the speed
    # about one period after the silence. `stop.slow_s` is too large by up to one line period,
    # because it ends with a reply.
    least_s -= stop.slow_s - board.period_s + 2 * stop.grain_s
    most_s -= stop.slow_s - board.period_s - motion.LINE_PERIOD_S - 2 * stop.grain_s
    return max(0.0, least_s), max(0.0, most_s)


def run(board: Board, motors: Sequence[int], length_s: float, instead: Iterable[bytes] = ()) -> Run:
    """Bring the motors to speed, send no valid line for `length_s` s, and stop them.

    The damaged lines in `instead` are sent meanwhile. Raises `StoppedError` if no motor
    turns.
    """
    began_s = board.now_s
    full = run_up(board, board.only(motors))
    reached = max(abs(full[motor]) for motor in motors)
    if reached < motion.TURNING_SPEED:
        board.stop_motors()
        letters = ", ".join(board.letters[motor] for motor in motors)
        raise StoppedError(outcomes.find("watchdog: weak", letters=letters))
    # The ramp is over in the second half of the time since `began_s`.
    grain_s = motion.grain_s(
        motion.since(board.replies, (began_s + board.now_s) / 2), motors, reached
    )
    told_s, lines = board.sent_s, iter(instead)
    while (left_s := told_s + length_s - board.now_s) > 0:
        if line := next(lines, b""):
            board.wire.send(line)
        board.listen(min(left_s, board.period_s) if line else left_s)
    silent_s, before = board.now_s - told_s, len(board.replies)
    board.send_zero()
    told_s = told_s if length_s else board.sent_s
    board.stop_motors()
    first, second = (_share(reply, motors, reached) for reply in board.replies[before : before + 2])
    course = motion.since(board.replies, told_s)
    slow_s = next(
        (r.at_s - told_s for r in course if _share(r, motors, motion.STANDING_SPEED) < 1.0),
        motion.SLOWING_TIMEOUT_S,
    )
    # If the board replies to lines, its reply to the last line contains the speeds at the moment at
    # which this line took effect. The motors run on from that moment.
    answered = (
        not board.own_clock and course[0].at_s < told_s + motion.LINE_PERIOD_S + 2 * board.gap_s
    )
    since_s = course[0].at_s if answered else told_s
    ran = motion.covered(board.replies, board.zero, since_s, _per_turn(board, motors))
    ran_s = max(abs(ran[m] / full[m]) for m in motors if abs(full[m]) >= reached / 2)
    return Run(silent_s, ran_s, slow_s, first, second, grain_s)


def _per_turn(board: Board, motors: Sequence[int]) -> float:
    per_turn = encoder_counts.per_turn(board.replies, motors) or 0.0
    wraps = (
        per_turn * motion.RUNAWAY_SPEED / math.tau * motion.STANDSTILL_TIMEOUT_S >= FIELD_VALUES / 2
    )
    return 0.0 if wraps or per_turn < 1 else per_turn


def _share(reply: BoardReply, motors: Sequence[int], reached: float) -> float:
    return max(abs(reply.motors[motor]) for motor in motors) / reached
