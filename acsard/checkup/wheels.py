"""Turns one motor at a time forward and backward, and asks the operator which wheel turned.

A channel is a motor with its encoder and its wheel. From the speeds that the encoders show and from
the answers, the check finds out whether these three parts belong together. `Channel`,
`encoder_finding` and `wheel_map` compute this without any I/O.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct, structs

from acsard.checkup import motion, outcomes
from acsard.checkup.board import Board, Operator
from acsard.checkup.findings import Finding, motor_name, wheel_of, words
from acsard.checkup.motion import GLANCE_S, PROBE_MOVES, SPEED, ZERO, moving
from acsard.core.config.settings import McuConfig
from acsard.core.link.codec import LETTERS, Motors
from acsard.core.values import WHEELS

TOLERANCE = 0.25
"""If an encoder's speed differs from the commanded speed by more than this fraction, the check
fails."""

OFF = 0.05
"""If an encoder's speed differs from the commanded speed by more than this fraction, the check
warns."""

Kind = Literal["right", "reversed", "dead", "other", "several", "one way", "size", "off", "late"]

FOLLOWS: tuple[Kind, ...] = ("right", "off", "size")
"""The values of `Channel.kind` for a motor that moves only its own encoder, in the commanded
direction."""


class Channel(Struct, frozen=True):
    """Behavior of one motor, as the four encoders showed it and the operator saw it.

    `forth` and `back` are the speeds of the four encoders, rad/s, while the motor was commanded
    forward (letter p) and backward (letter n).
    """

    motor: int
    forth: Motors
    back: Motors
    wheel: str | None = None
    """Wheel that the operator saw turn; "" if no wheel turned, None if no person watched."""
    forward: bool = True
    """Whether the wheel turned forward first, as the operator saw it."""
    probed: bool = False
    """Whether the motor was only probed (turned slowly and briefly), because its own encoder did
    not follow. Then `forth` contains the speeds of the probe, and `back` is zero."""
    unsure: float = 0.0
    """Possible relative error of the measured speeds because of a coarse encoder."""
    judged: bool = True
    """Whether this computer was on time. If it was late, the other fields may be wrong."""

    @property
    def moved(self) -> list[int]:
        """Numbers of the encoders that moved."""
        if not self.probed:
            return moving(self.forth) or moving(self.back)
        return moving(self.forth, max(PROBE_MOVES, max(map(abs, self.forth)) / 4))

    @property
    def kind(self) -> Kind:
        """Result for this motor from the encoders alone, without the operator's answer."""
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
        if self.error > TOLERANCE:
            return "size"
        return "off" if self.error > OFF + self.unsure else "right"

    @property
    def error(self) -> float:
        """Relative difference between the speed of the motor's own encoder and the commanded speed:
        the larger of the values for forward and backward."""
        own = self.motor
        return max(abs(self.forth[own] / SPEED - 1), abs(self.back[own] / SPEED + 1))


def encoder_finding(mcu: McuConfig, channel: Channel) -> Finding:
    motor, moved = channel.motor, channel.moved
    forth, back = channel.forth[motor], channel.back[motor]
    there = moved[0] if moved else motor
    # A delay of `beyond_s` would explain the error, because in half of the measurements the motor
    # would have seemed to stand for that time.
    beyond_s = 2 * GLANCE_S * (channel.error - TOLERANCE) if channel.kind == "size" else 0.0
    loose = channel.kind in FOLLOWS and channel.wheel == ""
    return outcomes.find(
        "motor: loose" if loose else f"motor: {channel.kind}{_whose(mcu, channel)}",
        name=motor_name(mcu, motor),
        figure=f"{forth:+.2f} {'rad/s, probed' if channel.probed else f'{back:+.2f} rad/s'}",
        shown=", ".join(f"encoder {LETTERS[m]} {channel.forth[m]:+.2f}" for m in moved),
        here=LETTERS[motor],
        there=LETTERS[there],
        reversed=", and one motor or encoder is reversed" if channel.forth[there] < 0 else "",
        wheel=words(wheel_of(mcu, motor)[0]),
        error=channel.error,
        which="slower" if forth - back < 2 * SPEED else "faster",
        tolerance=TOLERANCE,
        speed=SPEED,
        margin_s=beyond_s,
    )


def _whose(mcu: McuConfig, channel: Channel) -> str:
    """Return the end of the outcome's name that says what the operator saw, for example ", motor".

    Returns "" if the outcome does not depend on that.
    """
    wheel, sign = wheel_of(mcu, channel.motor)
    seen = channel.wheel
    match channel.kind:
        case "dead" if seen is not None:
            return ", turns" if seen else ", still"
        case "reversed" if seen == wheel:
            return ", encoder" if channel.forward == (sign > 0) else ", motor"
        case "other" if seen == wheel:
            return ", encoder"
        case "other" if seen == wheel_of(mcu, channel.moved[0])[0]:
            return ", motor"
        case "dead" | "reversed" | "other":
            return ", not seen"
        case _:
            return ""


def wheel_map(mcu: McuConfig, found: Sequence[Channel]) -> Finding:
    """Return the finding that compares `[mcu.wheels]` with the wheels that the operator saw turn.

    If a channel must be repaired first, or if the operator saw no wheel turn, the finding keeps the
    configured entry of this channel.
    """
    if any(channel.wheel is None for channel in found):
        return outcomes.find("wheel map: not seen")
    entries: dict[str, str] = {}
    for channel in found:
        wheel, sign = wheel_of(mcu, channel.motor)
        if channel.kind in FOLLOWS and channel.wheel:
            wheel, sign = channel.wheel, 1 if channel.forward else -1
        if wheel in entries:
            return outcomes.find("wheel map: twice", wheel=words(wheel))
        entries[wheel] = f"{'+' if sign > 0 else '-'}{LETTERS[channel.motor]}"
    wrong = [wheel for wheel in WHEELS if entries[wheel] != getattr(mcu.wheels, wheel)]
    return outcomes.find(
        "wheel map: other" if wrong else "wheel map: right",
        {f"mcu.wheels.{wheel}": entries[wheel] for wheel in WHEELS},
        map=" ".join(entries[wheel] for wheel in WHEELS),
        wheels=", ".join(map(words, wrong)),
    )


NEAR = 0.8
"""If the error of a speed exceeds this fraction of `OFF`, the speed is measured again over a longer
time, because the first measurement is too inaccurate."""

LOOK_S = 0.75 * motion.MOTOR_S
"""Time over which the second measurement averages the speed, s."""

LOOKS = 8
"""Largest number of short measurements whose mean is the present speed in `run_up`."""

ANSWERS = {
    "fr": "front_right", "fl": "front_left", "rl": "rear_left", "rr": "rear_right", "none": "",
}  # fmt: skip


def one(motor: int, speed: float) -> Motors:
    """Return the command that turns only this motor, at `speed` rad/s."""
    return motion.each(lambda index: speed if index == motor else 0.0)


def turn(board: Board, motor: int, speed: float) -> tuple[Motors, float]:
    """Bring a motor to `speed`, rad/s, and measure the speeds of all encoders.

    Returns a pair: these speeds, rad/s, and the possible relative error of the motor's measured
    speed. The error comes from the encoder, which counts only whole steps.
    """
    means = run_up(board, one(motor, speed))
    unsure = _unsure(board, motor, 2 * _look_s(board))
    if NEAR * OFF + unsure < abs(means[motor] / speed - 1) <= TOLERANCE:
        # The motor is weak, or heavy and not yet at its speed. A longer measurement decides.
        board.drive(one(motor, speed), motion.MOTOR_S)
        means = motion.mean(motion.since(board.replies, board.now_s - LOOK_S))
        unsure = _unsure(board, motor, LOOK_S)
    return means, unsure


def _unsure(board: Board, motor: int, seconds: float) -> float:
    look = motion.since(board.replies, board.now_s - seconds / 2)  # the ramp is over by then
    return motion.grain_s(look, [motor]) / seconds


def _look_s(board: Board) -> float:
    return max(motion.GLANCE_S / 2, 2.5 * board.gap_s)


def run_up(board: Board, motors: Motors) -> Motors:
    """Ramp up to the speeds `motors`, rad/s, and return each encoder's mean speed, rad/s.

    The function waits until the speeds are steady. It stops waiting after some time, or earlier if
    no encoder moves.
    """
    steps = max(1, int(motion.GLANCE_S / board.period_s))
    for step in range(1, steps + 1):
        a, b, c, d = (round(speed * step / steps, 2) for speed in motors)
        board.drive((a, b, c, d), board.period_s)
    began_s, look_s = board.now_s, _look_s(board)
    told = [motor for motor in range(4) if motors[motor]]
    means, looks, steady = ZERO, 0, 0
    while steady < 2 and board.now_s - began_s < _patience_s(board, told):
        board.drive(motors, look_s)
        looks += 1
        # A coarse encoder needs more measurements than a fine one.
        last = min(LOOKS, max(1, looks - 1))
        means = motion.mean(motion.since(board.replies, board.now_s - last * look_s))
        near = [m for m in moving(means) if abs(abs(means[m]) / motion.SPEED - 1) < 0.4 * TOLERANCE]
        steady = steady + 1 if len(near) >= len(told) else 0
        if looks * look_s >= motion.CUT_S and not moving(means, motion.STANDING):
            break  # do not go on: without an encoder, the speed control may wind up
    return means


def _patience_s(board: Board, told: list[int]) -> float:
    """Return the longest wait for steady speeds, s.

    `told` are the motors that were commanded to turn. The wait is longer while one of them still
    speeds up.
    """
    shares = motion.trend(board.replies, board.now_s, board.gap_s)
    rises = any(shares[motor] > 1 / motion.FALLS for motor in told)
    return motion.PATIENCE_S if rises else motion.MOTOR_S


def channel(board: Board, motor: int) -> Channel:
    """Turn a motor forward and backward, and return how the encoders moved.

    If motor d seems dead, the test is repeated with the other line ending: a comma or none.
    """
    found = _both_ways(board, motor)
    if motor == 3 and found.kind == "dead" and not board.latched:
        found = _with_other_comma(board, found)
    return found


def _both_ways(board: Board, motor: int) -> Channel:
    """Turn a motor forward, then backward, stop it, and return how the encoders moved.

    First the motor is probed. If its own encoder does not follow, the motor is not turned further.
    """
    shown = probe(board, motor)
    if shown is not None:
        return Channel(motor, shown, ZERO, probed=True)
    (forth, unsure), back = turn(board, motor, motion.SPEED), ZERO
    if motor in moving(forth):
        board.rest()
        back, other = turn(board, motor, -motion.SPEED)
        unsure = max(unsure, other)
    if motor not in moving(back):
        board.let_go(motion.CUT_S)
    board.rest()
    return Channel(motor, forth, back, unsure=unsure)


def probe(board: Board, motor: int) -> Motors | None:
    """Turn a motor slowly and briefly, to find out whether its own encoder follows.

    If the encoder follows, the result is None, and the motor may still turn. Otherwise the function
    stops the motor and returns the speeds that the encoders showed, rad/s.

    The firmware may drive a motor without a working encoder to full speed, but the probe is too
    short for that. If the encoder does not follow, the probe is repeated, because a coarse encoder
    may need more movement. If several readings show a reversed encoder, the probe is not repeated.
    """
    began_s = board.now_s
    shown = _probe(board, motor, motion.SPEED / 2)
    own = [reply.motors[motor] for reply in motion.since(board.replies, began_s)]
    seen = [speed for speed in own if speed]
    if shown is None or (len(seen) >= 3 and max(seen) < 0):
        return shown  # the motor is reversed; a second probe would make it run away again
    if not moving(shown, motion.PROBE_MOVES):
        return _probe(board, motor, motion.SPEED)
    again = _probe(board, motor, motion.SPEED / 2)
    # If only the first probe showed a movement, a motor may have coasted during that probe.
    return again if again is None or any(again) else _probe(board, motor, motion.SPEED)


def _probe(board: Board, motor: int, speed: float) -> Motors | None:
    coasting = board.replies[-1].motors if board.replies else ZERO
    began_s = board.now_s

    def shown() -> Motors:
        """Return each encoder's mean speed in the probe, rad/s.

        The speed at which the motor coasted before the probe is subtracted.
        """
        seconds = board.now_s - began_s
        ran = motion.covered(board.replies, began_s)
        sure = [max(0.0, abs(ran[m]) - abs(coasting[m]) * seconds) for m in range(4)]
        return motion.each(lambda m: math.copysign(sure[m], ran[m]) / motion.GLANCE_S)

    own = 0.0
    while board.now_s < began_s + motion.GLANCE_S and own > -4 * motion.PROBE_MOVES:
        board.drive(one(motor, speed), board.period_s)
        own = shown()[motor]
    if own >= motion.PROBE_MOVES:
        return None
    # The firmware may drive a motor to full speed although it receives zeros, until its watchdog
    # cuts the motor. So a motor that was seen to turn must stand before the next zeros are sent.
    moved = moving(shown(), motion.PROBE_MOVES)
    board.let_go(motion.STOOD_S if moved else motion.CUT_S)
    board.rest()
    seen = shown()
    return None if seen[motor] >= motion.PROBE_MOVES else seen


def _with_other_comma(board: Board, dead: Channel) -> Channel:
    """Test motor d, which did not move, again with the other line ending: a comma or none.

    Returns the new result if the motor moves now, else the old result `dead`.
    """
    configured, board.comma = board.comma, not board.comma
    channel = _both_ways(board, dead.motor)
    if channel.probed or dead.motor not in moving(channel.forth):
        board.comma = configured
        return dead
    turn(board, dead.motor, motion.SPEED)
    board.latched = not board.settles(configured)
    board.rest()
    return channel


def seen(board: Board, operator: Operator, channel: Channel) -> Channel:
    """Ask the operator which wheel turned, and return the channel with the answer.

    The wheels stand during the question. If no person watches the robot, the function returns
    `channel` unchanged.
    """
    question = (
        f"which wheel did motor {LETTERS[channel.motor]} turn: front right (fr), front left (fl), "
        'rear left (rl) or rear right (rr)? Type "none" if no wheel turned, or "again" to see '
        "the motor turn once more"
    )
    while (which := operator.ask(question, (*ANSWERS, "again"))) == "again":
        _both_ways(board, channel.motor)
    if which is None:
        return channel
    if wheel := ANSWERS[which]:
        question = (
            "which way did the wheel turn first: forward (as when the robot drives ahead) or back?"
        )
        way = operator.ask(question, ("forward", "back"))
        return structs.replace(channel, wheel=wheel, forward=way != "back")
    return structs.replace(channel, wheel="")
