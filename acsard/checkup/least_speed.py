"""Finds the least speed that moves each motor.

Many motors, and firmware without a speed controller, ignore small commands. A planner sends some.
"""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup import motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, motor_names

# rad/s. At each one the motors are told to turn by `ANGLE` rad, more than a count of a coarse
# encoder, and a motor that turns by `MOVED` of it follows.
SPEEDS, ANGLE, MOVED = (0.3, 0.6, 1.2, 2.0), 0.6, 0.3
HEAVY_S = 1.0  # longer, for wheels that speed up slowly


def finding(board: Board, motors: Sequence[int], radius: float) -> Finding:
    """Turn the motors together at rising speeds, and stop them; `radius` is of a wheel, m."""
    if not motors:
        return outcomes.find("least speed: untested")
    still, least, too_slow = list(motors), SPEEDS[0], 0.0
    for speed in SPEEDS:
        began_s = board.now_s
        told = [speed if motor in motors else 0.0 for motor in range(len(board.letters))]
        board.drive(tuple(told), ANGLE / speed + HEAVY_S)
        turned = motion.covered(board.replies, board.zero, began_s)
        ignored = [motor for motor in still if abs(turned[motor]) < MOVED * ANGLE]
        if not ignored:
            least = speed
            break
        still, too_slow = ignored, speed
    else:
        least = motion.SPEED
    board.stop_motors()
    if not too_slow:
        return outcomes.find("least speed: small", least=least)
    return outcomes.find(
        "least speed: large",
        least=least,
        motors=motor_names(board.mcu, still),
        ignored=too_slow,
        linear=too_slow * radius,
    )
