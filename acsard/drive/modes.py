"""The mode table: which trigger leads where. An absent entry is the error.

    inactive  switched off: no command counts           waiting  active, but no link to the MCU
    ready     active and linked, nobody commands        driving  a fresh command is followed
    stopped   latched by a stop, until clear            fault    latched by a fault, until clear
    leaving   the daemon is going down, for good

Facts (link, command, fault, leave) have an entry in every mode. Requests of people do not: a
missing one is refused in words and changes nothing.
"""

from __future__ import annotations

from enum import StrEnum

from acsard.values import AcsardError


class Mode(StrEnum):
    __hash__ = str.__hash__  # an Enum's own is ten times slower, and looked up in every step

    INACTIVE = "inactive"
    WAITING = "waiting"
    READY = "ready"
    DRIVING = "driving"
    STOPPED = "stopped"
    FAULT = "fault"
    LEAVING = "leaving"


class Trigger(StrEnum):
    __hash__ = str.__hash__

    LINK_UP = "link_up"
    LINK_LOST = "link_lost"
    COMMAND = "command"
    NO_COMMAND = "no_command"
    FAULT = "fault"
    LEAVE = "leave"
    STOP = "stop"
    CLEAR = "clear"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"


_M, _T = Mode, Trigger

TABLE: dict[tuple[Mode, Trigger], Mode] = {
    # switched off
    (_M.INACTIVE, _T.LINK_UP): _M.INACTIVE,
    (_M.INACTIVE, _T.LINK_LOST): _M.INACTIVE,
    (_M.INACTIVE, _T.COMMAND): _M.INACTIVE,
    (_M.INACTIVE, _T.NO_COMMAND): _M.INACTIVE,
    (_M.INACTIVE, _T.FAULT): _M.FAULT,
    (_M.INACTIVE, _T.LEAVE): _M.LEAVING,
    (_M.INACTIVE, _T.STOP): _M.STOPPED,
    (_M.INACTIVE, _T.CLEAR): _M.INACTIVE,
    (_M.INACTIVE, _T.ACTIVATE): _M.WAITING,
    (_M.INACTIVE, _T.DEACTIVATE): _M.INACTIVE,
    # active without a link
    (_M.WAITING, _T.LINK_UP): _M.READY,
    (_M.WAITING, _T.LINK_LOST): _M.WAITING,
    (_M.WAITING, _T.COMMAND): _M.WAITING,
    (_M.WAITING, _T.NO_COMMAND): _M.WAITING,
    (_M.WAITING, _T.FAULT): _M.FAULT,
    (_M.WAITING, _T.LEAVE): _M.LEAVING,
    (_M.WAITING, _T.STOP): _M.STOPPED,
    (_M.WAITING, _T.CLEAR): _M.WAITING,
    (_M.WAITING, _T.ACTIVATE): _M.WAITING,
    (_M.WAITING, _T.DEACTIVATE): _M.INACTIVE,
    # active and linked
    (_M.READY, _T.LINK_UP): _M.READY,
    (_M.READY, _T.LINK_LOST): _M.WAITING,
    (_M.READY, _T.COMMAND): _M.DRIVING,
    (_M.READY, _T.NO_COMMAND): _M.READY,
    (_M.READY, _T.FAULT): _M.FAULT,
    (_M.READY, _T.LEAVE): _M.LEAVING,
    (_M.READY, _T.STOP): _M.STOPPED,
    (_M.READY, _T.CLEAR): _M.READY,
    (_M.READY, _T.ACTIVATE): _M.READY,
    (_M.READY, _T.DEACTIVATE): _M.INACTIVE,
    # following a command
    (_M.DRIVING, _T.LINK_UP): _M.DRIVING,
    (_M.DRIVING, _T.LINK_LOST): _M.WAITING,
    (_M.DRIVING, _T.COMMAND): _M.DRIVING,
    (_M.DRIVING, _T.NO_COMMAND): _M.READY,
    (_M.DRIVING, _T.FAULT): _M.FAULT,
    (_M.DRIVING, _T.LEAVE): _M.LEAVING,
    (_M.DRIVING, _T.STOP): _M.STOPPED,
    (_M.DRIVING, _T.CLEAR): _M.DRIVING,
    (_M.DRIVING, _T.ACTIVATE): _M.DRIVING,
    (_M.DRIVING, _T.DEACTIVATE): _M.INACTIVE,
    # latched stop: only clear leaves it
    (_M.STOPPED, _T.LINK_UP): _M.STOPPED,
    (_M.STOPPED, _T.LINK_LOST): _M.STOPPED,
    (_M.STOPPED, _T.COMMAND): _M.STOPPED,
    (_M.STOPPED, _T.NO_COMMAND): _M.STOPPED,
    (_M.STOPPED, _T.FAULT): _M.FAULT,
    (_M.STOPPED, _T.LEAVE): _M.LEAVING,
    (_M.STOPPED, _T.STOP): _M.STOPPED,
    (_M.STOPPED, _T.CLEAR): _M.INACTIVE,
    # latched fault: only clear leaves it
    (_M.FAULT, _T.LINK_UP): _M.FAULT,
    (_M.FAULT, _T.LINK_LOST): _M.FAULT,
    (_M.FAULT, _T.COMMAND): _M.FAULT,
    (_M.FAULT, _T.NO_COMMAND): _M.FAULT,
    (_M.FAULT, _T.FAULT): _M.FAULT,
    (_M.FAULT, _T.LEAVE): _M.LEAVING,
    (_M.FAULT, _T.STOP): _M.FAULT,
    (_M.FAULT, _T.CLEAR): _M.INACTIVE,
    # going down
    (_M.LEAVING, _T.LINK_UP): _M.LEAVING,
    (_M.LEAVING, _T.LINK_LOST): _M.LEAVING,
    (_M.LEAVING, _T.COMMAND): _M.LEAVING,
    (_M.LEAVING, _T.NO_COMMAND): _M.LEAVING,
    (_M.LEAVING, _T.FAULT): _M.LEAVING,
    (_M.LEAVING, _T.LEAVE): _M.LEAVING,
    (_M.LEAVING, _T.STOP): _M.LEAVING,
}
"""After `clear` of a latch the robot is inactive, and active again at once if it was before it."""

REFUSALS: dict[tuple[Mode, Trigger], str] = {
    (_M.STOPPED, _T.ACTIVATE): "stopped: call srv/clear first",
    (_M.STOPPED, _T.DEACTIVATE): "stopped already: it cannot move; call srv/clear first",
    (_M.FAULT, _T.ACTIVATE): "in fault: call srv/clear first",
    (_M.FAULT, _T.DEACTIVATE): "in fault: it cannot move; call srv/clear first",
    (_M.LEAVING, _T.CLEAR): "the daemon is going down",
    (_M.LEAVING, _T.ACTIVATE): "the daemon is going down",
    (_M.LEAVING, _T.DEACTIVATE): "the daemon is going down",
}
"""Why an absent entry is refused, for the person who asked."""


class RefusedError(AcsardError):
    """The table has no entry for this; the text is for the person who asked."""


def next_mode(mode: Mode, trigger: Trigger) -> Mode:
    """Where `trigger` leads from `mode`; raises `RefusedError` where the table has no entry."""
    try:
        return TABLE[mode, trigger]
    except KeyError:
        raise RefusedError(REFUSALS[mode, trigger]) from None
