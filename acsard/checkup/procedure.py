"""Runs the steps of the check in order.

A step is repeated if the board restarts, or if this computer ran the step too late. The check ends
early if the operator quits, after a danger such as a motor that runs away, if the serial port is
lost, or if this program stalls. The check sends zero speeds before it ends.
"""

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
from acsard.checkup.findings import SKIPPED_STEPS, Finding, StoppedError, WireLostError, motor_name
from acsard.checkup.motion import SHORT_MEASUREMENT_S
from acsard.checkup.outcomes import TimingFinding
from acsard.checkup.restarts import Restart, RestartedError
from acsard.checkup.wheels import Channel, encoder_finding, wheel_map
from acsard.core.config.motion_rules import longest_reply
from acsard.core.config.settings import Config, SafetyConfig
from acsard.core.formatting import many
from acsard.core.values import NS_PER_S

LIFTED, QUITS = "lifted", "q"

CONFIRMATION = (
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
"""Names of all steps. After an early end of the check, the finding `SKIPPED_STEPS` lists the steps
without a result. If only some motors have a result, the finding names the other motors instead of
the step "motors"."""

SILENT_STEPS: tuple[tuple[str, Callable[[Board], Finding | None]], ...] = (
    ("listening for 3 s at the configured baud rate, then at other baud rates", dialect.baud),
    ("asking the board for its name", dialect.identity),
    # The later steps send lines with the ending that this step finds.
    ("testing whether lines to the board need a comma at their end", dialect.form),
    ("measuring how often the board answers", dialect.rate),
    ("measuring how fast the board answers", dialect.trip),
    ("checking the format of the replies", dialect.replies),
    ("asking whether the board supports the link check", dialect.check),
    ("counting lost lines for 3 s or more", line_loss.finding),
)
"""The first steps of the check, in order, each with a message for the operator.

They send only zero speeds and questions.
"""

Step = Callable[[], Finding | None]

LATE_AGAIN, LATE_MOST = 2, 8
"""Limits for the repetition of steps that this computer ran too late.

A step is repeated up to `LATE_AGAIN` times. All steps together are repeated up to `LATE_MOST`
times, because a check could otherwise take four minutes.
"""

STALL_S, ZEROS_STALL_S = 0.5, 5.0
"""Longest stalls of this program that do not end the check, s.

A longer stall ends the check, because the operator may have left the robot meanwhile.
`ZEROS_STALL_S` applies while the check sends only zeros, until it has seen all motors stand still.
Later `STALL_S` applies. A shorter stall can only cause a repetition of the step.
"""

AGAIN, MOST = 1, 5
"""Limits for restarts of the board: `AGAIN` for one step, and `MOST` for all steps together.

If the board restarts during a step, the step is repeated up to `AGAIN` times. One more restart in
the same step ends the check. The check also ends with restart number `MOST` in all.
"""


def run(
    wire: Wire,
    operator: Operator,
    config: Config,
    tell: Callable[[Finding], None],
    asleep_ns: Callable[[], int] = lambda: 0,
) -> None:
    """Check one microcontroller, and call `tell` with each finding as soon as it is known.

    Until the operator confirms that the wheels are lifted, the check sends only zeros. The last
    lines are zeros, unless the serial port is lost. The check ends early if this program stalls for
    longer than `STALL_S` or `ZEROS_STALL_S`. The wait for an answer of the operator is not a stall.
    Raises `KeyboardInterrupt` if the operator types `QUITS`, even while a motor turns, and
    `MendableError` if the port cannot be opened.

    Args:
        wire: the connection to the board, which is not open yet.
        operator: the person near the robot, who confirms and answers.
        config: the configuration of the robot, with which the check compares the board.
        tell: function that receives each finding.
        asleep_ns: function that returns for how long this computer has been suspended since its
            start, ns. The clock of `wire` does not count this time.
    """
    finding_names: set[str] = set()
    unjudged: set[str] = set()

    def once(finding: Finding | None) -> None:
        """Call `tell` with the first finding of each name, and ignore later findings of that name.

        There is one exception. If the first finding says that its step was not judged, also call
        `tell` with the next finding that judges the step.
        """
        if finding is None:
            return
        judged = lateness.judged(finding)
        if finding.name not in finding_names or (judged and finding.name in unjudged):
            (unjudged.discard if judged else unjudged.add)(finding.name)
            finding_names.add(finding.name)
            tell(outcomes.plain(finding))

    why = ""
    all_restarts: list[Restart] = []
    try:
        longest_s = longest_reply(config.feedback.fault_time)
        with Board(wire, config.mcu, config.rate_hz, longest_s) as board:
            board.zeros()
            if operator.ask(CONFIRMATION, (LIFTED,)) != LIFTED:
                raise StoppedError(outcomes.find("wheels: not lifted"))
            watched = _Watched(operator, board, asleep_ns)
            board.abort_check = watched.check_operator
            _Steps(board, watched, once, all_restarts).all(config.safety)
    except StoppedError as end:
        once(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        once(outcomes.find("serial line: lost", error=lost))
        why = "the check ended early: the serial line was lost"
    if all_restarts:
        once(restarts.finding(config.mcu, all_restarts))
    motors = [motor_name(config.mcu, motor) for motor in range(4)]
    names = ["motors"] if finding_names.isdisjoint(motors) else motors
    steps = [name for step in STEPS for name in (names if step == "motors" else [step])]
    rest = [step for step in steps if step not in finding_names]
    if why and rest:
        left = f"{why}; not finished: {', '.join(rest)}"
        tell(Finding(SKIPPED_STEPS, "SKIPPED", many(len(rest), "step"), left))


class _Watched:
    """Passes questions to the operator, and ends the check if the operator quits.

    It also ends the check if this program stalls, because the operator may have left meanwhile.
    """

    def __init__(self, operator: Operator, board: Board, asleep_ns: Callable[[], int]) -> None:
        self.doing, self.keys = operator.doing, operator.keys
        self._operator, self._board, self._asleep_ns = operator, board, asleep_ns
        self._ran_s = self._now_s()
        """Time of the last call of `check_operator` or of the operator's last answer, s."""

    def _now_s(self) -> float:
        """Return a monotonic time, s, that advances even while the computer is suspended."""
        return self._board.now_s + self._asleep_ns() / NS_PER_S

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        answer = self._operator.ask(question, answers)
        # The wait for the answer is not a stall.
        self._ran_s = self._now_s()
        return answer

    def check_operator(self) -> None:
        now_s = self._now_s()
        stalled_s, self._ran_s = now_s - self._ran_s, now_s
        if stalled_s > (STALL_S if self._board.armed else ZEROS_STALL_S):
            raise StoppedError(outcomes.find("stall: seen", seconds=stalled_s))
        if stalled_s > STALL_S:
            # `Board` measures neither the time for which the computer was suspended, nor the time
            # for which the terminal did not accept the tool's output.
            self._board.lateness.record(stalled_s, self._board.now_s)
        if QUITS in self.keys(0.0).lower():
            raise KeyboardInterrupt


class _Steps:
    """Runs the steps. It repeats a step if the board restarts or if this computer is too late."""

    def __init__(
        self,
        board: Board,
        operator: Operator,
        tell: Callable[[Finding | None], None],
        seen: list[Restart],
    ) -> None:
        self._board, self._operator, self._tell = board, operator, tell
        self._all_restarts = seen
        """All restarts of the board so far. The caller of `all` reads this list afterward."""
        self._channels: list[Channel] = []
        self._late_left = LATE_MOST

    def all(self, safety: SafetyConfig) -> None:
        board, operator = self._board, self._operator
        for doing, step in SILENT_STEPS:
            self._measure(doing, partial(step, board))
        self._take("", self._stop_and_arm)
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

    def _stop_and_arm(self) -> None:
        self._board.stop_motors()
        self._board.armed = True

    def _turn(self, motor: int) -> Finding:
        """Test one motor, then ask the operator which wheel turned.

        The question is omitted if this computer ran the test too late.
        """
        board, operator, channels = self._board, self._operator, self._channels
        operator.doing(f"{motor_name(board.mcu, motor)} turns: briefly, then forward and back")

        def measure_motor() -> Finding:
            channels[motor:] = [wheels.channel(board, motor)]
            return encoder_finding(board.mcu, channels[motor])

        finding = self._in_time(measure_motor)
        if finding is not None and not lateness.judged(finding):
            channels[motor] = structs.replace(channels[motor], judged=False)
            return finding
        channels[motor] = wheels.ask_which_wheel(board, operator, channels[motor])
        return encoder_finding(board.mcu, channels[motor])

    def _measure(self, doing: str, step: Step) -> None:
        self._take(doing, partial(self._in_time, step))

    def _in_time(self, step: Step) -> Finding | None:
        """Run a step. Repeat it if this computer was too late for a reliable finding.

        After the last permitted repetition, return a finding which says that the step was not
        judged. Raises `StoppedError` if the step ends the check.
        """
        board, saved, late_s = self._board, self._board.saved_results, 0.0
        for _ in range(1 + min(LATE_AGAIN, self._late_left)):
            if late_s:
                self._late_left -= 1
                self._operator.doing("this computer ran the check too late; this part runs again")
                board.saved_results = saved
                if board.armed:
                    board.stop_motors()
            began_s = board.now_s
            finding, ends = _ended(step)
            # A finding that is not `TimingFinding` is right even if this computer ran the check too
            # late.
            if board.runaway_seen or not isinstance(finding, TimingFinding):
                break
            # The delay of a simulated board is known only when its program runs again, so wait for
            # an answer. If the board does not answer at all, a delay is not the cause.
            if finding.verdict != "PASS" and not board.comes_back():
                break
            meanwhile_s = board.lateness.since(began_s)
            if not lateness.is_doubtful(finding, meanwhile_s):
                break
            late_s = max(late_s, meanwhile_s)
            late_finding = lateness.finding(finding.name, late_s)
            if ends and board.armed:
                # The step has ended the check. So do not turn a motor again, even if the cause was
                # only a delay of this computer.
                finding, board.saved_results = late_finding, saved
                break
        else:
            finding, board.saved_results = late_finding, saved
        if finding is not None and ends:
            raise StoppedError(finding)
        return finding

    def _take(self, doing: str, step: Step) -> None:
        board, again = self._board, 0
        saved = board.saved_results
        while True:
            try:
                if again:
                    self._come_back()
                if doing:
                    self._operator.doing(doing)
                self._tell(self._tried(step))
                return
            except RestartedError as error:
                self._all_restarts.append(error.restart)
                again += 1
                if again > AGAIN or len(self._all_restarts) >= MOST:
                    raise StoppedError(restarts.finding(board.mcu, self._all_restarts)) from None
                board.saved_results = saved

    def _tried(self, step: Step) -> Finding | None:
        """Run a step. Raise `RestartedError` if the board restarted during the step.

        A bad finding can come from a restart. So after a bad finding, if the board is silent, wait
        until it sends a line, which can show the restart.
        """
        try:
            finding = step()
        except StoppedError:
            self._await_return(SHORT_MEASUREMENT_S)
            raise
        if finding is not None and finding.verdict in ("WARN", "FAIL"):
            self._await_return(2 * SHORT_MEASUREMENT_S)
        return finding

    def _await_return(self, silent_s: float) -> None:
        board = self._board
        if board.silent_s > max(silent_s, 4 * board.gap_s):
            board.comes_back()

    def _come_back(self) -> None:
        board = self._board
        board.forget()
        self._operator.doing(
            "the board restarted; this part of the check runs again when the board answers"
        )
        if not board.comes_back():
            raise StoppedError(restarts.finding(board.mcu, self._all_restarts, back=False))
        if cause := restarts.cause(board.unrecognized_lines):
            self._all_restarts[-1] = structs.replace(self._all_restarts[-1], cause=cause)
        if board.armed:
            board.stop_motors()


def _ended(step: Step) -> tuple[Finding | None, bool]:
    try:
        return step(), False
    except StoppedError as error:
        return error.finding, True
