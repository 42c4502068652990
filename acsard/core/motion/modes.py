"""Derives the robot's mode from the latches, the link and the commands, by one ordered list.

The first mode holds whose condition is true: shutdown; fault, stopped (each latched until `clear`);
inactive (until `activate`); waiting (no link, or a required input is not reported); driving (a
fresh command); ready. As it does not depend on the previous mode, no transition can be forgotten.
"""

from __future__ import annotations

from enum import StrEnum

from acsard.core.codes import reason
from acsard.core.values import AcsardError, Verb


class Mode(StrEnum):
    # Enum's own hash is ten times slower, and every step looks up the mode in a dictionary.
    __hash__ = str.__hash__

    SHUTDOWN = "shutdown"
    FAULT = "fault"
    STOPPED = "stopped"
    INACTIVE = "inactive"
    WAITING = "waiting"
    DRIVING = "driving"
    READY = "ready"


class RefusedError(AcsardError):
    """The robot does not allow a request now; the text tells the client why."""


def mode_of(
    *,
    shutting_down: bool,
    fault: bool,
    stopped: bool,
    inactive: bool,
    linked: bool,
    commanded: bool,
) -> Mode:
    """Return the first mode of the list whose condition holds; `linked` includes the inputs."""
    if shutting_down:
        return Mode.SHUTDOWN
    if fault:
        return Mode.FAULT
    if stopped:
        return Mode.STOPPED
    if inactive:
        return Mode.INACTIVE
    if not linked:
        return Mode.WAITING
    return Mode.DRIVING if commanded else Mode.READY


SHUTDOWN_REASON = reason("shutting_down")

# Reasons for the client, by the mode and the refused request.
REFUSALS: dict[tuple[Mode, Verb], str] = {
    (Mode.SHUTDOWN, "clear"): SHUTDOWN_REASON.text,
    (Mode.SHUTDOWN, "activate"): SHUTDOWN_REASON.text,
    (Mode.SHUTDOWN, "deactivate"): SHUTDOWN_REASON.text,
    (Mode.FAULT, "activate"): "the robot is in fault: `acsard call clear` first",
    (Mode.FAULT, "deactivate"): "the robot is in fault and cannot move: `acsard call clear` first",
    (Mode.STOPPED, "activate"): "the robot is stopped: `acsard call clear` first",
    (Mode.STOPPED, "deactivate"): "the robot is stopped and cannot move: `acsard call clear` first",
}


def require_allowed(mode: Mode, verb: Verb) -> None:
    """Raise `RefusedError` if this mode refuses the request."""
    why = REFUSALS.get((mode, verb))
    if why is not None:
        raise RefusedError(why)
