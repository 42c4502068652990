"""One motor at a time, forth and back, and the person at the robot asked what it was.

What it means is `wheels.py`'s.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import Literal

from msgspec import structs

from acsard.checkup import motion
from acsard.checkup.bench import SPEED, STANDING, ZERO, Bench
from acsard.checkup.findings import LETTERS, Finding, motor_name
from acsard.checkup.motion import Reply
from acsard.checkup.outside import Operator
from acsard.checkup.wheels import PROBE_MOVES, TOLERANCE, Channel, moving
from acsard.mcu.frames import Motors
from acsard.values import NS_PER_S

RAMP_S = 0.2
HOLD_S = 1.4
"""The longest a motor is held at speed for the encoder to show it."""

DEAD_S = 0.6
"""A motor that shows nothing by then is not held longer: its control loop may be winding up."""

LONGEST_HOLD_S = 4.5
"""A motor that still speeds up after `HOLD_S` is held up to this long."""

PROBE_S = 0.2
PROBE_SPEED = 0.5 * SPEED
"""The first a motor is told: so short that one without a working encoder, which the firmware may
drive up to full speed, does not get far."""

LET_GO_S = 0.7
"""Silence after a probe that its encoder did not follow: the firmware may regulate zeros into a
runaway, and its watchdog cuts the motor. Longer than any watchdog that is right."""

COAST_S = 2.5
"""The same for one that was seen to turn: it must stand before the next zeros are regulated."""

CHUNKS = 8
"""Over so many tenths of a second the speed of an encoder is taken that is not steady before."""

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
    while steady < 2 and (len(chunks) * chunk_s < HOLD_S or _speeds_up(bench, motors, chunks)):
        chunks.append(bench.drive(motors, chunk_s))
        # A coarse encoder needs more of them, a quick one is seen to be steady before.
        means = mean([reply for chunk in chunks[1:][-CHUNKS:] or chunks for reply in chunk])
        moves = moving(means)
        near = [m for m in moves if abs(abs(means[m]) / SPEED - 1) < 0.4 * TOLERANCE]
        asked = sum(1 for speed in motors if speed)
        steady = steady + 1 if len(near) >= asked else 0
        if len(chunks) * chunk_s >= DEAD_S and max(map(abs, means)) < STANDING:
            break
    return means


def _speeds_up(bench: Bench, motors: Motors, chunks: Sequence[object]) -> bool:
    """A motor is not at the speed it was told yet, and getting there."""
    if len(chunks) * max(0.1, 2.5 * bench.gap_s) >= LONGEST_HOLD_S:
        return False
    shares = motion.trend(bench.replies, bench.wire.now_ns(), bench.gap_s)
    return any(share > 1 / motion.FALLS for share, told in zip(shares, motors, strict=True) if told)


def mean(replies: Sequence[Reply]) -> Motors:
    """Each encoder's speed over these replies."""
    if not replies:
        return ZERO
    a, b, c, d = (fmean(reply.motors[motor] for reply in replies) for motor in range(4))
    return a, b, c, d


def channels(bench: Bench, operator: Operator) -> Iterator[tuple[Channel, Finding | None]]:
    """Each motor in turn; with the last one, what is to say of the trailing comma."""
    for motor in range(4):
        operator.say(f"{motor_name(bench.mcu, motor)} turns: a moment first, then forth and back")
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
    seen = probe(bench, motor)
    if seen is not None:
        return Channel(motor, seen, ZERO, probed=True), "rest"
    forth = turn(bench, motor, SPEED)
    if motor not in moving(forth):
        _let_go(bench)
        return Channel(motor, forth, ZERO), "rest"
    stopped = bench.rest()
    back = turn(bench, motor, -SPEED)
    if motor not in moving(back):
        _let_go(bench)
    stopped = "comma" if "comma" in (bench.rest(), stopped) else "rest"
    return Channel(motor, forth, back), stopped


def probe(bench: Bench, motor: int) -> Motors | None:
    """Turn a motor slowly and shortly; None when its own encoder follows, and it turns on.

    Else what the encoders showed of it, in rad/s. A second try is for coarse encoders: they may
    need more to show anything, and one count back is nothing yet. It stands by then.
    """
    began_ns = bench.wire.now_ns()
    shown = _probe(bench, motor, PROBE_SPEED)
    if shown is None:
        return None
    seen = [r.motors[motor] for r in bench.replies if r.at_ns > began_ns and r.motors[motor]]
    if len(seen) >= 3 and max(seen) < 0:
        return shown  # no need to drive a reversed one away twice
    if not any(abs(speed) >= PROBE_MOVES for speed in shown):
        return _probe(bench, motor, SPEED)
    again = _probe(bench, motor, PROBE_SPEED)
    return shown if again is not None and not any(again) else again


def _probe(bench: Bench, motor: int, speed: float) -> Motors | None:
    bench.begin()
    began_ns = bench.wire.now_ns()
    coasting = bench.replies[-1].motors if bench.replies else ZERO

    def shown() -> Motors:
        """The angles over the probe's time, without what a wheel may still have coasted."""
        seconds = (bench.wire.now_ns() - began_ns) / NS_PER_S
        angles = zip(motion.covered(bench.replies, began_ns), coasting, strict=True)
        a, b, c, d = (
            math.copysign(max(0.0, abs(angle) - abs(before) * seconds), angle) / PROBE_S
            for angle, before in angles
        )
        return a, b, c, d

    own = 0.0
    while bench.wire.now_ns() - began_ns < PROBE_S * NS_PER_S and own > -4 * PROBE_MOVES:
        bench.drive(one(motor, speed), bench.period_s)
        own = shown()[motor]
    if own >= PROBE_MOVES:
        return None
    moved = max(map(abs, shown())) >= PROBE_MOVES
    _let_go(bench, COAST_S if moved else LET_GO_S)
    seen = shown()
    return None if seen[motor] >= PROBE_MOVES else seen


def _let_go(bench: Bench, silent_s: float = LET_GO_S) -> None:
    """Zeros once, then silence until the watchdog has cut the motors; they stand afterwards."""
    bench.zeros()
    bench.listen(silent_s)
    bench.rest()


def _with_other_comma(bench: Bench, dead: Channel) -> tuple[Channel, Finding]:
    """The last motor does nothing: does it with the comma at the line's end turned round?"""
    bench.comma = not bench.comma
    shown = probe(bench, dead.motor)
    forth = ZERO if shown is not None else turn(bench, dead.motor, SPEED)
    if dead.motor not in moving(forth):
        bench.comma = not bench.comma
        _let_go(bench)
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
        return structs.replace(channel, wheel=4)
    way = operator.ask(
        "which way did it turn first: forward (as when the robot drives ahead) or back?",
        ("forward", "back"),
    )
    return structs.replace(channel, wheel=ANSWERS[which], forward=way != "back")
