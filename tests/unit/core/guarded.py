"""The outputs of a step, checked by a guard as the control loop does."""

from __future__ import annotations

from acsard.core.guard import Guard
from acsard.core.values import Status, Trip
from tests.stepped import Outputs


def checked(guard: Guard, outputs: Outputs) -> tuple[bytes | None, Trip]:
    """Return the line to send, if the outputs have one, and why it is not the robot's."""
    if outputs.line is None:
        return None, ""
    status = Status(outputs.mode, outputs.code, outputs.reason, outputs.link, outputs.source)
    return guard.check(outputs.line, outputs.now.mono_ns, status, outputs.command_ns)
