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
    least_speed,
    line_loss,
    outcomes,
    reply_times,
    restarts,
    top_speed,
    watchdog,
)
from acsard.checkup.board import Board, Operator, Wire
from acsard.checkup.findings import SKIPPED_STEPS, Finding, StoppedError, WireLostError, motor_name
from acsard.checkup.motion import SHORT_MEASUREMENT_S
from acsard.checkup.motor_channels import (
    Channel,
    ask_which_wheel,
    channel,
    encoder_finding,
    stands,
    wheel_map,
)
from acsard.checkup.outcomes import TimingFinding
from acsard.checkup.restarts import Restart, RestartedError
from acsard.core.config.motion_rules import top_wheel_speed
from acsard.core.config.settings import Config, SafetyConfig
from acsard.core.formatting import many
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.values import NS_PER_S

LIFTED, QUITS = "lifted", "q"

CONFIRMATION = (
    "The wheels will turn one by one, then together. The tool commands 3 rad/s at most, and "
    "at the end {top:.0f} rad/s for some seconds, the highest speed of your limits; but a "
    "wheel whose encoder is dead or reversed can reach full speed for about a second. Lift the "
    "robot so that no wheel touches anything, keep a hand on the power switch, then type "
    f'"{LIFTED}". No wheel has turned yet; q or Ctrl-C quits at any time:'
)

# After an early end, the finding `SKIPPED_STEPS` lists the steps without a result, or the motors
# without one.
STEPS = (
    "baud rate", "identification", "reply form", "reply rate", "round trip", "checked link",
    "lost lines", "reply times", "motors", "trailing comma", "wheel map", "encoder counts",
    "least speed", "watchdog", "damaged lines", "top speed", "inputs",
)  # fmt: skip

# The first steps of the check, in order, each with a message for the operator.
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
    ("measuring when the replies arrive", reply_times.finding),
)

Step = Callable[[], Finding | None]

# A step is repeated `LATE_AGAIN` times, all steps `LATE_MOST` times: else it could take four
# minutes.
LATE_AGAIN, LATE_MOST = 2, 8

# A longer stall ends the check, because the operator may have left. The first applies until all
# motors were seen to stand still.
STALL_S, ZEROS_STALL_S = 3.0, 5.0

# After a shorter stall, the lines show whether the step ran too late.
SHORT_STALL_S = 0.5

# The step with restart number `AGAIN` + 1, or restart number `MOST` in all, ends the check.
AGAIN, MOST = 1, 5


def run(
    wire: Wire,
    operator: Operator,
    config: Config,
    tell: Callable[[Finding], None],
    asleep_ns: Callable[[], int] = lambda: 0,
    *,
    fast: bool,
) -> None:
    """Check one microcontroller, and call `tell` with each finding as soon as it is known.

    `fast` says whether a person chose the highest speed: in the file, or in answer to
    `CONFIRMATION`.

    Only zeros are sent until the operator confirms that the wheels are lifted, and at the end.
    `asleep_ns` returns how long the computer has been suspended, which the clock of `wire` leaves
    out. Raises `KeyboardInterrupt` if the operator types `QUITS`, and `MendableError` if the port
    cannot be opened.
    """
    finding_names: set[str] = set()
    unjudged: set[str] = set()

    def once(finding: Finding | None) -> None:
        """Call `tell` with the first finding of each name, and with a later one that judges."""
        if finding is None:
            return
        judged = lateness.judged(finding)
        if finding.name not in finding_names or (judged and finding.name in unjudged):
            (unjudged.discard if judged else unjudged.add)(finding.name)
            finding_names.add(finding.name)
            tell(outcomes.plain(finding))

    why = ""
    all_restarts: list[Restart] = []
    board = Board(wire, config.mcu, config.rate_hz, config.feedback.encoders)
    try:
        with board:
            board.zeros()
            top = top_wheel_speed(config)
            if operator.ask(CONFIRMATION.format(top=max(3, top)), (LIFTED,)) != LIFTED:
                raise StoppedError(outcomes.find("wheels: not lifted"))
            watched = _Watched(operator, board, asleep_ns)
            board.abort_check = watched.check_operator
            radius = config.drive.wheel_radius
            _Steps(board, watched, once, all_restarts, radius, top, fast).all(config.safety)
    except StoppedError as end:
        once(end.finding)
        why = f"the check ended early: {end.finding.name}"
    except WireLostError as lost:
        once(outcomes.find("serial line: lost", error=lost))
        why = "the check ended early: the serial line was lost"
    if all_restarts:
        once(restarts.finding(board.mcu, all_restarts))
    motors = [motor_name(board.mcu, n) for n in range(len(board.letters))]
    names = ["motors"] if finding_names.isdisjoint(motors) else motors
    steps = [name for step in STEPS for name in (names if step == "motors" else [step])]
    rest = [step for step in steps if step not in finding_names]
    if why and rest:
        left = f"{why}; not finished: {', '.join(rest)}"
        tell(Finding(SKIPPED_STEPS, "SKIPPED", many(len(rest), "step"), left))


class _Watched:
    def __init__(self, operator: Operator, board: Board, asleep_ns: Callable[[], int]) -> None:
        self.doing, self.keys = operator.doing, operator.keys
        self._operator, self._board, self._asleep_ns = operator, board, asleep_ns
        # Time of the last call of `check_operator` or of the operator's last answer.
        self._ran_s = self._now_s()

    def _now_s(self) -> float:
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
        if stalled_s > SHORT_STALL_S:
            # `Board` measures neither the time for which the computer was suspended, nor the time
            # for which the terminal did not accept the tool's output.
            self._board.lateness.record(stalled_s, self._board.now_s)
        if QUITS in self.keys(0.0).lower():
            raise KeyboardInterrupt


class _Steps:
    def __init__(
        self,
        board: Board,
        operator: Operator,
        tell: Callable[[Finding | None], None],
        seen: list[Restart],
        radius: float,
        top: float,
        fast: bool,
    ) -> None:
        self._board, self._operator, self._tell = board, operator, tell
        self._radius, self._top, self._fast = radius, top, fast
        # All restarts of the board so far. The caller of `all` reads this list afterward.
        self._all_restarts = seen
        self._channels: list[Channel] = []
        self._late_left = LATE_MOST

    def all(self, safety: SafetyConfig) -> None:
        board, operator = self._board, self._operator
        for doing, step in SILENT_STEPS:
            self._measure(doing, partial(step, board))
        self._take("", self._stop_and_arm)
        self._turn_motors()
        channels = self._channels
        self._take("", lambda: dialect.comma(board, channels[-1].kind))
        self._take("", board.repeats.finding)
        self._take("", lambda: wheel_map(board.mcu, channels))
        right = [channel.motor for channel in channels if channel.kind in ("right", "off")]
        self._take("", lambda: encoder_counts.finding(board, right))
        # If no motor is right, those that turn at all show the watchdog too.
        turned = right or [channel.motor for channel in channels if channel.turns]
        if board.repeats.encoders:
            rising = "the motors turn slowly, then faster"
            self._measure(rising, lambda: least_speed.finding(board, turned, self._radius))
        together = "the motors turn, then this computer sends nothing, perhaps several times"
        stops = self._measure(together, lambda: watchdog.finding(board, turned))
        broken = "sending damaged lines; a motor that turns now is a fault"
        obeyed = self._measure(broken, lambda: damage.finding(board, turned))
        if board.repeats.encoders:
            # Only sound motors: one whose encoder shows too little would turn far faster.
            refusal = self._refusal(stops, obeyed)
            rising = "" if refusal else f"the motors turn up to {self._top:.1f} rad/s"
            self._measure(
                rising, lambda: top_speed.finding(board, right, refusal, self._top, self._radius)
            )
        self._take("", lambda: inputs.finding(board, operator, safety))

    def _refusal(
        self, watchdog: Finding | None, damaged_lines: Finding | None
    ) -> outcomes.Outcome | None:
        if not _sound(watchdog):
            return "top speed: no watchdog"
        if not _sound(damaged_lines):
            return "top speed: damaged lines"
        return None if self._fast else "top speed: not chosen"

    def _stop_and_arm(self) -> None:
        self._board.stop_motors()
        self._board.armed = True

    def _turn_motors(self) -> None:
        # Wait with the findings of motors that do not turn until one turns: if none does, one cause
        # is more likely than several.
        still: list[Finding | None] = []
        try:
            for motor in range(len(self._board.letters)):
                self._take("", partial(self._turn, motor), still.append)
                while still and not all(map(stands, self._channels)):
                    self._tell(still.pop(0))
            if still:
                still = [outcomes.find("motors: still")]
        finally:
            for finding in still:
                self._tell(finding)

    def _turn(self, motor: int) -> Finding:
        board, operator, channels = self._board, self._operator, self._channels
        operator.doing(f"{motor_name(board.mcu, motor)} turns: briefly, then forward and back")

        def measure_motor() -> Finding:
            channels[motor:] = [channel(board, motor)]
            return encoder_finding(board.mcu, channels[motor])

        finding = self._in_time(measure_motor)
        late = finding if finding is not None and not lateness.judged(finding) else None
        if late:
            channels[motor] = structs.replace(channels[motor], judged=False)
        # A person sees which wheel turns, even if this computer was late.
        channels[motor] = ask_which_wheel(board, operator, channels[motor])
        return late or encoder_finding(board.mcu, channels[motor])

    def _measure(self, doing: str, step: Step) -> Finding | None:
        return self._take(doing, partial(self._in_time, step))

    def _in_time(self, step: Step) -> Finding | None:
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
            if ends and board.armed and meanwhile_s < WATCHDOG_S:
                # The step has ended the check. So do not turn a motor again, even if the cause was
                # only a delay of this computer, unless that is as long as the silence of a board.
                finding, board.saved_results = late_finding, saved
                break
        else:
            finding, board.saved_results = late_finding, saved
        if finding is not None and ends:
            raise StoppedError(finding)
        return finding

    def _take(
        self, doing: str, step: Step, tell: Callable[[Finding | None], None] | None = None
    ) -> Finding | None:
        board, again = self._board, 0
        saved = board.saved_results
        while True:
            try:
                if again:
                    self._come_back()
                if doing:
                    self._operator.doing(doing)
                finding = self._tried(step)
                (tell or self._tell)(finding)
                return finding
            except RestartedError as error:
                self._all_restarts.append(error.restart)
                again += 1
                if again > AGAIN or len(self._all_restarts) >= MOST:
                    raise StoppedError(restarts.finding(board.mcu, self._all_restarts)) from None
                board.saved_results = saved

    def _tried(self, step: Step) -> Finding | None:
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


def _sound(finding: Finding | None) -> bool:
    return finding is not None and lateness.judged(finding) and finding.verdict in ("PASS", "WARN")


def _ended(step: Step) -> tuple[Finding | None, bool]:
    try:
        return step(), False
    except StoppedError as error:
        return error.finding, True
