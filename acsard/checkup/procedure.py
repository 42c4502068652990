"""Runs the steps of the check in order, repeats a step if needed, and may end the check early."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from msgspec import structs

from acsard.checkup import (
    damage,
    dialect,
    encoder_counts,
    inputs,
    lateness,
    line_loss,
    outcomes,
    restarts,
    watchdog,
    wheels,
)
from acsard.checkup.board import Board, Operator, Wire
from acsard.checkup.findings import REST, Finding, StoppedError, WireLostError, motor_name
from acsard.checkup.motion import BOOT_S, GLANCE_S
from acsard.checkup.outcomes import Unsure
from acsard.checkup.restarts import Restart, RestartedError
from acsard.checkup.wheels import Channel, encoder_finding, wheel_map
from acsard.core.config.motion_rules import longest_reply
from acsard.core.config.settings import Config, SafetyConfig
from acsard.core.formatting import many
from acsard.core.values import NS_PER_S

LIFTED, QUITS = "lifted", "q"

CONFIRM = (
    "The wheels will turn one by one, then together. The tool commands 3 rad/s at most, but a "
    "wheel whose encoder is dead or reversed can reach full speed for about a second. Lift the "
    "robot so that no wheel touches anything, keep a hand on the power switch, then type "
    f'"{LIFTED}". No wheel has turned yet; q or Ctrl-C quits at any time:'
)

STEPS = (
    "baud rate", "identification", "reply form", "reply rate", "round trip", "checked link",
    "lost lines", "motors", "trailing comma", "wheel map", "encoder counts", "watchdog",
    "damaged lines", "inputs",
)  # fmt: skip
"""Names of all steps. If the check ends early, the finding `REST` lists the steps without a result.
"""

SILENT: tuple[tuple[str, Callable[[Board], Finding | None]], ...] = (
    ("listening for 3 s at the configured baud rate, then at other baud rates", dialect.baud),
    ("asking the board for its name", dialect.identity),
    ("measuring how often the board answers", dialect.rate),
    ("measuring how fast the board answers", dialect.trip),
    ("testing whether lines to the board need a comma at their end", dialect.form),
    ("checking the format of the replies", dialect.replies),
    ("asking whether the board supports the link check", dialect.check),
    ("counting lost lines for 3 s or more", line_loss.finding),
)
"""The first steps of the check, in order, each with a message for the operator. These steps send
only zeros and questions."""

Tell = Callable[[Finding], None]
Step = Callable[[], Finding | None]

LATE_AGAIN, LATE_MOST = 2, 8
"""The check runs late if this computer is too busy to run the tool in time. If the finding of a
step is therefore doubtful, the check repeats the step, up to `LATE_AGAIN` times. A check has at
most `LATE_MOST` such repetitions in total. Without this second limit, a check could take four
minutes."""

STALL_S, ZEROS_STALL_S = 0.5, 5.0
"""Longest stalls of this program that do not end the check, s. `ZEROS_STALL_S` applies until the
check has seen all motors stand still, because the check sends only zeros until then. Later
`STALL_S` applies. A longer stall ends the check, because the operator may have left the robot. A
shorter stall may only cause a step to be repeated (see `LATE_AGAIN`)."""

AGAIN, MOST = 1, 5
"""If the board restarts during a step, the step is repeated, up to `AGAIN` times. One more restart
in the same step ends the check. The check also ends after `MOST` restarts in all steps together."""


def run(
    wire: Wire,
    operator: Operator,
    config: Config,
    tell: Tell,
    asleep_ns: Callable[[], int] = lambda: 0,
) -> None:
    """Check one microcontroller, and call `tell` with each finding as soon as it is known.

    Until the operator confirms that the wheels are lifted, the check sends only zeros. The last
    lines are always zeros, unless the serial port is lost. The check ends early if this program
    stalls for longer than `STALL_S` or `ZEROS_STALL_S`; the wait for an answer of the operator is
    not a stall. Raises `KeyboardInterrupt` if the operator types `QUITS`, even while a motor turns.

    `asleep_ns` returns for how long this computer has been suspended since its start, ns. The
    clock of `wire` stops while the computer is suspended.
    """
    told: set[str] = set()
    unjudged: set[str] = set()

    def once(finding: Finding | None) -> None:
        """Report a finding, unless a finding with the same name has been reported already.

        If the earlier finding was not judged, a judged finding is still reported.
        """
        if finding is None:
            return
        judged = lateness.judged(finding)
        if finding.name not in told or (judged and finding.name in unjudged):
            (unjudged.discard if judged else unjudged.add)(finding.name)
            told.update((finding.name, "motors") if "motor " in finding.name else (finding.name,))
            tell(outcomes.plain(finding))

    why = ""
    seen: list[Restart] = []
    try:
        longest_s = longest_reply(config.feedback.fault_time)
        with Board(wire, config.mcu, config.rate_hz, longest_s) as board:
            board.zeros()
            if operator.ask(CONFIRM, (LIFTED,)) != LIFTED:
                raise StoppedError(outcomes.find("wheels: not lifted"))
            watched = _Watched(operator, board, asleep_ns)
            board.between = watched.look
            _Steps(board, watched, once, seen).all(config.safety)
    except StoppedError as end:
        once(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        once(outcomes.find("serial line: lost", error=lost))
        why = "the check ended early: the serial line was lost"
    if seen:
        once(restarts.finding(config.mcu, seen))
    rest = [step for step in STEPS if step not in told]
    if why and rest:
        left = f"{why}; not tried: {', '.join(rest)}"
        tell(Finding(REST, "SKIPPED", many(len(rest), "step"), left))


class _Watched:
    """The operator during the steps, watched by `look`.

    `look` ends the check if the operator quits, or if a stall may have made the operator leave.
    """

    def __init__(self, operator: Operator, board: Board, asleep_ns: Callable[[], int]) -> None:
        """Begin to watch for stalls. `asleep_ns` is the argument of this name of `run()`."""
        self.doing, self.keys = operator.doing, operator.keys
        self._operator, self._board, self._asleep_ns = operator, board, asleep_ns
        self._ran_s = self._now_s()
        """Time of the last call of `look` or of the last answer, whichever is later, s."""

    def _now_s(self) -> float:
        """Return a monotonic time, s, that advances even while the computer is suspended."""
        return self._board.now_s + self._asleep_ns() / NS_PER_S

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Ask the operator. The time until the answer does not count as a stall."""
        answer = self._operator.ask(question, answers)
        self._ran_s = self._now_s()
        return answer

    def look(self) -> None:
        """Raise `KeyboardInterrupt` if the operator quits, and `StoppedError` after a stall."""
        now_s = self._now_s()
        stalled_s, self._ran_s = now_s - self._ran_s, now_s
        if stalled_s > (STALL_S if self._board.armed else ZEROS_STALL_S):
            raise StoppedError(outcomes.find("stall: seen", seconds=stalled_s))
        if stalled_s > STALL_S:
            # `Board` does not measure the time of a suspended computer or of a stalled terminal.
            self._board.lateness.look(stalled_s, self._board.now_s)
        if QUITS in self.keys(0.0).lower():
            raise KeyboardInterrupt


class _Steps:
    """Runs the steps of the check.

    A step is repeated if the board restarts during the step, or if the finding of the step is
    doubtful because the check ran late.
    """

    def __init__(
        self,
        board: Board,
        operator: Operator,
        tell: Callable[[Finding | None], None],
        seen: list[Restart],
    ) -> None:
        self._board, self._operator, self._tell = board, operator, tell
        self._seen = seen
        """The restarts of the board so far. The caller reads this list after the last step."""
        self._channels: list[Channel] = []
        self._late_left = LATE_MOST

    def all(self, safety: SafetyConfig) -> None:
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
        self._measure("", lambda: line_loss.direction(board, operator, right))
        self._take("", lambda: encoder_counts.finding(board, right))
        together = "the motors turn, then this computer sends nothing, perhaps several times"
        self._measure(together, lambda: watchdog.finding(board, right))
        broken = "sending damaged lines; a motor that turns now is a fault"
        self._measure(broken, lambda: damage.finding(board, right))
        self._take("", lambda: inputs.finding(board, operator, safety))

    def _stand(self) -> None:
        self._board.rest()
        self._board.armed = True

    def _turn(self, motor: int) -> Finding:
        """Test one motor, ask the operator which wheel it turned, and return the finding.

        The question is left out if the check ran too late in every attempt at the test. The
        measured motion of the motor is then doubtful, and the finding says that the check could not
        judge the motor.
        """
        board, operator, channels = self._board, self._operator, self._channels
        operator.doing(f"{motor_name(board.mcu, motor)} turns: briefly, then forward and back")

        def looked() -> Finding:
            channels[motor:] = [wheels.channel(board, motor)]
            return encoder_finding(board.mcu, channels[motor])

        found = self._in_time(looked)
        if found is not None and not lateness.judged(found):
            channels[motor] = structs.replace(channels[motor], judged=False)
            return found
        channels[motor] = wheels.seen(board, operator, channels[motor])
        return encoder_finding(board.mcu, channels[motor])

    def _measure(self, doing: str, step: Step) -> None:
        """Run a step and report its finding.

        The step is repeated if the board restarts, or if the finding is doubtful because the check
        ran late.
        """
        self._take(doing, partial(self._in_time, step))

    def _in_time(self, step: Step) -> Finding | None:
        """Run a step, and return its finding.

        The step is repeated if the finding is doubtful because the check ran late during the step
        (`lateness.spoilt`). If the last permitted attempt is doubtful too, the returned finding
        says that the step was not judged. Raises `StoppedError` if the step ends the check.
        """
        board, known, late_s = self._board, self._board.known, 0.0
        for _ in range(1 + min(LATE_AGAIN, self._late_left)):
            if late_s:
                self._late_left -= 1
                self._operator.doing("this computer was late; this part of the check runs again")
                board.known = known
                if board.armed:
                    board.rest()
            began_s = board.now_s
            found, ends = _ended(step)
            # If the board is a program on this computer, its lateness is known only when that
            # program runs again. If the board does not answer, lateness does not explain it.
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
                # After an early end no motor may be turned again, even if lateness was the cause.
                found, board.known = told, known
                break
        else:
            found, board.known = told, known
        if found is not None and ends:
            raise StoppedError(found)
        return found

    def _take(self, doing: str, step: Step) -> None:
        """Run a step and report its finding. Repeat the step if the board restarts.

        `doing` is the text about this step that the operator sees; "" shows no text. Raises
        `StoppedError` if the board restarts too often.
        """
        board, again = self._board, 0
        known = board.known
        while True:
            try:
                if again:
                    self._come_back()
                if doing:
                    self._operator.doing(doing)
                self._tell(self._tried(step))
                return
            except RestartedError as error:
                self._seen.append(error.restart)
                again += 1
                if again > AGAIN or len(self._seen) >= MOST:
                    raise StoppedError(restarts.finding(board.mcu, self._seen)) from None
                board.known = known

    def _tried(self, step: Step) -> Finding | None:
        """Run a step and return its finding.

        If the finding is bad, first wait until a silent board answers, because it may have
        restarted.
        """
        try:
            finding = step()
        except StoppedError:
            self._await_return(GLANCE_S)
            raise
        if finding is not None and finding.verdict in ("WARN", "FAIL"):
            self._await_return(2 * GLANCE_S)
        return finding

    def _await_return(self, silent_s: float) -> None:
        """If the board is silent, send zeros until it answers or has had enough time to boot.

        The board counts as silent if its last reply is older than `silent_s` s, and also older than
        four times `gap_s`.
        """
        board = self._board
        if board.silent_s > max(silent_s, 4 * board.gap_s):
            board.wakes(BOOT_S)

    def _come_back(self) -> None:
        """Send zeros until a restarted board answers.

        Once the check has seen all motors stand still (`Board.armed`), also send zeros until they
        stand still again.
        """
        board = self._board
        board.forget()
        self._operator.doing(
            "the board restarted; this part of the check runs again when the board answers"
        )
        if not board.wakes(BOOT_S):
            raise StoppedError(restarts.finding(board.mcu, self._seen, back=False))
        if said := restarts.cause(board.others):
            self._seen[-1] = structs.replace(self._seen[-1], cause=said)
        if board.armed:
            board.rest()


def _ended(step: Step) -> tuple[Finding | None, bool]:
    try:
        return step(), False
    except StoppedError as error:
        return error.finding, True
