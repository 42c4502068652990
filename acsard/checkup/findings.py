"""What the check finds: one `Finding` per thing looked at, and the end of a check cut short."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.config.settings import McuConfig
from acsard.mcu.codec import LETTERS
from acsard.values import WHEELS, AcsardError

Verdict = Literal["PASS", "WARN", "FAIL", "SKIPPED"]

REST = "the rest"
"""The row of a check that ended early: what it did not come to."""


class Finding(Struct, frozen=True):
    """One thing that was looked at; the words are those of `manual.py`.

    `figure` is what was measured, `text` what it means, `mend` what to do unless it passed, and
    `keys` what it says of the configuration: dotted key -> value, whether configured so or not.
    """

    name: str
    verdict: Verdict
    figure: str = ""
    text: str = ""
    mend: str = ""
    keys: dict[str, object] = {}


class StoppedError(AcsardError):
    """The check must end here; `finding` is why."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class WireLostError(AcsardError):
    """The line is gone: unplugged, or its driver has hung."""


def wheel_of(mcu: McuConfig, motor: int) -> tuple[str, int]:
    """The wheel a motor turns by the configuration, and 1 or -1 for which way is forward."""
    for wheel in WHEELS:
        entry = getattr(mcu.wheels, wheel)
        if entry[1] == LETTERS[motor]:
            return wheel, -1 if entry[0] == "-" else 1
    raise ValueError(f"no wheel has motor {LETTERS[motor]}")


def words(wheel: str) -> str:
    """A wheel's name for people."""
    return wheel.replace("_", " ")


def motor_name(mcu: McuConfig, motor: int) -> str:
    """`motor d (rear right)`: the letter, and the wheel the configuration gives it."""
    return f"motor {LETTERS[motor]} ({words(wheel_of(mcu, motor)[0])})"


def motor_names(mcu: McuConfig, motors: Sequence[int], joint: str = " and ") -> str:
    """Several of them."""
    return joint.join(motor_name(mcu, motor) for motor in motors)
