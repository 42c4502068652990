"""Results of the steps of `acsard mcu check`, and errors that end the check early."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import McuConfig
from acsard.core.values import AcsardError

Verdict = Literal["PASS", "WARN", "FAIL", "SKIPPED"]

# Name of the finding that lists the steps without a result after an early end of the check.
SKIPPED_STEPS = "the rest"


class Finding(Struct, frozen=True):
    """The result of one step of the check, for example of the test of one motor.

    `figure` is the measurement, `text` explains it, and `mend` is the remedy. `keys` are suggested
    values by dotted key, equal to the configured ones or not. `code` says for programs which of the
    outcomes of its step it is.
    """

    name: str
    verdict: Verdict
    figure: str = ""
    text: str = ""
    mend: str = ""
    keys: dict[str, object] = {}
    code: str = ""


class StoppedError(AcsardError):
    """The check must end early. The finding `finding` gives the reason."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class WireLostError(AcsardError):
    """The serial port no longer works: the device was unplugged, or its driver hangs."""


def wheel_of(mcu: McuConfig, motor: int) -> tuple[str, int]:
    """Return the configured wheel of a motor, and -1 if positive speeds turn it backward."""
    wheels = mcu.wheels
    sign_of = {entry[1]: -1 if entry[0] == "-" else 1 for entry in wheels.motors}
    letter = wheels.letters[motor]
    return wheels.names[[*sign_of].index(letter)], sign_of[letter]


def with_spaces(wheel: str) -> str:
    """Return a wheel's name with spaces: "front right" for "front_right"."""
    return wheel.replace("_", " ")


def motor_name(mcu: McuConfig, motor: int) -> str:
    """Return a text such as "motor d (rear right)" for a motor and its configured wheel."""
    return f"motor {mcu.wheels.letters[motor]} ({with_spaces(wheel_of(mcu, motor)[0])})"


def motor_names(mcu: McuConfig, motors: Sequence[int], joint: str = " and ") -> str:
    return joint.join(motor_name(mcu, motor) for motor in motors)
