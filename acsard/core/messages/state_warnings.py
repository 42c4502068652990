"""Lists the warnings about a robot, such as a low battery, which it may have even if `ready`.

All tools show them in these words; programs read the fields of `state`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, cast, get_args

from msgspec import Struct

from acsard.core.codes import CODES, Code, joined, level_of, reason
from acsard.core.formatting import printable
from acsard.core.messages.schema import BatterySummary, RobotState
from acsard.core.tables.pose_codes import PoseCode

What = Literal[
    "emergency_stop", "bumper", "battery", "certificate", "recording", "latch_file", "wheel",
    "pose",
]  # fmt: skip

WARNING_KINDS: tuple[What, ...] = get_args(What)  # most urgent first

WARNING = "WARNING"  # begins a list of warnings

# Codes of the levels of the battery that warn.
BATTERY: dict[str, Code] = {
    "warning": "battery_low",
    "stop": "battery_empty",
    "unknown": "battery_unknown",
}

ESTOP: dict[str, Code] = {"pressed": "emergency_stop", "silent": "emergency_stop_silent"}


class StateWarning(Struct, frozen=True):
    """A warning about a part of the robot, `what`."""

    what: What
    code: str
    brief: str  # for a column of a table
    text: str = ""  # details

    def __str__(self) -> str:
        return printable(f"{self.brief}: {self.text}" if self.text else self.brief)


def warnings(state: RobotState) -> list[StateWarning]:
    """Return the warnings about the robot with this `state`, the most urgent first."""
    return list(_warnings(state))


def beside_reason(state: RobotState) -> list[StateWarning]:
    """Return the warnings that do not only repeat the reason, by its code."""
    return [why for why in _warnings(state) if not state.code.startswith(why.code)]


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
    if code := ESTOP.get(state.emergency_stop):
        yield _warning("emergency_stop", code)
    if pressed := [str(n) for n, bumper in enumerate(state.bumpers or (), 1) if bumper]:
        noun = "bumpers" if len(pressed) > 1 else "bumper"
        yield StateWarning("bumper", "bumper", f"{noun} {' and '.join(pressed)} pressed")
    if state.battery is not None and (code := BATTERY.get(state.battery.level)):
        battery = charge(state.battery)
        words = CODES[code].figure
        yield StateWarning("battery", code, f"{words} ({battery})" if battery else words)
    if state.certificate and level_of(why := f"certificate_{state.certificate}") != "ok":
        yield StateWarning("certificate", why, f"certificate {state.certificate_expiry}")
    if state.recording_error:
        yield _warning("recording", "recording_fails", state.recording_error)
    if state.latch_file_error:
        yield _warning("latch_file", "latch_file_fails", state.latch_file_error)
    if state.wheel_fault:
        yield _warning("wheel", "wheel_fault", state.wheel_fault)
    if state.pose_doubt in CODES:
        doubt = reason(cast("PoseCode", state.pose_doubt))
        yield _warning("pose", doubt.code, joined(doubt).text)
    elif state.pose_doubt:  # of a later version
        yield StateWarning("pose", state.pose_doubt, "pose doubtful", state.pose_doubt)


def _warning(what: What, code: Code, text: str = "") -> StateWarning:
    return StateWarning(what, code, CODES[code].figure, text)
