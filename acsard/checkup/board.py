"""Sends speeds to the board that is checked, and stores its replies.

A step of the check sends lines through a `Board`, and evaluates the stored `replies`. Speeds are
those of the motors by their letters, because the check must find out which wheel a motor turns. A
step ends at once if a motor runs away, if the board falls silent (both end the check), or if it
restarts. The caller implements `Wire` (the serial line) and `Operator` (the person).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import ceil
from typing import Protocol

from acsard.checkup import motion, outcomes
from acsard.checkup.findings import StoppedError, WireLostError, motor_name, motor_names
from acsard.checkup.lateness import HostDelays
from acsard.checkup.motion import SPEED, BoardReply
from acsard.checkup.repeats import Repeats
from acsard.checkup.restarts import RestartedError, Restarts
from acsard.core.config.settings import McuConfig
from acsard.core.config.wire_time import line_bytes, wire_ns
from acsard.core.link.board_status import STATUS, decode_status
from acsard.core.link.checked_line import SAMPLE_REQUEST, SEQUENCES, seal, unseal
from acsard.core.link.codec import FrameError, MotorCodec, Motors
from acsard.core.link.lines import LineReader
from acsard.core.link.link_diagnosis import Traffic
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.values import NS_PER_S


class Wire(Protocol):
    """Interface of the serial connection between this computer and the board."""

    def open(self, baud_rate: int) -> None:
        """Open the connection at this baud rate, or change the baud rate of an open one.

        Raises `MendableError` if the port cannot be opened, and `WireLostError` if it is lost.
        """

    def close(self) -> None:
        """Send the bytes that are still in the driver's buffer, then close the connection."""

    def now_ns(self) -> int:
        """Return the present monotonic time, ns."""

    def send(self, data: bytes) -> None:
        """Send bytes now. Raises `WireLostError` if the connection is lost."""

    def late_ns(self) -> int:
        """Return how long a simulated board waited for a processor since the last call.

        It is a program on this computer. The result is 0 for a real board.
        """

    def listen(self, until_ns: int) -> Sequence[tuple[int, bytes]]:
        """Receive until the time `until_ns`; return pieces: time of arrival, ns, and bytes.

        Raises `WireLostError` if the connection is lost.
        """


class Operator(Protocol):
    """Interface through which the check informs and asks the operator, a person near the robot."""

    def doing(self, text: str) -> None:
        """Show the current activity. `text` remains visible until the next call of this method."""

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """Ask a question. Return one of `answers`, or None if no operator can answer."""

    def keys(self, wait_s: float) -> str:
        """Return the keys that the operator has typed; wait up to `wait_s` s for the first one."""


def _nothing() -> None:
    pass


MIN_WAIT_S = 0.001  # shortest remaining time in which `Board.drive` sends one more line

# Longest wait of `Board.listen` without a break. After each such wait, `listen` measures how late
# this computer runs the check.
BEAT_NS = int(motion.LINE_PERIOD_S * NS_PER_S)

FINAL_ZEROS = 5  # number of times that the check sends zero speeds at its end


# Results of earlier steps, which are restored before a step is repeated.
RESULT_FIELDS = ("comma", "latched", "sealed", "sampled", "own_clock", "gap_s", "paced", "lost")


class Board:
    """The board that is checked, with its replies and the results of the steps.

    The context manager opens the serial line, and sends zeros before it closes it. After a runaway
    it sends nothing, so that the board's watchdog can stop the motor.
    """

    def __init__(self, wire: Wire, mcu: McuConfig, rate_hz: float, encoders: bool = True) -> None:
        self.wire, self.rate_hz = wire, rate_hz
        self.take_motors(mcu)
        self.repeats = Repeats(encoders)
        # Whether the check has seen all motors stand still. From then on, the check ends if a motor
        # runs away or if the board falls silent.
        self.armed = False
        # Ends the check by an exception: called before each line that turns a motor, and in
        # `listen` at least every `BEAT_NS`, but not while the last zeros are sent.
        self.abort_check: Callable[[], object] = _nothing
        # Results of the steps
        self.baud_rate: int = mcu.baud_rate
        self.comma = mcu.trailing_comma  # whether the lines to the board end with a comma
        # Whether the last motor stops only if the line of zeros has the right ending: a comma if
        # `comma` is true, else no comma.
        self.latched = False
        # `sealed`: whether each line has a checksum. `sampled`: whether each line to the board
        # requests a sample, that is the board's clock and encoder counts.
        self.sealed = self.sampled = False
        self.identity: dict[str, str] = {}
        # Whether the board sends its replies by its own clock, and not as answers to lines.
        self.own_clock = False
        self.gap_s = mcu.reply_period  # mean time from one reply to the next while lines are sent
        # Whether the reply rate has been measured, so that `own_clock` and `gap_s` are known.
        self.paced = False
        # Fraction of lines that are lost or damaged, to the board and from the board together.
        self.lost = 0.0
        # Received lines
        self.replies: list[BoardReply] = []
        # Received lines that are neither valid replies nor status lines.
        self.unrecognized_lines: list[bytes] = []
        # Valid replies in a row: the last ones, and the most.
        self.good_run = self.longest_run = 0
        # Maps the number of each input to whether the board last reported it as pressed.
        self.inputs: dict[int, bool] = {}
        # Statistics of all bytes and lines received since the last call of `open`.
        self.traffic = Traffic()
        self.sent_lines = 0
        self.sent_s = 0.0
        # The delays by which this computer ran the check too late. If the board is simulated on
        # this computer, the delays of the simulator are included.
        self.lateness = HostDelays()
        # Whether a motor runs away, or keeps turning although zeros are sent. The check sends
        # nothing more in this case, so that the board's watchdog can stop the motor.
        self.runaway_seen = False
        # rad/s, above which a motor runs away
        self.most_speed = motion.RUNAWAY_SPEED

        # Time for which `drive` has sent lines since the last reply. If this computer is late, only
        # one line period of its delay counts, because a delay does not show a silent board.
        self._unanswered_s = 0.0
        self._listened_s = 0.0
        self._sequence = 0
        self._lines = LineReader()
        self.restarts = Restarts()

    def take_motors(self, mcu: McuConfig) -> None:
        """Send and understand lines of the motors in `mcu` from now on."""
        self.mcu = mcu
        self.letters = mcu.wheels.letters  # of the motors, which have the numbers from 0 on
        self.zero = self._commanded = self.only(())
        self._codecs = {comma: MotorCodec(self.letters, comma) for comma in (False, True)}

    def open(self, baud_rate: int) -> None:
        """Open the port at this baud rate, or change its rate. Discard all received lines."""
        self.wire.open(baud_rate)
        self.baud_rate, self.traffic = baud_rate, Traffic()
        self.forget()

    def forget(self) -> None:
        """Discard all received lines and detected restarts, but not the results of the steps."""
        self.restarts, self._unanswered_s = Restarts(), 0.0
        for buffer in (self._lines, self.replies, self.unrecognized_lines):
            buffer.clear()

    def __enter__(self) -> Board:
        self.open(self.mcu.baud_rate)
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self._farewell()
        except BaseException:
            # A signal interrupted the first call, but zeros must still be sent.
            self._farewell()
            raise
        finally:
            self.wire.close()

    def _farewell(self) -> None:
        # If an encoder is reversed, the firmware's speed control may make the motor run away even
        # when zeros are sent. Each further line would keep the watchdog from stopping the motor.
        self.armed, self.restarts.watched, self.abort_check = False, False, _nothing
        try:
            for _ in range(FINAL_ZEROS):
                if self.runaway_seen:
                    break
                self.zeros()
                self.listen(2 * self.period_s)
                self.runaway_seen = motion.runaway(self.replies) is not None
        except WireLostError:
            # No line reaches the board any more, so its own watchdog must stop the motors.
            pass

    @property
    def example(self) -> str:
        """A reply in the documented form, for texts."""
        return self._codecs[False].stop.decode().strip()

    @property
    def now_s(self) -> float:
        """Present monotonic time, s."""
        return self.wire.now_ns() / NS_PER_S

    @property
    def saved_results(self) -> dict[str, object]:
        """The attributes in `RESULT_FIELDS`; assign an earlier mapping to restore them."""
        return {name: getattr(self, name) for name in RESULT_FIELDS}

    @saved_results.setter
    def saved_results(self, results: Mapping[str, object]) -> None:
        for name, value in results.items():
            setattr(self, name, value)

    @property
    def line_s(self) -> float:
        """Time for the transmission of the longest line, with a margin of 25 %, s."""
        longest = line_bytes(len(self.letters), True, self.sealed, self.sampled)
        return 1.25 * wire_ns(longest, self.baud_rate) / NS_PER_S

    @property
    def period_s(self) -> float:
        """Time from one sent line to the next, s. It is longer than usual on a slow wire."""
        return max(motion.LINE_PERIOD_S, self.line_s)

    # Sending

    def only(self, motors: Sequence[int], speed: float = SPEED) -> Motors:
        """Return the speeds that turn only `motors`, by their numbers, all at `speed` rad/s."""
        return tuple(speed if n in motors else 0.0 for n in range(len(self.letters)))

    def line(self, motors: Motors, comma: bool | None = None) -> bytes:
        """Return the line for the speeds `motors`; `comma` None means the value of `self.comma`."""
        line = self._codecs[self.comma if comma is None else comma].encode(motors)
        if not self.sealed:
            return line
        self._sequence = (self._sequence + 1) % SEQUENCES
        return seal(line, self._sequence, SAMPLE_REQUEST if self.sampled else b"")

    def send(self, motors: Motors, comma: bool | None = None) -> None:
        """Send one line for the speeds `motors`; `comma` None means the value of `self.comma`."""
        if any(motors):
            self.abort_check()
        turned, self._commanded = any(self._commanded), motors
        self.wire.send(self.line(motors, comma))
        self.sent_lines += 1
        self.sent_s = self.now_s
        if turned:
            self.lateness.record(self.sent_s - self._listened_s, self.sent_s)
        self.restarts.record_speeds(motors, self.sent_s)

    def zeros(self) -> None:
        """Send zeros in two lines, with and without a comma, and with a checksum if `sealed`.

        Some firmware stops the last motor only at one of the endings. A line end comes first, so
        that a partial line does not spoil the two.
        """
        self._commanded = self.zero
        plain = self._codecs[True].stop + self._codecs[False].stop
        self.wire.send(b"\r\n" + plain + (self.line(self.zero) if self.sealed else b""))
        self.restarts.record_speeds(self.zero, self.now_s)

    def comes_back(self) -> bool:
        """Send zeros until the board answers; return whether it does so within `motion.BOOT_S`."""
        before, end_s = len(self.replies), self.now_s + motion.BOOT_S
        while len(self.replies) == before:
            if self.now_s >= end_s:
                return False
            self.zeros()
            self.listen(self.period_s)
        return True

    def send_zero(self, wait_s: float = 0.0, comma: bool | None = None) -> None:
        """Send one line of zeros, then listen for `wait_s`, but at least for `period_s`."""
        self.send(self.zero, comma)
        self.listen(max(wait_s, self.period_s))

    def answers(
        self, lines: int, wait_s: float, comma: bool | None = None
    ) -> list[tuple[float, BoardReply]]:
        """Send lines of zeros. Return the delay, s, and the first reply for each answered line.

        `wait_s` is how long to listen after each line, at least 1.5 times `period_s`.
        """
        # Receive the replies to earlier lines now, so that they are not taken for replies to these.
        self.listen(max(motion.SHORT_MEASUREMENT_S / 4, wait_s))
        pairs: list[tuple[float, BoardReply]] = []
        for _ in range(lines):
            self.send_zero(max(wait_s, 1.5 * self.period_s), comma)
            first = motion.since(self.replies, self.sent_s)[:1]
            pairs += [(reply.at_s - self.sent_s, reply) for reply in first]
        return pairs

    def drive(self, motors: Motors, seconds: float, period_s: float = 0.0) -> list[BoardReply]:
        """Send lines with the speeds `motors` for `seconds` s, and return the replies.

        Raises `StoppedError` if the armed board falls silent, because a motor could then run away
        unnoticed, and the errors of `listen`.
        """
        period_s = period_s or self.period_s
        end_s = self.now_s + seconds
        replies: list[BoardReply] = []
        while (began_s := self.now_s) < end_s - MIN_WAIT_S:
            self.send(motors)
            answers = self.listen(min(period_s, end_s - began_s))
            took_s = self.now_s - began_s
            self._unanswered_s += 0.0 if answers else min(took_s, period_s)
            if self.armed and self._unanswered_s > self._max_silence_s:
                self.zeros()
                raise self._silence(motors, self._unanswered_s)
            replies += answers
        return replies

    @property
    def _max_silence_s(self) -> float:
        return WATCHDOG_S + 4 * self.gap_s

    def _silence(self, motors: Motors, seconds: float) -> StoppedError:
        turned = [motor for motor, speed in enumerate(motors) if speed]
        outcome: outcomes.Outcome = "link: stops" if turned else "link: stops at zeros"
        names = motor_names(self.mcu, turned)
        # A delay of this computer that is much shorter than the silence cannot cause it.
        beyond_s = seconds - self._max_silence_s
        finding = outcomes.find(outcome, motors=names, seconds=seconds, margin_s=beyond_s)
        return StoppedError(finding)

    def stop_and_be_silent(self, silent_s: float) -> None:
        """Send zeros once, then nothing for `silent_s`, in which the watchdog can act."""
        self.zeros()
        self.listen(silent_s)

    # Receiving

    def listen(self, seconds: float) -> list[BoardReply]:
        """Receive for `seconds` s, and return the replies of this time.

        Raises `RestartedError` if the board restarts, and `StoppedError` if a motor of the armed
        board runs away.
        """
        end_ns = self.wire.now_ns() + ceil(seconds * NS_PER_S)
        if self.now_s - self._listened_s > BEAT_NS / NS_PER_S:
            # A delay of a simulated board before this call does not count, because nothing was
            # measured then.
            self.wire.late_ns()
        replies: list[BoardReply] = []
        self.abort_check()
        while True:
            until_ns = min(end_ns, self.wire.now_ns() + BEAT_NS)
            replies += self._receive(until_ns)
            now_ns = self.wire.now_ns()
            self._listened_s = now_ns / NS_PER_S
            late_ns = max(now_ns - until_ns, self.wire.late_ns())
            self.lateness.record(late_ns / NS_PER_S, self._listened_s)
            self.abort_check()
            if now_ns >= end_ns:
                return replies

    def _receive(self, until_ns: int) -> list[BoardReply]:
        new_replies = []
        for at_ns, data in self.wire.listen(until_ns):
            self.traffic.take(data)
            for line, following in self._lines.feed(data):
                if line.startswith(STATUS):
                    self.traffic.statuses += 1
                    self._take_status(line)
                    continue
                at_s = (at_ns - wire_ns(following, self.baud_rate)) / NS_PER_S
                reply = self._reply(line, at_s)
                self.traffic.line(line, reply is not None, self.letters)
                self.good_run = self.good_run + 1 if reply is not None else 0
                self.longest_run = max(self.longest_run, self.good_run)
                if restart := self.restarts.check_line(line, at_s, reply):
                    raise RestartedError(restart)
                if reply is not None:
                    new_replies.append(reply)
        self.replies += new_replies
        if new_replies:
            self._unanswered_s = 0.0
            if self.armed:
                self._guard()
        return new_replies

    def _take_status(self, line: bytes) -> None:
        try:
            status = decode_status(line, self.sealed)
        except FrameError:
            return
        if status.estop is not None:
            self.inputs[0] = status.estop
        if status.bumpers is not None:
            estop = {0: self.inputs[0]} if 0 in self.inputs else {}
            self.inputs = estop | dict(enumerate(status.bumpers, 1))

    def _reply(self, line: bytes, at_s: float) -> BoardReply | None:
        try:
            plain, reading = line, None
            if self.sealed or b"#" in line:
                checked = unseal(line, len(self.letters))
                plain, reading = checked.plain, checked.reading
            return BoardReply(at_s, self._codecs[False].decode(plain), line, reading)
        except FrameError:
            self.unrecognized_lines.append(line)
            return None

    @property
    def silent_s(self) -> float:
        """Time since the last reply, s; 0 before the first one and after a runaway.

        After a runaway the check must send nothing, and so must not wait for an answer.
        """
        return self.now_s - self.replies[-1].at_s if self.replies and not self.runaway_seen else 0.0

    def _guard(self) -> None:
        runaway = motion.runaway(self.replies, self.most_speed)
        if runaway is None:
            return
        motor, speed = runaway
        commanded = self._commanded[motor]
        self._abandon()
        finding = outcomes.find(
            "runaway: against" if commanded * speed < 0 else "runaway: along",
            motor=motor_name(self.mcu, motor),
            letter=self.letters[motor],
            told=commanded,
            seen=speed,
            most=self.most_speed,
        )
        raise StoppedError(finding)

    def _abandon(self) -> None:
        self.runaway_seen = True
        self.zeros()

    # Standing still

    def stop_motors(self) -> None:
        """Send zeros until all motors stand still.

        If a motor does not stop in time, also send zeros with the other line ending. If the last
        motor alone had kept its speed, and stops now, use that ending from now on. Raises
        `StoppedError` if a motor keeps turning, or if the board falls silent.
        """
        began_s = self.now_s
        if self.settles(self.comma):
            return
        turning = motion.turning(self.replies, self.now_s)
        runs_on = turning == [len(self.letters) - 1] and not self._slows()
        silent = self._unheard_s(began_s) > self._max_silence_s
        if self.settles(not self.comma):
            if runs_on:
                self.latched, self.comma = True, not self.comma
            return
        # A board may ignore lines with the other ending. So a silence counts only if the board
        # answered neither ending.
        if silent and (seconds := self._unheard_s(began_s)) > self._max_silence_s:
            raise self._silence(self.zero, seconds)
        self._abandon()
        turning = motion.turning(self.replies, self.now_s) or turning
        motors = motor_names(self.mcu, turning, ", ") or "a motor"
        seconds = round(self.now_s - began_s, 1)
        raise StoppedError(outcomes.find("stop: turns", motors=motors, seconds=seconds))

    def _unheard_s(self, since_s: float) -> float:
        return self.now_s - max([since_s, *(reply.at_s for reply in self.replies[-1:])])

    def settles(self, comma: bool) -> bool:
        """Send zeros until all motors stand still; return whether they do so in time."""
        # The motors stand still if the last two replies since the call report no motion, and if no
        # earlier reply shows that a motor with a coarse encoder may still turn (`motion.turning`).
        began_s = self.now_s
        while True:
            last = motion.since(self.replies[-2:], began_s)
            is_moving = any(motion.moving(reply.motors, motion.STANDING_SPEED) for reply in last)
            if len(last) == 2 and not (is_moving or motion.turning(self.replies, self.now_s)):
                self.most_speed = motion.RUNAWAY_SPEED
                return True
            patience_s = motion.SLOWING_TIMEOUT_S if self._slows() else motion.MOTOR_TIMEOUT_S
            if self.now_s - began_s >= patience_s:
                return False
            self.send_zero(comma=comma)

    def _slows(self) -> bool:
        shares = motion.trend(self.replies, self.zero, self.now_s, self.gap_s)
        return min(shares) < motion.SLOWING_RATIO
