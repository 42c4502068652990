"""Results of `acsard mcu check`: one `Finding` per subject, and errors that end the check early."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import McuConfig
from acsard.core.link.codec import LETTERS
from acsard.core.values import WHEELS, AcsardError

Verdict = Literal["PASS", "WARN", "FAIL", "SKIPPED"]

REST = "the rest"
"""Name of the finding that lists the steps that were not run because the check ended early."""


class Finding(Struct, frozen=True):
    """The result for one subject of the check. Its texts come from `outcomes.py`.

    `figure` is the measurement, and `text` is its meaning. `mend` is the remedy, or "" if there is
    none. `keys` maps dotted keys of the configuration to suggested values. A suggested value may be
    configured already.
    """

    name: str
    verdict: Verdict
    figure: str = ""
    text: str = ""
    mend: str = ""
    keys: dict[str, object] = {}


class StoppedError(AcsardError):
    """Ends the check early. `finding` tells the operator the reason."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class WireLostError(AcsardError):
    """The serial port was lost: the device was unplugged, or its driver hangs."""


def wheel_of(mcu: McuConfig, motor: int) -> tuple[str, int]:
    """Return the wheel that a motor (0 to 3) turns according to the configuration, and a sign.

    The sign is -1 if a positive speed of the motor turns the wheel backward, else 1.
    """
    for wheel in WHEELS:
        entry = getattr(mcu.wheels, wheel)
        if entry[1] == LETTERS[motor]:
            return wheel, -1 if entry[0] == "-" else 1
    raise ValueError(f"the configuration has no wheel with motor {LETTERS[motor]}")


def words(wheel: str) -> str:
    """Return a wheel's name with spaces: "front right" for "front_right"."""
    return wheel.replace("_", " ")


def motor_name(mcu: McuConfig, motor: int) -> str:
    """Return a text such as "motor d (rear right)" for motor 3 and its configured wheel."""
    return f"motor {LETTERS[motor]} ({words(wheel_of(mcu, motor)[0])})"


def motor_names(mcu: McuConfig, motors: Sequence[int], joint: str = " and ") -> str:
    return joint.join(motor_name(mcu, motor) for motor in motors)
