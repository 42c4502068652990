"""What the motors did, judged: each channel's motor and encoder, and which wheel it is.

Plain functions of what was seen; `turning.py` does the turning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.checkup.bench import SPEED
from acsard.checkup.findings import LETTERS, Finding, motor_name, wheel_of, words
from acsard.config.settings import McuConfig
from acsard.mcu.frames import Motors
from acsard.values import WHEELS

MOVES = 0.25 * SPEED
"""rad/s; an encoder that shows this much moves."""

PROBE_MOVES = 0.075
"""rad/s over a short probe: a heavy wheel has hardly begun to turn by then."""

TOLERANCE = 0.25
"""By which share the encoder's speed may differ from the command."""

Kind = Literal["right", "reversed", "dead", "other", "several", "one way", "size"]


class Channel(Struct, frozen=True):
    """What motor `motor` did: each encoder's speed while told forth (p) and back (n)."""

    motor: int
    forth: Motors
    back: Motors
    wheel: int | None = None
    """Which wheel a person saw turn, in `WHEELS` order; 4 for none, None when nobody looked."""
    forward: bool = True
    """It turned forward first, as seen by a person."""
    probed: bool = False
    """Its own encoder did not follow a short probe: it was not turned further, and not back."""

    @property
    def moved(self) -> list[int]:
        """The encoders that moved."""
        if not self.probed:
            return moving(self.forth) or moving(self.back)
        least = max(PROBE_MOVES, max(map(abs, self.forth)) / 4)
        return [motor for motor in range(4) if abs(self.forth[motor]) >= least]

    @property
    def kind(self) -> Kind:
        """What the encoders say."""
        if self.probed:
            return self._kind_probed()
        forth, back = moving(self.forth), moving(self.back)
        if not forth and not back:
            return "dead"
        if not forth or not back:
            return "one way"
        if forth != back or len(forth) > 1:
            return "several"
        if forth != [self.motor]:
            return "other"
        if self.forth[self.motor] < 0 < self.back[self.motor]:
            return "reversed"
        sizes = (self.forth[self.motor] / SPEED, -self.back[self.motor] / SPEED)
        return "right" if all(abs(s - 1) <= TOLERANCE for s in sizes) else "size"

    def _kind_probed(self) -> Kind:
        moved = self.moved
        if len(moved) > 1:
            return "several"
        if not moved:
            return "dead"
        return "reversed" if moved == [self.motor] else "other"


def moving(speeds: Motors) -> list[int]:
    """The encoders that move."""
    return [motor for motor in range(4) if abs(speeds[motor]) >= MOVES]


def encoder_finding(mcu: McuConfig, channel: Channel) -> Finding:
    """What motor and encoder of one channel say of each other."""
    motor, kind = channel.motor, channel.kind
    forth, back = channel.forth[motor], channel.back[motor]
    text, mend = _explain(mcu, channel)
    figure = f"{forth:+.2f} rad/s, probed" if channel.probed else f"{forth:+.2f} {back:+.2f} rad/s"
    if kind in ("other", "several"):
        shown = [f"encoder {LETTERS[m]} {channel.forth[m]:+.2f}" for m in channel.moved]
        figure = ", ".join(shown)
    verdict: Literal["PASS", "FAIL"] = "PASS" if kind == "right" else "FAIL"
    return Finding(motor_name(mcu, motor), verdict, figure, text, mend)


def _explain(mcu: McuConfig, channel: Channel) -> tuple[str, str]:
    motor = channel.motor
    letter = LETTERS[motor]
    match channel.kind:
        case "right":
            return "", ""
        case "dead":
            return _explain_dead(letter, channel.wheel)
        case "reversed":
            return _explain_reversed(mcu, channel)
        case "other":
            return _explain_other(mcu, channel)
        case "several":
            text = f"more encoders than {letter}'s move, or not the same ones each way"
            return text, "are wheels coupled, or leads of two motors or encoders crossed?"
        case "one way":
            return (
                f"motor {letter} shows movement one way only",
                f"look at the direction output of {letter}'s driver, and at A and B of its encoder",
            )
        case _:
            return (
                f"encoder {letter} is more than {TOLERANCE:.0%} off the {SPEED:g} rad/s it was "
                "told: every distance would be off as much",
                "counts per turn and gear ratio in the firmware; does it control the speed at all?",
            )


def _explain_dead(letter: str, wheel: int | None) -> tuple[str, str]:
    if wheel is None:
        return (
            f"encoder {letter} shows nothing: a dead encoder, or a motor that does not turn",
            f"look whether the wheel turns: if it does, the encoder's supply and leads; if not, "
            f"the driver, fuse and leads of motor {letter}",
        )
    if wheel == 4:
        return (
            f"motor {letter} does not turn",
            f"driver, fuse, enable and leads of motor {letter}",
        )
    return (
        f"the wheel turns, and encoder {letter} shows nothing: a dead encoder",
        f"supply, plug and A and B of encoder {letter}",
    )


def _explain_reversed(mcu: McuConfig, channel: Channel) -> tuple[str, str]:
    letter = LETTERS[channel.motor]
    text = f"encoder {letter} counts against motor {letter}; no configuration mends that"
    wheel, sign = wheel_of(mcu, channel.motor)
    if channel.wheel is None or channel.wheel == 4 or WHEELS[channel.wheel] != wheel:
        mend = (
            f"swap the two leads of motor {letter} if the wheel turns the wrong way, else A and B"
        )
        return text, f"{mend} of encoder {letter}"
    if channel.forward == (sign > 0):
        return text, f"the motor is right: swap A and B of encoder {letter}"
    return text, f"the motor is reversed: swap the two leads of motor {letter}"


def _explain_other(mcu: McuConfig, channel: Channel) -> tuple[str, str]:
    motor, other = channel.motor, channel.moved[0]
    here, there = LETTERS[motor], LETTERS[other]
    text = f"motor {here} moves encoder {there}: two motors or two encoders are swapped"
    if channel.forth[other] < 0:
        text += ", and one of them is reversed"
    if channel.wheel is not None and channel.wheel < 4:
        seen = WHEELS[channel.wheel]
        if seen == wheel_of(mcu, motor)[0]:
            return text, f"the motor is right: swap the plugs of encoders {here} and {there}"
        if seen == wheel_of(mcu, other)[0]:
            return text, f"the encoder is right: swap the leads of motors {here} and {there}"
    return (
        text,
        f"look which wheel turns: if the {words(wheel_of(mcu, motor)[0])} one, swap encoders "
        f"{here} and {there}, else motors {here} and {there}",
    )


def wheel_map(mcu: McuConfig, found: Sequence[Channel]) -> Finding:
    """`[mcu.wheels]` as a person saw it; channels to be mended first keep their entry."""
    name = "wheel map"
    if any(channel.wheel is None for channel in found):
        text = "not seen by a person: which wheel each motor turns, and which way, is as configured"
        return Finding(name, "SKIPPED", "", text)
    entries: dict[str, str] = {}
    for channel in found:
        wheel, sign = wheel_of(mcu, channel.motor)
        if channel.kind in ("right", "size") and channel.wheel in range(4):
            wheel, sign = WHEELS[channel.wheel or 0], 1 if channel.forward else -1
        if wheel in entries:
            text = f"two motors turn the {words(wheel)} wheel by what was seen"
            return Finding(name, "FAIL", "", text, "mend the motors above, and check again")
        entries[wheel] = f"{'+' if sign > 0 else '-'}{LETTERS[channel.motor]}"
    keys: dict[str, object] = {f"mcu.wheels.{wheel}": entries[wheel] for wheel in WHEELS}
    figure = " ".join(entries[wheel] for wheel in WHEELS)
    wrong = [wheel for wheel in WHEELS if entries[wheel] != getattr(mcu.wheels, wheel)]
    if not wrong:
        return Finding(name, "PASS", figure, "", "", keys)
    text = f"not as configured: {', '.join(words(wheel) for wheel in wrong)}"
    return Finding(name, "FAIL", figure, text, "write the [mcu.wheels] lines below", keys)
