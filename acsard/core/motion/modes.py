"""Derives the robot's mode from the latches, the link and the commands, by one ordered list.

    shutdown  the daemon is shutting down
    fault     a fault is latched until `clear`
    stopped   a stop is latched until `clear`
    inactive  the robot is switched off until `activate`
    waiting   the robot is active, but it has no link to the board, or the board does not report a
              required input
    driving   the robot follows a fresh command
    ready     the robot could drive, but there is no command to follow

The first mode of this list whose condition holds is the robot's mode. The mode depends only on
these conditions and not on the previous mode, so no transition can be forgotten.
"""

from __future__ import annotations

from enum import StrEnum

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
    """Error for a request that the robot does not allow now. Its text tells the client why."""


def mode_of(
    *,
    shutting_down: bool,
    fault: bool,
    stopped: bool,
    inactive: bool,
    linked: bool,
    commanded: bool,
) -> Mode:
    """Return the first mode of the ordered list in `modes.py` whose condition holds.

    `linked` is true if the board is ready to drive the robot, and `commanded` is true if the robot
    has a fresh command to follow. The other arguments say whether the daemon is shutting down, or
    whether the robot is in fault, stopped or inactive.
    """
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


SHUTDOWN_REASON = "the daemon is shutting down"

REFUSALS: dict[tuple[Mode, Verb], str] = {
    (Mode.SHUTDOWN, "clear"): SHUTDOWN_REASON,
    (Mode.SHUTDOWN, "activate"): SHUTDOWN_REASON,
    (Mode.SHUTDOWN, "deactivate"): SHUTDOWN_REASON,
    (Mode.FAULT, "activate"): "the robot is in fault: call srv/clear first",
    (Mode.FAULT, "deactivate"): "the robot is in fault and cannot move: call srv/clear first",
    (Mode.STOPPED, "activate"): "the robot is stopped: call srv/clear first",
    (Mode.STOPPED, "deactivate"): "the robot is stopped and cannot move: call srv/clear first",
}
"""Reason for the client, for each request (verb) that a mode refuses."""


def require_allowed(mode: Mode, verb: Verb) -> None:
    """Raise `RefusedError` if the robot refuses the request `verb` in this mode."""
    why = REFUSALS.get((mode, verb))
    if why is not None:
        raise RefusedError(why)
