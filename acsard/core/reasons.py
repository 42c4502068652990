"""The text in `reason`: why the robot moves or does not move."""

from __future__ import annotations

from typing import assert_never

from acsard.core.board_inputs import BoardInputs
from acsard.core.codes import Reason, joined, sentence
from acsard.core.config.settings import Config
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.session import McuSession
from acsard.core.motion.arbiter import Choice
from acsard.core.motion.arbiter_text import chosen
from acsard.core.motion.bumpers import missing_reason
from acsard.core.motion.emergency_stop import MISSING_REASON
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.motion.modes import SHUTDOWN_REASON, Mode

PORT_RELEASED = sentence("port_released")


def reason_of(
    life: Lifecycle,
    choice: Choice,
    session: McuSession,
    setup: LinkSetup,
    inputs: BoardInputs,
    config: Config,
    port_trouble: str,
) -> Reason:
    """Return why the robot is in its mode; `port_trouble` says why the port is closed."""
    mode, released, safety = life.mode, life.port_released, config.safety
    match mode:
        case Mode.DRIVING | Mode.READY:
            why, limits = chosen(choice), config.limits
            if why.code == "commanded" and not (limits.linear_speed or limits.angular_speed):
                why = sentence("limits_zero", source=choice.source)
            if not inputs.bumpers.limiting(safety):
                return why
            limit = joined(inputs.bumpers.limit(safety))
            texts = (why.text, limit.text) if mode is Mode.DRIVING else (limit.text, why.text)
            return Reason(limit.code, "; ".join(texts))
        case Mode.WAITING:
            if session.link == "up":
                return MISSING_REASON if inputs.estop.missing(safety) else missing_reason(safety)
            return PORT_RELEASED if released else session.describe_link(setup, port_trouble)
        case Mode.STOPPED | Mode.FAULT | Mode.INACTIVE:
            if released:
                return Reason(life.why.code, f"{life.why.text}; also {PORT_RELEASED.text}")
            return life.why
        case Mode.SHUTDOWN:
            return SHUTDOWN_REASON
        case _:
            assert_never(mode)
