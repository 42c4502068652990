"""The check from the first zero to the last: the order of the steps, and how it ends early."""

from __future__ import annotations

from collections.abc import Callable

from acsard.checkup import (
    counts,
    damage,
    dialect,
    loss,
    lost_where,
    manual,
    pace,
    turning,
    watchdog,
)
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError, WireLostError
from acsard.checkup.limits import BOOT_S, GLANCE_S
from acsard.checkup.outside import Operator, Wire
from acsard.checkup.wheels import encoder_finding, wheel_map
from acsard.config.settings import Config

LIFTED = "lifted"

CONFIRM = (
    "The wheels will turn one by one, then together. They are told 3 rad/s at the most, but a "
    "wheel whose encoder is dead or reversed can reach full speed, for a second or so. Lift the "
    "robot so that none touches anything, keep a hand on the power switch, then type "
    f'"{LIFTED}":'
)

STEPS = (
    "baud rate", "identification", "reply form", "reply rate", "round trip", "checked link",
    "lost lines", "motors", "trailing comma", "wheel map", "encoder counts", "watchdog",
    "damaged lines",
)  # fmt: skip
"""In this order; what the check does not come to is said to be skipped, in one row."""

REST = "the rest"

SILENT: tuple[tuple[str, Callable[[Board], Finding | None]], ...] = (
    ("listening at the configured baud rate, 3 s, then at the others", dialect.baud),
    ("asking who it is", dialect.identity),
    ("listening how often it answers", pace.rate),
    ("measuring how soon it answers", pace.trip),
    ("trying the comma at the end of the line", dialect.form),
    ("looking at its replies", dialect.replies),
    ("asking for the check", dialect.check),
    ("counting lost lines, 3 s and more", loss.finding),
)
"""What is looked at with zeros and questions alone, and what the person is told meanwhile."""

Tell = Callable[[Finding], None]


def run(wire: Wire, operator: Operator, config: Config, tell: Tell) -> None:
    """Check one microcontroller and `tell` each finding as it is made.

    Nothing but zeros goes out before the operator has confirmed that the wheels are lifted.
    Whatever happens, the last lines are zeros in both forms, then silence: the wire is closed.
    """
    told: set[str] = set()

    def once(finding: Finding | None) -> None:
        """What several steps can find is told by the first of them."""
        if finding is not None and finding.name not in told:
            told.update((finding.name, "motors") if "motor " in finding.name else (finding.name,))
            tell(finding)

    try:
        with Board(wire, config.mcu, config.rate_hz) as board:
            board.zeros()
            if operator.ask(CONFIRM, (LIFTED,)) != LIFTED:
                raise StoppedError(manual.find("wheels: not lifted"))
            try:
                _steps(board, operator, once)
            except StoppedError:
                _await_return(board, GLANCE_S)  # which says it if it has started anew
                raise
    except StoppedError as end:
        once(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        once(manual.find("serial line: lost", error=lost))
        why = "the check ended early: the serial line was lost"
    else:
        return
    rest = [step for step in STEPS if step not in told]
    if rest:
        tell(Finding(REST, "SKIPPED", f"{len(rest)} steps", f"{why}; not tried: {', '.join(rest)}"))


def _await_return(board: Board, silent_s: float) -> None:
    """Zeros until a board that has been silent for so long answers, or has had time to start."""
    end_s = board.now_s + BOOT_S
    while board.silent_s > max(silent_s, 4 * board.gap_s) and board.now_s < end_s:
        board.zeros()
        board.listen(board.period_s)


def _steps(board: Board, operator: Operator, once: Callable[[Finding | None], None]) -> None:
    def tell(finding: Finding | None) -> None:
        if finding is not None and finding.verdict in ("WARN", "FAIL"):
            _await_return(board, 2 * GLANCE_S)  # no cable is to blame for a board that starts anew
        once(finding)

    for doing, step in SILENT:
        operator.say(doing)
        tell(step(board))
    board.rest()
    board.armed = True
    channels = []
    for channel in turning.channels(board, operator):
        channels.append(channel)
        tell(encoder_finding(board.mcu, channel))
    tell(dialect.comma(board, channels[-1].kind == "dead"))
    tell(wheel_map(board.mcu, channels))
    right = [channel.motor for channel in channels if channel.kind in ("right", "off")]
    tell(lost_where.finding(board, operator, right))
    tell(counts.finding(board, right))
    operator.say("the motors turn together, then the host falls silent, several times perhaps")
    tell(watchdog.finding(board, right))
    operator.say("broken lines go out; nothing may turn")
    tell(damage.finding(board, right))
