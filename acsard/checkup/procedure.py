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
    lateness,
    loss,
    lost_where,
    manual,
    pace,
    restarts,
    turning,
    watchdog,
)
from acsard.checkup.board import Board
from acsard.checkup.findings import REST, Finding, StoppedError, WireLostError, motor_name
from acsard.checkup.limits import BOOT_S, GLANCE_S
from acsard.checkup.manual import Unsure
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

LATE_AGAIN, LATE_MOST = 2, 8
"""A step for which this computer was late is tried again so often; so many times in all, since a
check that takes four minutes is none."""

AGAIN, MOST = 1, 5
"""A step in which the board starts anew is tried again so often, and so many new starts in all end
the check."""


def run(wire: Wire, operator: Operator, config: Config, tell: Tell) -> None:
    """Check one microcontroller and `tell` each finding as it is made.

    Nothing but zeros goes out before the operator has confirmed that the wheels are lifted.
    Whatever happens, the last lines are zeros in both forms, then silence: the wire is closed.
    """
    told: set[str] = set()
    unjudged: set[str] = set()

    def once(finding: Finding | None) -> None:
        """What several steps can find is told by the first of them that could judge it."""
        if finding is None:
            return
        judged = lateness.judged(finding)
        if finding.name not in told or (judged and finding.name in unjudged):
            (unjudged.discard if judged else unjudged.add)(finding.name)
            told.update((finding.name, "motors") if "motor " in finding.name else (finding.name,))
            tell(manual.plain(finding))

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
        self._late_left = LATE_MOST

    def all(self) -> None:
        """From the first line to the last."""
        board, operator = self._board, self._operator
        for doing, step in SILENT:
            self._measure(doing, partial(step, board))
        self._take("", self._stand)
        for motor in range(4):
            self._take("", partial(self._turn, motor))
        channels = self._channels
        self._take("", lambda: dialect.comma(board, channels[-1].kind in ("dead", "late")))
        self._take("", lambda: wheel_map(board.mcu, channels))
        right = [channel.motor for channel in channels if channel.kind in ("right", "off")]
        self._measure("", lambda: lost_where.finding(board, operator, right))
        self._take("", lambda: counts.finding(board, right))
        together = "the motors turn together, then the host falls silent, several times perhaps"
        self._measure(together, lambda: watchdog.finding(board, right))
        broken = "broken lines go out; nothing may turn"
        self._measure(broken, lambda: damage.finding(board, right))

    def _stand(self) -> None:
        self._board.rest()
        self._board.armed = True

    def _turn(self, motor: int) -> Finding:
        """One motor; the person is asked only what it was in time."""
        board, operator, channels = self._board, self._operator, self._channels
        operator.say(f"{motor_name(board.mcu, motor)} turns: a moment first, then forth and back")

        def looked() -> Finding:
            channels[motor:] = [turning.channel(board, motor)]
            return encoder_finding(board.mcu, channels[motor])

        found = self._in_time(looked)
        if found is not None and not lateness.judged(found):
            channels[motor] = structs.replace(channels[motor], judged=False)
            return found
        channels[motor] = turning.seen(board, operator, channels[motor])
        return encoder_finding(board.mcu, channels[motor])

    def _measure(self, doing: str, step: Step) -> None:
        """A step that is worth nothing where this computer was late."""
        self._take(doing, partial(self._in_time, step))

    def _in_time(self, step: Step) -> Finding | None:
        """What a step finds while this computer is in time, or that it never was."""
        board, known, late_s = self._board, self._board.known, 0.0
        for _ in range(1 + min(LATE_AGAIN, self._late_left)):
            if late_s:
                self._late_left -= 1
                self._operator.say("this computer was late; once more")
                board.known = known
                if board.armed:
                    board.rest()
            began_s = board.now_s
            found, ends = _ended(step)
            # A board that is a program here says that it was late when it runs again; one that does
            # not answer is silent, whatever this computer does.
            if board.fled or not isinstance(found, Unsure):
                break
            if found.verdict != "PASS" and not board.wakes(BOOT_S):
                break
            meanwhile_s = board.lateness.since(began_s)
            if not lateness.spoilt(found, meanwhile_s):
                break
            late_s = max(late_s, meanwhile_s)
            told = lateness.finding(found.name, late_s)
            if ends and board.armed:
                # Of this computer's making or not: nobody turns a motor again behind that.
                found, board.known = told, known
                break
        else:
            found, board.known = told, known
        if found is not None and ends:
            raise StoppedError(found)
        return found

    def _take(self, doing: str, step: Step) -> None:
        """A step and what it found."""
        board, again = self._board, 0
        known = board.known
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
                board.known = known

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
        if board.silent_s > max(silent_s, 4 * board.gap_s):
            board.wakes(BOOT_S)

    def _come_back(self) -> None:
        """Zeros until a board that has started anew answers, and its motors stand."""
        board = self._board
        board.forget()
        self._operator.say("the board started anew; once more, when it answers")
        if not board.wakes(BOOT_S):
            raise StoppedError(restarts.finding(board.mcu, self._seen, back=False))
        if said := restarts.cause(board.others):
            self._seen[-1] = structs.replace(self._seen[-1], cause=said)
        if board.armed:
            board.rest()


def _ended(step: Step) -> tuple[Finding | None, bool]:
    """What a step finds, and whether the check must end with it."""
    try:
        return step(), False
    except StoppedError as error:
        return error.finding, True
