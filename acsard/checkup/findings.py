"""Results of the check: one `Finding` per subject, and the errors that end a check early."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import McuConfig
from acsard.core.link.codec import LETTERS
from acsard.core.values import WHEELS, AcsardError

Verdict = Literal["PASS", "WARN", "FAIL", "SKIPPED"]

REST = "the rest"
"""Name of the row that lists the steps that were not run because the check ended early."""


class Finding(Struct, frozen=True):
    """The result for one subject. Its texts come from `outcomes.py`.

    `figure` is the measurement, `text` its meaning, `mend` the remedy unless the subject passed,
    and `keys` the configuration values by dotted key, whether they are configured already or not.
    """

    name: str
    verdict: Verdict
    figure: str = ""
    text: str = ""
    mend: str = ""
    keys: dict[str, object] = {}


class StoppedError(AcsardError):
    """Early end of the check. `finding` is the reason."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class WireLostError(AcsardError):
    """Loss of the serial line: it was unplugged, or its driver hangs."""


def wheel_of(mcu: McuConfig, motor: int) -> tuple[str, int]:
    """Return the configured wheel of a motor, and 1 or -1 for its forward direction."""
    for wheel in WHEELS:
        entry = getattr(mcu.wheels, wheel)
        if entry[1] == LETTERS[motor]:
            return wheel, -1 if entry[0] == "-" else 1
    raise ValueError(f"no wheel has motor {LETTERS[motor]}")


def words(wheel: str) -> str:
    """Return a wheel's name with spaces: "front right" for "front_right"."""
    return wheel.replace("_", " ")


def motor_name(mcu: McuConfig, motor: int) -> str:
    """Return the letter of a motor and its configured wheel: `motor d (rear right)`."""
    return f"motor {LETTERS[motor]} ({words(wheel_of(mcu, motor)[0])})"


def motor_names(mcu: McuConfig, motors: Sequence[int], joint: str = " and ") -> str:
    return joint.join(motor_name(mcu, motor) for motor in motors)
