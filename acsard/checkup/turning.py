"""One motor at a time, forth and back, and the person at the robot asked what it was.

What it means is `wheels.py`'s.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import Literal

from acsard.checkup.bench import SPEED, ZERO, Bench, Reply
from acsard.checkup.findings import LETTERS, Finding, motor_name
from acsard.checkup.outside import Operator
from acsard.checkup.wheels import TOLERANCE, Channel, moving
from acsard.mcu.frames import Motors

RAMP_S = 0.2
HOLD_S = 1.4
"""The longest a motor is held at speed for the encoder to show it."""

DEAD_S = 0.6
"""A motor that shows nothing by then is not held longer: its control loop may be winding up."""

CHUNKS = 8
"""Over so many tenths of a second the speed of an encoder is taken that is not steady before."""

UNSEEN_S = 0.5

STALL_S = 0.15
"""A pause of ours this long makes what was measured worthless: it is measured again."""

ANSWERS = {"fr": 0, "fl": 1, "rl": 2, "rr": 3}


def one(motor: int, speed: float) -> Motors:
    """The command that turns one motor only."""
    a, b, c, d = (speed if index == motor else 0.0 for index in range(4))
    return a, b, c, d


def turn(bench: Bench, motor: int, speed: float) -> Motors:
    """Turn a motor for a moment and let it come to rest; each encoder's speed meanwhile."""
    means = run_up(bench, one(motor, speed))
    if bench.longest_pause_s >= STALL_S:
        bench.rest()
        means = run_up(bench, one(motor, speed))
    return means


def run_up(bench: Bench, motors: Motors) -> Motors:
    """Ramp up and hold until the encoders show a steady speed; what they show."""
    bench.begin()
    steps = max(1, int(RAMP_S / bench.period_s))
    for step in range(steps):
        share = (step + 1) / steps
        a, b, c, d = (round(speed * share, 2) for speed in motors)
        bench.drive((a, b, c, d), bench.period_s)
    chunk_s = max(0.1, 2.5 * bench.gap_s)
    steady, means = 0, ZERO
    chunks: list[Sequence[Reply]] = []
    while len(chunks) * chunk_s < HOLD_S and steady < 2:
        chunks.append(bench.drive(motors, chunk_s))
        # A coarse encoder needs more of them, a quick one is seen to be steady before.
        means = mean([reply for chunk in chunks[1:][-CHUNKS:] or chunks for reply in chunk])
        moves = moving(means)
        near = [m for m in moves if abs(abs(means[m]) / SPEED - 1) < 0.4 * TOLERANCE]
        asked = sum(1 for speed in motors if speed)
        steady = steady + 1 if len(near) >= asked else 0
        if len(chunks) * chunk_s >= DEAD_S and not moves:
            break
    return means


def mean(replies: Sequence[Reply]) -> Motors:
    """Each encoder's speed over these replies."""
    if not replies:
        return ZERO
    a, b, c, d = (fmean(reply.motors[motor] for reply in replies) for motor in range(4))
    return a, b, c, d


def channels(bench: Bench, operator: Operator) -> Iterator[tuple[Channel, Finding | None]]:
    """Each motor in turn; with the last one, what is to say of the trailing comma."""
    for motor in range(4):
        operator.say(f"{motor_name(bench.mcu, motor)} turns, forth and back")
        channel, stopped = _both_ways(bench, motor)
        comma = None
        if motor == 3:
            if channel.kind == "dead" and stopped == "rest":
                channel, comma = _with_other_comma(bench, channel)
            elif stopped == "comma":
                comma = comma_needed(bench)
            else:
                comma = _comma_right(bench)
        yield _seen(bench, operator, channel), comma


def _both_ways(bench: Bench, motor: int) -> tuple[Channel, Literal["rest", "comma"]]:
    forth = turn(bench, motor, SPEED)
    stopped = _rest(bench, motor, forth)
    back = turn(bench, motor, -SPEED)
    stopped = "comma" if "comma" in (_rest(bench, motor, back), stopped) else "rest"
    return Channel(motor, forth, back), stopped


def _rest(bench: Bench, motor: int, seen: Motors) -> Literal["rest", "comma"]:
    """Come to rest; a motor whose encoder shows nothing is given the time for it unseen."""
    stopped = bench.rest()
    if motor not in moving(seen):
        bench.drive(ZERO, UNSEEN_S)
    return stopped


def _with_other_comma(bench: Bench, dead: Channel) -> tuple[Channel, Finding]:
    """The last motor does nothing: does it with the comma at the line's end turned round?"""
    bench.comma = not bench.comma
    forth = turn(bench, dead.motor, SPEED)
    if not moving(forth):
        bench.rest()
        bench.comma = not bench.comma
        _rest(bench, dead.motor, forth)
        text = "motor d shows nothing either way: it cannot be told"
        return dead, Finding("trailing comma", "SKIPPED", "", text)
    if bench.comma:
        # Zeros without the comma: firmware that needs it keeps this motor turning.
        turned_on = bool(moving(mean(bench.drive(ZERO, 0.5, comma=False)[-3:])))
    else:
        turned_on = False
    bench.rest()
    back = turn(bench, dead.motor, -SPEED)
    bench.rest()
    return Channel(dead.motor, forth, back), comma_needed(bench, turned_on)


def comma_needed(bench: Bench, turned_on: bool = True) -> Finding:
    """The form of the last comma is wrong; `bench.comma` is already the right one."""
    last = motor_name(bench.mcu, 3)
    if not bench.comma:
        text = f"{last} obeys only lines without a comma at their end"
    elif turned_on:
        text = (
            f"{last} still turns after zeros: the firmware takes a value only when a comma "
            "follows it, so without the last one this wheel keeps its old speed"
        )
    else:
        text = f"{last} obeys only lines with a comma at their end"
    word = "true" if bench.comma else "false"
    return Finding(
        "trailing comma",
        "FAIL",
        "needed" if bench.comma else "refused",
        text,
        f"write mcu.trailing_comma = {word}; the check goes on with it",
        {"mcu.trailing_comma": bench.comma},
    )


def _comma_right(bench: Bench) -> Finding:
    figure = "sent, as configured" if bench.comma else "not needed"
    return Finding("trailing comma", "PASS", figure, keys={"mcu.trailing_comma": bench.comma})


def _seen(bench: Bench, operator: Operator, channel: Channel) -> Channel:
    """Ask the person which wheel it was; the wheels stand by now."""
    answers = (*ANSWERS, "none", "again")
    while True:
        which = operator.ask(
            f"which wheel did motor {LETTERS[channel.motor]} turn? front right, front left, "
            "rear left, rear right, none; or show it again",
            answers,
        )
        if which != "again":
            break
        _both_ways(bench, channel.motor)
    if which is None:
        return channel
    if which == "none":
        return Channel(channel.motor, channel.forth, channel.back, 4)
    way = operator.ask(
        "which way did it turn first: forward (as when the robot drives ahead) or back?",
        ("forward", "back"),
    )
    return Channel(channel.motor, channel.forth, channel.back, ANSWERS[which], way != "back")
