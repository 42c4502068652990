"""The check from the first zero to the last: the order of the steps, what is tried again, and how
it ends early."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from msgspec import structs

from acsard.checkup import (
    counts,
    damage,
    dialect,
    loss,
    lost_where,
    manual,
    pace,
    restarts,
    turning,
    watchdog,
)
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding, StoppedError, WireLostError
from acsard.checkup.limits import BOOT_S, GLANCE_S
from acsard.checkup.outside import Operator, Wire
from acsard.checkup.restarts import Restart, RestartedError
from acsard.checkup.wheels import Channel, encoder_finding, wheel_map
from acsard.config.motion_rules import longest_reply
from acsard.config.settings import Config

LIFTED = "lifted"

CONFIRM = (
    "The wheels will turn one by one, then together. They are told 3 rad/s at the most, but a "
    "wheel whose encoder is dead or reversed can reach full speed, for a second or so. Lift the "
    "robot so that none touches anything, keep a hand on the power switch, then type "
    f'"{LIFTED}". Nothing has turned yet; q or Ctrl-C leaves, here and later:'
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
Step = Callable[[], Finding | None]

AGAIN, MOST = 1, 5
"""A step in which the board starts anew is tried again so often, and so many new starts in all end
the check."""


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

    why = ""
    seen: list[Restart] = []
    try:
        longest_s = longest_reply(config.feedback.fault_time)
        with Board(wire, config.mcu, config.rate_hz, longest_s) as board:
            board.zeros()
            if operator.ask(CONFIRM, (LIFTED,)) != LIFTED:
                raise StoppedError(manual.find("wheels: not lifted"))
            _Steps(board, operator, once, seen).all()
    except StoppedError as end:
        once(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        once(manual.find("serial line: lost", error=lost))
        why = "the check ended early: the serial line was lost"
    if seen:
        once(restarts.finding(config.mcu, seen))
    rest = [step for step in STEPS if step not in told]
    if why and rest:
        tell(Finding(REST, "SKIPPED", f"{len(rest)} steps", f"{why}; not tried: {', '.join(rest)}"))


class _Steps:
    """One after the other; one in which the board starts anew, once more when it is back."""

    def __init__(
        self,
        board: Board,
        operator: Operator,
        tell: Callable[[Finding | None], None],
        seen: list[Restart],
    ) -> None:
        self._board, self._operator, self._tell = board, operator, tell
        self._seen = seen
        """The board's new starts; whoever gave it looks when all has ended."""
        self._channels: list[Channel] = []

    def all(self) -> None:
        """From the first line to the last."""
        board, operator = self._board, self._operator
        for doing, step in SILENT:
            self._take(doing, partial(step, board))
        self._take("", self._stand)
        for motor in range(4):
            self._take("", partial(self._turn, motor))
        channels = self._channels
        self._take("", lambda: dialect.comma(board, channels[-1].kind == "dead"))
        self._take("", lambda: wheel_map(board.mcu, channels))
        right = [channel.motor for channel in channels if channel.kind in ("right", "off")]
        self._take("", lambda: lost_where.finding(board, operator, right))
        self._take("", lambda: counts.finding(board, right))
        together = "the motors turn together, then the host falls silent, several times perhaps"
        self._take(together, lambda: watchdog.finding(board, right))
        broken = "broken lines go out; nothing may turn"
        self._take(broken, lambda: damage.finding(board, right))

    def _stand(self) -> None:
        self._board.rest()
        self._board.armed = True

    def _turn(self, motor: int) -> Finding:
        channel = turning.channel(self._board, self._operator, motor)
        self._channels[motor:] = [channel]
        return encoder_finding(self._board.mcu, channel)

    def _take(self, doing: str, step: Step) -> None:
        """A step and what it found."""
        board, again = self._board, 0
        language = board.comma, board.latched, board.sealed, board.sampled
        while True:
            try:
                if again:
                    self._come_back()
                if doing:
                    self._operator.say(doing)
                self._tell(self._tried(step))
                return
            except RestartedError as error:
                self._seen.append(error.restart)
                again += 1
                if again > AGAIN or len(self._seen) >= MOST:
                    raise StoppedError(restarts.finding(board.mcu, self._seen)) from None
                board.comma, board.latched, board.sealed, board.sampled = language

    def _tried(self, step: Step) -> Finding | None:
        """What a step finds; a board that is silent then may have started anew, and says so."""
        try:
            finding = step()
        except StoppedError:
            self._await_return(GLANCE_S)
            raise
        if finding is not None and finding.verdict in ("WARN", "FAIL"):
            self._await_return(2 * GLANCE_S)
        return finding

    def _await_return(self, silent_s: float) -> None:
        """Zeros until a board that has been silent for so long answers, or has had time to."""
        board = self._board
        end_s = board.now_s + BOOT_S
        while board.silent_s > max(silent_s, 4 * board.gap_s) and board.now_s < end_s:
            board.zeros()
            board.listen(board.period_s)

    def _come_back(self) -> None:
        """Zeros until a board that has started anew answers, and its motors stand."""
        board = self._board
        board.forget()
        self._operator.say("the board started anew; once more, when it answers")
        end_s = board.now_s + BOOT_S
        while not board.replies:
            if board.now_s >= end_s:
                raise StoppedError(restarts.finding(board.mcu, self._seen, back=False))
            board.zeros()
            board.listen(board.period_s)
        if said := restarts.cause(board.others):
            self._seen[-1] = structs.replace(self._seen[-1], cause=said)
        if board.armed:
            board.rest()
