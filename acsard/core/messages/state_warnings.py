"""Lists the warnings about a robot, such as a low battery, which it may have even if `ready`.

All tools show them in these words; programs read the fields of `state`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, get_args

from msgspec import Struct

from acsard.core.codes import CODES
from acsard.core.formatting import printable
from acsard.core.messages.certificate_expiry import CERTIFICATE_LEVELS
from acsard.core.messages.schema import BatterySummary, RobotState

What = Literal[
    "emergency_stop", "bumper", "battery", "certificate", "recording", "latch_file", "wheel",
    "pose",
]  # fmt: skip

WARNING_KINDS: tuple[What, ...] = get_args(What)  # most urgent first

WARNING = "WARNING"  # begins a list of warnings

ESTOP = {"pressed": "emergency stop pressed", "silent": "emergency stop not reported"}

# Words by level.
BATTERY = {
    "warning": "battery low",
    "stop": "battery empty",
    "unknown": "battery level unknown",
}


# Warnings that only repeat the reason, by its code.
SAME_AS_REASON: dict[str, What] = {
    "emergency_stop": "emergency_stop",
    "emergency_stop_silent": "emergency_stop",
    "bumper": "bumper",
    "bumpers_silent": "bumper",
    "bumper_away": "bumper",
    "bumper_blocks": "bumper",
}


class StateWarning(Struct, frozen=True):
    """A warning about a part of the robot, `what`."""

    what: What
    brief: str  # for a column of a table
    text: str = ""  # details

    def __str__(self) -> str:
        return printable(f"{self.brief}: {self.text}" if self.text else self.brief)


def warnings(state: RobotState) -> list[StateWarning]:
    """Return the warnings about the robot with this `state`, the most urgent first."""
    return list(_warnings(state))


def brief(state_warnings: Sequence[StateWarning]) -> str:
    """Return the warnings as one text, such as "WARNING: recording fails", or ""."""
    words = ", ".join(printable(warning.brief) for warning in state_warnings)
    return f"{WARNING}: {words}" if words else ""


def charge(battery: BatterySummary | None) -> str:
    """Return the charge of a battery as text, otherwise the voltage, otherwise ""."""
    if battery is None:
        return ""
    if battery.percent is not None:
        return f"{battery.percent:.0f} %"
    return "" if battery.volts is None else f"{battery.volts:.1f} V"


def _warnings(state: RobotState) -> Iterator[StateWarning]:
    if state.emergency_stop in ESTOP:
        yield StateWarning("emergency_stop", ESTOP[state.emergency_stop])
    if pressed := [str(n) for n, bumper in enumerate(state.bumpers or (), 1) if bumper]:
        noun = "bumpers" if len(pressed) > 1 else "bumper"
        yield StateWarning("bumper", f"{noun} {' and '.join(pressed)} pressed")
    if state.battery is not None and state.battery.level in BATTERY:
        battery = charge(state.battery)
        words = BATTERY[state.battery.level]
        yield StateWarning("battery", f"{words} ({battery})" if battery else words)
    if CERTIFICATE_LEVELS.get(state.certificate):
        yield StateWarning("certificate", f"certificate {state.certificate_expiry}")
    if state.recording_error:
        yield StateWarning("recording", "recording fails", state.recording_error)
    if state.latch_file_error:
        yield StateWarning("latch_file", "latch file fails", state.latch_file_error)
    if state.wheel_fault:
        yield StateWarning("wheel", "wheel fault", state.wheel_fault)
    if warning := CODES.get(state.pose_doubt):
        brief = "not calibrated" if state.pose_doubt == "not_calibrated" else "pose doubtful"
        yield StateWarning("pose", brief, f"{warning.text} {warning.advice}")
