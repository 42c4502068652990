"""What is new in a state, as lines of a log; pure.

The daemon's own log stays with the daemon: this is what its `state` shows of it.
"""

from __future__ import annotations

from acsard.messages.schema import RobotState
from acsard.ros.shapes import LEVELS, Log
from acsard.values import Level

BAD: dict[str, Level] = {"fault": "error", "stopped": "warning", "waiting": "warning"}
"""Modes that are more than news."""


class News:
    """Knows the state before."""

    def __init__(self) -> None:
        self._before: RobotState | None = None

    def of(self, state: RobotState) -> list[Log]:
        """What to tell of this state; of the first one, how it is."""
        before, self._before = self._before, state
        told: list[tuple[Level, str, str]] = []
        if before is None or (state.mode, state.reason) != (before.mode, before.reason):
            why = state.reason.removeprefix(f"{state.mode}: ")
            told.append((BAD.get(state.mode, "info"), "mode", f"{state.mode}: {why}"))
        if state.refused and (before is None or state.refused != before.refused):
            told.append(("warning", "refused", state.refused))
        for name in ("doubt", "recording"):
            now, was = getattr(state, name), "" if before is None else getattr(before, name)
            if now != was:
                told.append(("warning", name, now) if now else ("info", name, f"over: {was}"))
        return [Log(state.stamp, LEVELS[level], name, text) for level, name, text in told]
