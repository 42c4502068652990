"""Drives the motors up to the highest speed that the configured limits allow.

Motors may be too weak for it, and a field of the firmware may overflow: then the daemon takes a
sound wheel for one that turns the wrong way.
"""

from __future__ import annotations

from collections.abc import Sequence

from acsard.checkup import motion, outcomes
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, motor_names
from acsard.checkup.motor_channels import FAIL_TOLERANCE
from acsard.core.link.codec import Motors

STEPS = 4  # speeds on the way to the highest one, after that of the other steps
RAMP = 20.0  # rad/s2: the default acceleration on a wheel of 0.05 m
# Replies in a row, so that a damaged line is no overflow, which report more than this share of the
# command with the other sign.
AGAINST, AGAINST_SHARE = 3, 0.25


def finding(
    board: Board,
    motors: Sequence[int],
    refusal: outcomes.Outcome | None,
    top: float,
    radius: float,
) -> Finding:
    """Raise the motors to `top` rad/s, and stop them; `radius` is of a wheel, m.

    `refusal` is the outcome that forbids it.
    """
    if not motors:
        return outcomes.find("top speed: untested", top=top)
    if refusal is not None:
        return outcomes.find(refusal, top=top)
    # A motor that is backward at the speed at which it was right alone is not driven faster.
    first = min(top, motion.SPEED)
    rising = [top * step / STEPS for step in range(1, STEPS + 1)]
    # `Board.settles` restores it when the motors stand still, also after a restart.
    board.most_speed = 1.5 * max(top, motion.SPEED)
    outcome: outcomes.Outcome = "top speed: reached"
    means, speed = board.zero, 0.0
    for following in (first, *(speed for speed in rising if speed > first)):
        passed, speed, began = speed, following, len(board.replies)
        means = _raise(board, motors, passed, speed)
        recent = board.replies[began:]
        if any(_against(recent, motor, speed) for motor in motors):
            outcome = "top speed: overflow" if passed else "top speed: backward"
            break
        # The first speed is too low for the short measurements of a coarse encoder.
        judged = speed > first or speed == top
        if judged and min(means[motor] for motor in motors) < (1 - FAIL_TOLERANCE) * speed:
            outcome = "top speed: short"
            break
    worst = min(motors, key=lambda motor: means[motor])
    slow = [motor for motor in motors if means[motor] < (1 - FAIL_TOLERANCE) * speed]
    board.stop_motors()
    return outcomes.find(
        outcome,
        top=top,
        linear=top * radius,
        most=means[worst],
        speed=speed,
        below=passed,
        below_linear=passed * radius,
        motors=motor_names(board.mcu, slow or [worst], ", "),
    )


def _raise(board: Board, motors: Sequence[int], low: float, high: float) -> Motors:
    steps = max(1, round((high - low) / RAMP / board.period_s))
    for step in range(1, steps + 1):
        command = round(low + (high - low) * step / steps, 2)
        board.drive(board.only(motors, command), board.period_s)
    look_s = max(motion.SHORT_MEASUREMENT_S, 2.5 * board.gap_s)
    end_s, before = board.now_s + motion.MOTOR_TIMEOUT_S, 0.0
    while True:
        means = motion.mean(board.drive(board.only(motors, high), look_s), board.zero)
        least = min(means[motor] for motor in motors)
        if least >= 0.95 * high or board.now_s >= end_s or abs(least - before) < 0.01 * high:
            return means
        before = least


def _against(replies: Sequence[motion.BoardReply], motor: int, speed: float) -> bool:
    run = 0
    for reply in replies:
        run = run + 1 if reply.motors[motor] < -AGAINST_SHARE * speed else 0
        if run >= AGAINST:
            return True
    return False
