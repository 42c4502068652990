"""The mode the robot is in, moved only by the table, and what latched it.

What lives here: the state beside the table (`modes.py`): switched on or off, why latched, when
last stopped. What must not: what a mode means for the wheels (`robot.py`).
"""

from __future__ import annotations

from acsard.drive.modes import Mode, RefusedError, Trigger, next_mode


class Lifecycle:
    """One robot's mode. A request that cannot be raises `RefusedError`, in words."""

    def __init__(self, active: bool) -> None:
        self.mode = Mode.INACTIVE
        self.latched = ""
        """Why it is stopped or in fault."""
        self._active = active
        self._stopped_ns = -1
        self._resume(linked=False)

    def fire(self, trigger: Trigger) -> None:
        """A fact (link, command, fault, leave) has come about."""
        self.mode = next_mode(self.mode, trigger)

    def link(self, up: bool) -> None:
        """The link is up, or is not."""
        self.fire(Trigger.LINK_UP if up else Trigger.LINK_LOST)

    def fault(self, why: str, now_ns: int) -> bool:
        """Latch a fault; False when one is latched already, whose reason is kept."""
        if self.mode in (Mode.FAULT, Mode.LEAVING):
            return False
        self._stopped_ns = now_ns
        self.fire(Trigger.FAULT)
        self.latched = why
        return True

    def stop(self, now_ns: int) -> str:
        """Stop and latch."""
        self._stopped_ns = now_ns
        self.fire(Trigger.STOP)
        if self.mode is Mode.LEAVING:
            return "the daemon is going down: ramping to zero"
        if self.mode is Mode.FAULT:
            return "in fault, which holds the robot already; srv/clear releases it"
        self.latched = "stopped by request"
        return "stopped and latched; srv/clear releases it"

    def clear(self, asked_ns: int, now_ns: int, linked: bool) -> bool:
        """Release the latch, unless it was asked before the last stop or fault came about.

        False when nothing was latched, and nothing has changed.
        """
        if asked_ns <= self._stopped_ns or now_ns == self._stopped_ns:
            raise RefusedError("a stop or fault came at the same time or after; call it again")
        before = self.mode
        self.fire(Trigger.CLEAR)
        if self.mode is before:
            return False
        self.latched = ""
        self._resume(linked)
        return True

    def activate(self, linked: bool) -> bool:
        """Switch on; True when it was off."""
        self.fire(Trigger.ACTIVATE)
        was_off, self._active = not self._active, True
        if linked:
            self.link(True)
        return was_off

    def deactivate(self) -> str:
        """Switch off."""
        self.fire(Trigger.DEACTIVATE)
        self._active = False
        return "inactive: ramping to zero; srv/activate switches it on"

    def _resume(self, linked: bool) -> None:
        if self._active:
            self.activate(linked)
