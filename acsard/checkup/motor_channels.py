"""Turns one motor at a time forward and backward, and asks the operator which wheel turned.

A channel is a motor with its encoder and its wheel. The speeds of the encoders and the answers of
the operator show whether these three belong together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

from msgspec import Struct, structs

from acsard.checkup import motion, outcomes
from acsard.checkup.board import Board, Operator
from acsard.checkup.findings import Finding, motor_name, motor_names, wheel_of, with_spaces
from acsard.checkup.motion import (
    PROBE_MOVING_SPEED,
    SHORT_MEASUREMENT_S,
    SPEED,
    moving,
)
from acsard.core.config.settings import McuConfig
from acsard.core.link.codec import Motors

# Largest relative difference between an encoder's speed and the commanded speed. If the difference
# is larger, the check fails.
FAIL_TOLERANCE = 0.25

# Largest usual relative difference between an encoder's speed and the commanded speed. If the
# difference is larger, the check warns.
WARN_TOLERANCE = 0.05

Kind = Literal[
    "right",  # only the motor's own encoder moved, as commanded
    "reversed",  # only its own encoder moved, but against the command
    "dead",  # no encoder moved
    "other",  # only the encoder of another motor moved
    "several",  # several encoders moved, or different ones forward and backward
    "one way",  # encoders moved in only one of the two directions
    "last edge",  # its speed never passed through zero when it was reversed
    "no sign",  # its own encoder reported one direction for both
    "size",  # the error of the speed is larger than `FAIL_TOLERANCE`
    "off",  # the error of the speed is larger than `WARN_TOLERANCE`
    "late",  # this computer was too late to judge the motor
]
PLAIN_OUTCOMES: dict[Kind, outcomes.Outcome] = {
    "right": "motor: right",
    "several": "motor: several",
    "one way": "motor: one way",
    "last edge": "motor: last edge",
    "no sign": "motor: no sign",
    "size": "motor: size",
    "off": "motor: off",
}

# Only the motor's own encoder moves, in the right direction.
FOLLOWING_KINDS: tuple[Kind, ...] = ("right", "off", "size", "last edge")


class Channel(Struct, frozen=True):
    """Behavior of one motor in its test, as the encoders and the operator report it.

    `forth` has the speeds of all encoders, rad/s, for the command forward (letter p), and
    `back` those for backward (letter n).
    """

    motor: int
    forth: Motors
    back: Motors
    # Wheel that the operator saw turn; "" if no wheel turned, None if nobody was asked.
    wheel: str | None = None
    # Whether the operator saw the wheel turn forward first. False means backward first.
    forward: bool = True
    # The motor was only probed, because its encoder did not follow: `forth` has the probe's speeds.
    probed: bool = False
    # Possible relative error of the measured speeds, because the encoder is coarse.
    unsure: float = 0.0
    # Its reported speed jumped over zero at each of several reversals.
    jumps: bool = False
    # False if this computer was too late, so that the other fields are doubtful.
    judged: bool = True

    @property
    def moved(self) -> list[int]:
        """Numbers of the encoders that moved while this motor was commanded to turn."""
        if not self.probed:
            return moving(self.forth) or moving(self.back)
        return moving(self.forth, max(PROBE_MOVING_SPEED, max(map(abs, self.forth)) / 4))

    @property
    def kind(self) -> Kind:
        """Kind of the result for this motor. The operator's answers do not influence it."""
        if not self.judged:
            return "late"
        moved, own = self.moved, self.motor
        if not moved:
            return "dead"
        if not self.probed and not (moving(self.forth) and moving(self.back)):
            return "one way"
        if len(moved) > 1 or not (self.probed or moving(self.back) == moved):
            return "several"
        if moved != [own]:
            return "other"
        if self.probed or self.forth[own] < 0 < self.back[own]:
            return "reversed"
        if self.forth[own] * self.back[own] > 0.0:
            return "no sign"
        if self.error > FAIL_TOLERANCE:
            return "size"
        if self.error > WARN_TOLERANCE + self.unsure:
            return "off"
        return "last edge" if self.jumps else "right"

    @property
    def turns(self) -> bool:
        """Whether the own encoder moved forward as commanded, if slowly, alone or not.

        The firmware then controls the motor, so that it is safe to turn it again.
        """
        return not self.probed and self.forth[self.motor] >= motion.TURNING_SPEED

    @property
    def error(self) -> float:
        """Larger relative difference of the own encoder's speed from the command, of both
        directions.
        """
        own = self.motor
        return max(abs(self.forth[own] / SPEED - 1), abs(self.back[own] / SPEED + 1))


def encoder_finding(mcu: McuConfig, channel: Channel) -> Finding:
    motor, moved = channel.motor, channel.moved
    forth, back = channel.forth[motor], channel.back[motor]
    there = moved[0] if moved else motor
    letters = mcu.wheels.letters
    # If a motor seems to stand still for half of `beyond_s` in a measurement of
    # `SHORT_MEASUREMENT_S`, then it seems too slow by the part of the error that exceeds
    # `FAIL_TOLERANCE`. `lateness.is_doubtful` compares a delay of this computer with half of this
    # margin.
    beyond_s = (
        2 * SHORT_MEASUREMENT_S * (channel.error - FAIL_TOLERANCE)
        if channel.kind == "size"
        else 0.0
    )
    return outcomes.find(
        _outcome(mcu, channel),
        name=motor_name(mcu, motor),
        figure=f"{forth:+.2f} {'rad/s, probed' if channel.probed else f'{back:+.2f} rad/s'}",
        shown=", ".join(f"encoder {letters[m]} {channel.forth[m]:+.2f}" for m in moved),
        here=letters[motor],
        there=letters[there],
        reversed=", and one motor or encoder is reversed" if channel.forth[there] < 0 else "",
        wheel=with_spaces(wheel_of(mcu, motor)[0]),
        error=channel.error,
        which="slower" if forth - back < 2 * SPEED else "faster",
        tolerance=FAIL_TOLERANCE,
        speed=SPEED,
        margin_s=beyond_s,
    )


def _outcome(mcu: McuConfig, channel: Channel) -> outcomes.Outcome:
    wheel, sign = wheel_of(mcu, channel.motor)
    answer = channel.wheel
    if channel.kind in FOLLOWING_KINDS and answer == "":
        return "motor: loose"
    match channel.kind:
        case "dead" if answer is not None:
            return "motor: dead, turns" if answer else "motor: dead, still"
        case "dead":
            return "motor: dead, not seen"
        case "reversed" if answer == wheel:
            right = channel.forward == (sign > 0)
            return "motor: reversed, encoder" if right else "motor: reversed, motor"
        case "reversed":
            return "motor: reversed, not seen"
        case "other" if answer == wheel:
            return "motor: other, encoder"
        case "other" if answer == wheel_of(mcu, channel.moved[0])[0]:
            return "motor: other, motor"
        case "other":
            return "motor: other, not seen"
        case kind:
            return PLAIN_OUTCOMES[kind]


def stands(channel: Channel) -> bool:
    """Return whether neither an encoder nor the operator has seen this motor turn."""
    return channel.kind == "dead" and not channel.wheel


def wheel_map(mcu: McuConfig, channels: Sequence[Channel]) -> Finding:
    """Return the finding that compares `[mcu.wheels]` with the wheels that the operator saw turn.

    It suggests the configured entry of a motor that does not work, or whose wheel was not seen.
    """
    unseen = [channel.motor for channel in channels if channel.wheel is None]
    if len(unseen) == len(channels):
        return outcomes.find("wheel map: not seen")
    entries: dict[str, str] = {}
    faulty: list[str] = []
    for channel in channels:
        letter, (wheel, sign) = mcu.wheels.letters[channel.motor], wheel_of(mcu, channel.motor)
        if channel.wheel and channel.kind in (*FOLLOWING_KINDS, "late"):
            wheel, sign = channel.wheel, 1 if channel.forward else -1
        elif channel.wheel and channel.wheel != wheel:
            faulty.append(f"motor {letter} turn the {with_spaces(channel.wheel)} wheel")
        if wheel in entries:
            return outcomes.find("wheel map: twice", wheel=with_spaces(wheel))
        entries[wheel] = f"{'+' if sign > 0 else '-'}{letter}"
    names = WHEEL_ANSWERS[len(channels)].values()
    wrong = [wheel for wheel in names if entries[wheel] != getattr(mcu.wheels, wheel)]
    outcome: outcomes.Outcome = "wheel map: right"
    if wrong:
        outcome = "wheel map: other"
    elif faulty:
        outcome = "wheel map: faulty"
    elif unseen:
        outcome = "wheel map: partly"
    return outcomes.find(
        outcome,
        {} if faulty else {f"mcu.wheels.{wheel}": entries[wheel] for wheel in names},
        map=" ".join(entries[wheel] for wheel in names),
        wheels=", ".join(map(with_spaces, wrong)),
        answers=", ".join(faulty),
        motors=motor_names(mcu, unseen),
    )


# Of `WARN_TOLERANCE`: with a larger error, a longer measurement follows, because a heavy wheel may
# not have reached its speed.
REPEAT_FRACTION = 0.8

# If the board reports more often, a wrong sign in one report is a movement of millimetres.
LONG_GAP_S = 0.05

REVERSALS = 6

# A report below this share of the speed has a part of the reversal in it. With less, all of a
# reversal could fall between the reports of momentary speeds.
SEEN_REVERSAL = 0.85

# Time over which the second, longer measurement of a speed averages the speed.
LONG_MEASUREMENT_S = 0.75 * motion.MOTOR_TIMEOUT_S

# Largest number of short measurements that `run_up` averages to get the present speed.
MAX_MEASUREMENTS = 8

# By the number of wheels, in the order of `acsard.toml`.
WHEEL_ANSWERS = {
    4: {"fr": "front_right", "fl": "front_left", "rl": "rear_left", "rr": "rear_right"},
    2: {"l": "left", "r": "right"},
}


def turn(board: Board, motor: int, speed: float) -> tuple[Motors, float]:
    """Bring a motor to `speed`, and return the speeds of all encoders, rad/s.

    The second result is the possible relative error, because an encoder counts whole steps.
    """
    means = run_up(board, board.only([motor], speed))
    unsure = _unsure(board, motor, 2 * _look_s(board))
    if REPEAT_FRACTION * WARN_TOLERANCE + unsure < abs(means[motor] / speed - 1) <= FAIL_TOLERANCE:
        # The motor is weak, or its wheel is heavy and has not yet reached its speed. A longer
        # measurement shows which of the two is the case.
        board.drive(board.only([motor], speed), motion.MOTOR_TIMEOUT_S)
        steady = motion.since(board.replies, board.now_s - LONG_MEASUREMENT_S)
        means = motion.mean(steady, board.zero)
        unsure = _unsure(board, motor, LONG_MEASUREMENT_S)
    return means, unsure


def _unsure(board: Board, motor: int, seconds: float) -> float:
    # The ramp is over in the second half of the time.
    look = motion.since(board.replies, board.now_s - seconds / 2)
    return motion.grain_s(look, [motor]) / seconds


def _jumps(board: Board, motor: int) -> bool:
    # Some firmware gives all edges since its last report the direction of the last edge. A right
    # report that is later than a reversal by some part of the time between reports shows almost
    # no movement. So the reversals are spread over this time. The motor turns backward before.
    if board.gap_s < LONG_GAP_S:
        return False
    slowest, phases = list[float](), list[float]()
    for n in range(REVERSALS):
        speeds = board.only([motor], -motion.SPEED if n % 2 else motion.SPEED)
        began_s = board.now_s
        replies = board.drive(speeds, (4 + 1 / REVERSALS) * board.gap_s)
        slowest += [min((abs(reply.motors[motor]) for reply in replies), default=0.0)]
        phases += [(reply.at_s - began_s) / board.gap_s % 1.0 for reply in replies[:1]]
    # A right mean speed is below a third for at least a third of the reversal times. A board that
    # answers only some lines may never be asked in this third.
    phases.sort()
    again = [phase + 1.0 for phase in phases[:1]]
    spread = all(later - phase < 1 / 3 for phase, later in pairwise(phases + again))
    # If a reversal is not seen at all, the motor may reverse between two right reports.
    return (
        spread and min(slowest) > motion.SPEED / 3 and max(slowest) < SEEN_REVERSAL * motion.SPEED
    )


def _look_s(board: Board) -> float:
    return max(motion.SHORT_MEASUREMENT_S / 2, 2.5 * board.gap_s)


def run_up(board: Board, motors: Motors) -> Motors:
    """Ramp up to the speeds `motors`, and return each encoder's mean speed, rad/s.

    It returns when the speeds are steady, when time is over, or earlier if no encoder moves.
    """
    steps = max(1, int(motion.SHORT_MEASUREMENT_S / board.period_s))
    before = board.zero
    for step in range(1, steps + 1):
        command = tuple(round(speed * step / steps, 2) for speed in motors)
        replies = [reply.motors for reply in board.drive(command, board.period_s)]
        board.repeats.record(replies, before, command)
        before = command
    board.repeats.check()
    began_s, look_s = board.now_s, _look_s(board)
    driven = [motor for motor, speed in enumerate(motors) if speed]
    means, looks, steady = board.zero, 0, 0
    while steady < 2 and board.now_s - began_s < _patience_s(board, driven):
        board.drive(motors, look_s)
        looks += 1
        # A coarse encoder needs more measurements than a fine one.
        last = min(MAX_MEASUREMENTS, max(1, looks - 1))
        means = motion.mean(motion.since(board.replies, board.now_s - last * look_s), board.zero)
        near = [
            m for m in moving(means) if abs(abs(means[m]) / motion.SPEED - 1) < 0.4 * FAIL_TOLERANCE
        ]
        steady = steady + 1 if len(near) >= len(driven) else 0
        if looks * look_s >= motion.WATCHDOG_SILENCE_S and not moving(means, motion.STANDING_SPEED):
            # Do not go on: without an encoder, the firmware's speed control may command ever more.
            break
    return means


def _patience_s(board: Board, driven: list[int]) -> float:
    shares = motion.trend(board.replies, board.zero, board.now_s, board.gap_s)
    rises = any(shares[motor] > 1 / motion.SLOWING_RATIO for motor in driven)
    return motion.SLOWING_TIMEOUT_S if rises else motion.MOTOR_TIMEOUT_S


def channel(board: Board, motor: int) -> Channel:
    """Turn a motor forward and backward, and return how the encoders moved.

    If the last motor does not move, try the other line ending, and keep it if it moves then.
    """
    result = _both_ways(board, motor)
    is_last = motor == len(board.letters) - 1
    if is_last and result.kind == "dead" and not board.latched:
        result = _with_other_comma(board, result)
    return result


def _both_ways(board: Board, motor: int) -> Channel:
    speeds = probe(board, motor)
    if speeds is not None:
        return Channel(motor, speeds, board.zero, probed=True)
    (forth, unsure), back = turn(board, motor, motion.SPEED), board.zero
    if motor in moving(forth):
        board.stop_motors()
        back, other = turn(board, motor, -motion.SPEED)
        unsure = max(unsure, other)
    jumps = motor in moving(back) and _jumps(board, motor)
    if motor not in moving(back):
        board.stop_and_be_silent(motion.WATCHDOG_SILENCE_S)
    board.stop_motors()
    return Channel(motor, forth, back, unsure=unsure, jumps=jumps)


def probe(board: Board, motor: int) -> Motors | None:
    """Turn a motor slowly and briefly, to find out whether its own encoder moves with it.

    If it moves, return None; the motor may still turn then. Else stop it, and return the speeds of
    all encoders.
    """
    # The firmware may drive a motor without a working encoder to full speed, but the probe is too
    # short for that. If the encoder does not follow, repeat the probe, because a coarse encoder may
    # need more movement.
    began_s = board.now_s
    speeds = _probe(board, motor, motion.SPEED / 2)
    own = [reply.motors[motor] for reply in motion.since(board.replies, began_s)]
    nonzero = [speed for speed in own if speed]
    if speeds is None or (len(nonzero) >= 3 and max(nonzero) < 0):
        # Several replies show that the motor or its encoder is reversed. A second probe would make
        # the motor run away again.
        return speeds
    if not moving(speeds, motion.PROBE_MOVING_SPEED):
        return _probe(board, motor, motion.SPEED)
    again = _probe(board, motor, motion.SPEED / 2)
    # If only the first probe showed a movement, a motor may have coasted during that probe.
    return again if again is None or any(again) else _probe(board, motor, motion.SPEED)


def _probe(board: Board, motor: int, speed: float) -> Motors | None:
    coasting = board.replies[-1].motors if board.replies else board.zero
    began_s = board.now_s

    def mean_speeds() -> Motors:
        seconds = board.now_s - began_s
        ran = motion.covered(board.replies, board.zero, began_s)
        pairs = zip(ran, coasting, strict=True)
        sure = [math.copysign(max(0.0, abs(a) - abs(v) * seconds), a) for a, v in pairs]
        return tuple(angle / motion.SHORT_MEASUREMENT_S for angle in sure)

    own = 0.0
    while (
        board.now_s < began_s + motion.SHORT_MEASUREMENT_S and own > -4 * motion.PROBE_MOVING_SPEED
    ):
        board.drive(board.only([motor], speed), board.period_s)
        own = mean_speeds()[motor]
    if own >= motion.PROBE_MOVING_SPEED:
        return None
    # Without a correct encoder, the firmware may drive the motor to full speed although it receives
    # zeros. Only its watchdog stops the motor. So a motor that has moved must stand still before
    # the next zeros are sent.
    moved = moving(mean_speeds(), motion.PROBE_MOVING_SPEED)
    board.stop_and_be_silent(motion.STANDSTILL_TIMEOUT_S if moved else motion.WATCHDOG_SILENCE_S)
    board.stop_motors()
    speeds = mean_speeds()
    return None if speeds[motor] >= motion.PROBE_MOVING_SPEED else speeds


def _with_other_comma(board: Board, dead: Channel) -> Channel:
    configured, board.comma = board.comma, not board.comma
    channel = _both_ways(board, dead.motor)
    if channel.probed or dead.motor not in moving(channel.forth):
        board.comma = configured
        return dead
    turn(board, dead.motor, motion.SPEED)
    board.latched = not board.settles(configured)
    board.stop_motors()
    return channel


def ask_which_wheel(board: Board, operator: Operator, channel: Channel) -> Channel:
    """Ask the operator which wheel turned and in which direction; return `channel` with that.

    The wheels stand still during a question, and turn again on request.
    """
    wheels = WHEEL_ANSWERS[len(board.letters)]
    *others, last = (f"{with_spaces(wheel)} ({short})" for short, wheel in wheels.items())
    question = (
        f"which wheel did motor {board.letters[channel.motor]} turn: {', '.join(others)} or "
        f'{last}? Type "none" if no wheel turned, or "again" to see the motor turn once more'
    )
    while (which := operator.ask(question, (*wheels, "none", "again"))) == "again":
        _both_ways(board, channel.motor)
    if which is None:
        return channel
    if wheel := wheels.get(which):
        question = (
            "which way did the wheel turn first: forward (as when the robot drives ahead) or back?"
        )
        way = operator.ask(question, ("forward", "back"))
        return structs.replace(channel, wheel=wheel, forward=way != "back")
    return structs.replace(channel, wheel="")
