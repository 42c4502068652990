"""What the motors did, judged: each channel's motor and encoder, and which wheel it is.

Plain functions of what was seen; `turning.py` does the turning.
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
"""By which share the encoder's speed may differ from the command, and pass for this motor's."""

OFF = 0.05
"""By which share it may differ on a sound robot."""

Kind = Literal["right", "reversed", "dead", "other", "several", "one way", "size", "off", "late"]


class Channel(Struct, frozen=True):
    """What motor `motor` did: each encoder's speed while told forth (p) and back (n)."""

    motor: int
    forth: Motors
    back: Motors
    wheel: str | None = None
    """Which wheel a person saw turn, "" for none; None: nobody looked."""
    forward: bool = True
    """It turned forward first, as seen by a person."""
    probed: bool = False
    """Its own encoder did not follow a short probe: it was not turned further, and not back."""
    unsure: float = 0.0
    """By which share the speeds may err: counts of a coarse encoder."""
    judged: bool = True
    """This computer was in time; else nothing here is the motor's doing for certain."""

    @property
    def moved(self) -> list[int]:
        """The encoders that moved."""
        if not self.probed:
            return moving(self.forth) or moving(self.back)
        return moving(self.forth, max(PROBE_MOVES, max(map(abs, self.forth)) / 4))

    @property
    def kind(self) -> Kind:
        """What the encoders say."""
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
        """By which share of its command the own encoder's speed is off, the worse of both ways."""
        own = self.motor
        return max(abs(self.forth[own] / SPEED - 1), abs(self.back[own] / SPEED + 1))


def encoder_finding(mcu: McuConfig, channel: Channel) -> Finding:
    """What motor and encoder of one channel say of each other."""
    motor, moved = channel.motor, channel.moved
    forth, back = channel.forth[motor], channel.back[motor]
    there = moved[0] if moved else motor
    # As if it had stood while this computer was late, in half of the looks.
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
    """Whose fault it is, as the one who saw the wheel can tell."""
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
    """`[mcu.wheels]` as a person saw it; channels to be mended first keep their entry."""
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
