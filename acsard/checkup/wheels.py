"""Judges the motors' behaviour: motor and encoder of each channel, and its wheel.

These are plain functions of the measurements; `turning.py` turns the motors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.checkup import manual
from acsard.checkup.findings import Finding, motor_name, wheel_of, words
from acsard.checkup.limits import GLANCE_S, PROBE_MOVES, SPEED
from acsard.checkup.motion import moving
from acsard.config.settings import McuConfig
from acsard.mcu.codec import LETTERS, Motors
from acsard.values import WHEELS

TOLERANCE = 0.25
"""Largest relative error of an encoder's speed that still belongs to the motor."""

OFF = 0.05
"""Largest relative error of the speed on a sound robot."""

Kind = Literal["right", "reversed", "dead", "other", "several", "one way", "size", "off", "late"]


class Channel(Struct, frozen=True):
    """Behaviour of one motor: each encoder's speed while told forth (p) and back (n), rad/s."""

    motor: int
    forth: Motors
    back: Motors
    wheel: str | None = None
    """Wheel that the operator saw turn, "" for none, or None if no person watched."""
    forward: bool = True
    """Whether the operator saw the wheel turn forward first."""
    probed: bool = False
    """Whether its own encoder did not follow a short probe.

    The motor was then not turned further.
    """
    unsure: float = 0.0
    """Fraction by which the speeds may err because of a coarse encoder."""
    judged: bool = True
    """Whether this computer was in time.

    If not, nothing here is certain to be the motor's behaviour.
    """

    @property
    def moved(self) -> list[int]:
        """Encoders that moved."""
        if not self.probed:
            return moving(self.forth) or moving(self.back)
        return moving(self.forth, max(PROBE_MOVES, max(map(abs, self.forth)) / 4))

    @property
    def kind(self) -> Kind:
        """Judgement that the encoders allow."""
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
        """Fraction by which its own encoder's speed is off the command, in the worse direction."""
        own = self.motor
        return max(abs(self.forth[own] / SPEED - 1), abs(self.back[own] / SPEED + 1))


def encoder_finding(mcu: McuConfig, channel: Channel) -> Finding:
    """Judge motor and encoder of one channel."""
    motor, moved = channel.motor, channel.moved
    forth, back = channel.forth[motor], channel.back[motor]
    there = moved[0] if moved else motor
    # Lateness that would explain the error: the motor would have seemed to stand meanwhile, in half
    # of the measurements.
    beyond_s = 2 * GLANCE_S * (channel.error - TOLERANCE) if channel.kind == "size" else 0.0
    return manual.find(
        f"motor: {channel.kind}{_whose(mcu, channel)}",
        name=motor_name(mcu, motor),
        figure=f"{forth:+.2f} {'rad/s, probed' if channel.probed else f'{back:+.2f} rad/s'}",
        shown=", ".join(f"encoder {LETTERS[m]} {channel.forth[m]:+.2f}" for m in moved),
        here=LETTERS[motor],
        there=LETTERS[there],
        reversed=", and one of them is reversed" if channel.forth[there] < 0 else "",
        wheel=words(wheel_of(mcu, motor)[0]),
        error=channel.error,
        which="slower" if forth - back < 2 * SPEED else "faster",
        tolerance=TOLERANCE,
        speed=SPEED,
        margin_s=beyond_s,
    )


def _whose(mcu: McuConfig, channel: Channel) -> str:
    """Return the part that is at fault, as far as the operator's observation shows it."""
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
    """Judge `[mcu.wheels]` by the operator's observations.

    Channels that have to be repaired first keep their configured entry.
    """
    if any(channel.wheel is None for channel in found):
        return manual.find("wheel map: not seen")
    entries: dict[str, str] = {}
    for channel in found:
        wheel, sign = wheel_of(mcu, channel.motor)
        if channel.kind in ("right", "off", "size") and channel.wheel:
            wheel, sign = channel.wheel, 1 if channel.forward else -1
        if wheel in entries:
            return manual.find("wheel map: twice", wheel=words(wheel))
        entries[wheel] = f"{'+' if sign > 0 else '-'}{LETTERS[channel.motor]}"
    wrong = [wheel for wheel in WHEELS if entries[wheel] != getattr(mcu.wheels, wheel)]
    return manual.find(
        "wheel map: other" if wrong else "wheel map: right",
        {f"mcu.wheels.{wheel}": entries[wheel] for wheel in WHEELS},
        map=" ".join(entries[wheel] for wheel in WHEELS),
        wheels=", ".join(map(words, wrong)),
    )
