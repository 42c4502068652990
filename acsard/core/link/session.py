"""Exchanges lines with the board on one serial port, which may close, reopen and fall silent.

`mcu.link_check` declares whether lines are checked, and `link_state.py` decides whether the robot
may drive. After the first line of a session the daemon sends `QUESTION`, and only later lines bring
the link up, because a port that returns it has no board.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct, field

from acsard.core.codes import Reason, sentence
from acsard.core.formatting import printable_bytes
from acsard.core.link import link_diagnosis
from acsard.core.link.board_status import IDENTITY, STATUS, StatusReports
from acsard.core.link.checked_line import Reading, seal, unseal
from acsard.core.link.codec import FrameError
from acsard.core.link.echo_check import QUESTION, WINDOW_NS, EchoCheck
from acsard.core.link.feedback import Line, Timeline
from acsard.core.link.lines import LineReader
from acsard.core.link.link_diagnosis import SilenceDiagnosis
from acsard.core.link.link_output import QUESTION_LINE, Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import GOOD_LINES, WATCHDOG_NS, WATCHDOG_S, Link, LinkState
from acsard.core.link.pose_warning import PoseWarning
from acsard.core.link.step_times import StepTimes
from acsard.core.link.whole_counts import MAX_MISFIT
from acsard.core.values import (
    NS_PER_S,
    STILL,
    Event,
    EventName,
    Instant,
    Level,
    Ns,
    Received,
    WheelSpeeds,
)

NAMES: dict[LinkState, EventName] = {
    "down": "link_down",
    "booting": "link_booting",
    "up": "link_up",
    "stale": "link_stale",
}

# Without a line from the board or to the port, the MCU may have been reset: a new session begins.
LONG_GAP_NS = 1 * NS_PER_S

# Boot texts that say that the board has restarted, and why.
RESTARTS: dict[str | None, str] = {
    "received_brownout": " because its supply voltage was too low",
    "received_boot": "",
}

REMARKS = (b"!", QUESTION)  # begin of lines that are no reply

# Period of stops to a silent board: enough to wake it, and few collect in buffers.
SILENT_BOARD_PERIOD_NS = NS_PER_S // 10

NO_SAMPLES = (
    "mcu.encoder_counts is set, but the microcontroller does not send encoder counts, so a lost "
    "line loses distance"
)

# Why no reply is accepted.
Trouble = Literal["", "echo", "set_points", "no_checksum"]


class McuSession(Struct):
    """The exchange of lines with the MCU on one serial port.

    A session begins when the port is opened, when the MCU restarts, and after `LONG_GAP_NS`. The
    configuration is in `setup`.
    """

    link: LinkState = "down"  # after the last `update`; the robot drives only while `up`
    blocked: bool = False  # the open port's driver has accepted no line for `WATCHDOG_NS`
    good_lines: int = 0
    rejects: dict[str, int] = {}  # by reason
    steps: StepTimes = field(default_factory=StepTimes)
    status: StatusReports = field(default_factory=StatusReports)
    pose_warning: PoseWarning = field(default_factory=PoseWarning)
    _lines: LineReader = field(default_factory=LineReader)
    _echo: EchoCheck = field(default_factory=EchoCheck)
    _link: Link = field(default_factory=Link)
    _timeline: Timeline = field(default_factory=Timeline)
    _silence: SilenceDiagnosis = field(default_factory=SilenceDiagnosis)

    # Results of the last `update`.
    restarted: bool = False  # it began a new session
    reopened: bool = False
    until_ns: Ns = 0  # without bytes, `update` has nothing to do before then
    events: list[Event] = []  # for the log
    _rejected: dict[str, tuple[int, bytes]] = {}  # by reason: their number, and the last line
    _starting_over: bool = False

    _opened: int = 0
    _heard_ns: Ns | None = None
    _announced: tuple[LinkState, Trouble, bool] = ("down", "", False)
    # On a checked link that is not up: valid plain lines, and whether they are the trouble.
    _plain_lines: int = 0
    _unchecked: bool = False
    _sampled: bool = False  # the last good line had the board's counts
    _says_samples: bool = False  # a board without counts has not been reported yet

    def update(
        self,
        setup: LinkSetup,
        out: Output,
        now: Instant,
        port_open: bool,
        opened: int,
        received: tuple[Received, ...],
    ) -> list[Line]:
        """Process the state of the port and the received bytes, and return the good lines in order.

        `opened` counts the openings of the port.
        """
        written = self.blocked and out.blocked_since is None
        self.restarted = written and out.pause_ns >= LONG_GAP_NS
        self._starting_over = self.reopened = False
        if self.events:
            self.events = []
        if self.status.new or self.status.forgot:
            self.status.begin_update()
        now_ns, link, echo, until_ns = now.mono_ns, self._link, self._echo, 0
        feedback: list[Line] = []
        if not port_open or opened != self._opened:
            self._begin(setup, out, port_open, opened, now_ns)
        if port_open:
            if received:
                for piece in received:
                    feedback += self._decode(setup, out, piece)
                if more := self._lines.too_long - self.rejects.get("too_long", 0):
                    self._reject("too_long", more=more)
                    link.bad(setup.checked)
            steps = self.steps
            if steps.end_silence(setup, good=bool(feedback)):
                link.reset_silences()
            if (
                steps.step_s
                and steps.step_s < WATCHDOG_S
                and not setup.mcu.reply_period
                and not feedback
            ):
                # The board may have had nothing to answer. Before its watchdog has stopped the
                # motors, a stop without a ramp would only shake the robot. `Robot` makes such a
                # stop anyway after `WRITE_PAUSE_S`.
                link.wait(now_ns, setup.quiet_ns)
            if (
                link.state == "up"
                and out.blocked_since is None
                and not (self.blocked or echo.trouble)
                and self.status.up_ns is None
            ):
                until_ns = min(link.silent_ns + 1, echo.since_ns + WINDOW_NS)
            if now_ns >= until_ns:
                self._decide_link(setup, out, now_ns)
        self.until_ns = until_ns
        if feedback and (
            self.good_lines >= self.pose_warning.due_lines or self._timeline.counts_check.differs
        ):
            self._warn_of_pose(setup)
        if self._rejected:
            self._announce_rejects()
        if now_ns >= until_ns and (link.state, self._trouble, self.blocked) != self._announced:
            self._announce(setup)
        return feedback

    def line(self, setup: LinkSetup, out: Output, now_ns: Ns, speeds: WheelSpeeds) -> bytes | None:
        """Return the line that commands `speeds`, or None if no line is due.

        It is a stop, whatever `speeds` is, while the board does not answer. The first of these is
        due immediately, because the board may still execute the previous line. `QUESTION` takes
        the place of a line.
        """
        if self._echo.due and out.lines and (speeds != STILL or not out.moves(setup)):
            return QUESTION_LINE  # but not instead of the line that stops the wheels
        if now_ns > self._link.silent_ns:
            if out.stop_ns is not None and now_ns - out.stop_ns < SILENT_BOARD_PERIOD_NS:
                return None
            speeds = STILL
        line = setup.codec.stop if speeds == STILL else setup.codec.encode(speeds)
        if not setup.checked or not out.lines:  # the port begins with a plain stop
            return line
        return seal(line, out.next_number(), setup.letters)

    def silent(self, now_ns: Ns) -> bool:
        """Return whether the last good line of this session is older than `quiet_ns`, or missing.

        The result is False in the additional time that the board gets after a late control step.
        """
        return self._link.silent(now_ns)

    def feedback_age_s(self, now_ns: Ns) -> float | None:
        """Return the time since the last good line of any session; None before the first one."""
        return None if self._heard_ns is None else (now_ns - self._heard_ns) / NS_PER_S

    def describe_link(self, setup: LinkSetup, port_trouble: str = "") -> Reason:
        """Return a sentence about the link; `port_trouble` says why the port is closed."""
        if self.link == "down" and port_trouble:
            return sentence("port_trouble", trouble=port_trouble)
        if self.blocked:
            return link_diagnosis.PORT_BLOCKED
        if self._trouble and self.link in ("booting", "stale"):
            return sentence(self._trouble)
        return link_diagnosis.describe_link(setup, self._link, self._silence, self.steps)

    @property
    def _trouble(self) -> Trouble:
        return self._echo.trouble or ("no_checksum" if self._unchecked else "")

    def check(self, setup: LinkSetup) -> str:
        """Return the form of the lines, for `diagnostics`."""
        if not setup.checked:
            return "plain"
        return "checked with samples" if self._sampled else "checked"

    @property
    def coarse_lines(self) -> int:
        """Lines of coarse encoders whose counts are not declared."""
        return self._timeline.coarse.lines

    def counts_figures(self, setup: LinkSetup) -> str:
        """Return the values of counts and speeds that contradict each other, for people."""
        check = self._timeline.counts_check
        return f" ({setup.mcu.wheels.names[check.wheel]}: {check.figures})" if check.differs else ""

    def encoder_counts(self, setup: LinkSetup) -> tuple[int, ...]:
        """Return the declared counts per turn of each wheel; 0 if the speeds contradict them."""
        agree = self._timeline.whole.misfit < MAX_MISFIT
        return (setup.mcu.encoder_counts if agree else 0,) * len(setup.codec.letters)

    def asks(self, at_ns: Ns) -> None:
        """Wait for the answer to the question; before the first one of a session no line counts.

        A later one takes no line away: a board may send so few that it would never have enough.
        """
        if not self._echo.asked:
            self._link.reset_good_lines()
        self._echo.asks(at_ns)

    # sessions

    def _begin(
        self, setup: LinkSetup, out: Output, port_open: bool, opened: int, now_ns: Ns
    ) -> None:
        self._link.apply("opened" if port_open else "closed")
        self.link = self._link.state
        self.restarted = self.reopened = opened != self._opened
        if self.reopened:
            self.status.reopen()
        self._opened = opened
        self.blocked = False
        out.reopen(now_ns, port_open)
        self._lines.clear()
        self._silence.forget()
        self._echo = EchoCheck()
        self._plain_lines, self._unchecked = 0, False
        self._says_samples = setup.mcu.wants_samples
        self._start_over(out)

    def _restart(self, out: Output, how: str) -> None:
        # `how` completes "the microcontroller ...".
        if self._link.state == "up":
            self.events.append(Event("mcu_restarted", f"the microcontroller {how}", "warning"))
        self._link.apply("restarted")
        self.restarted = self._starting_over = True
        self._start_over(out)

    def _start_over(self, out: Output) -> None:
        self._timeline.forget()
        out.restart()
        self._echo.restart()

    def _decide_link(self, setup: LinkSetup, out: Output, now_ns: Ns) -> None:
        link, since_ns = self._link, out.blocked_since
        if since_ns is None:
            self.blocked = False
        elif now_ns - since_ns > WATCHDOG_NS and not self.steps.step_s:
            # In a late step, the last written line is old because this computer did not run.
            self.blocked = True
        if self.blocked:
            link.apply("blocked")
        # The arbiter must see a lost link first.
        echo, was_up = self._echo, link.state == "up"
        if now_ns - echo.since_ns >= WINDOW_NS:
            echo.end_window(now_ns, out.count, moving=was_up, encoders=setup.encoders)
        if echo.trouble:
            link.apply("repeated")
        held = self._starting_over or not echo.asked or echo.trouble
        if link.state != "up" or now_ns > link.silent_ns:
            link.decide_state(now_ns, may_rise=not held, checked=setup.checked)
        self.link, up = link.state, link.state == "up"
        if self.status.up_ns is not None:  # else nothing is to be forgotten
            self.status.forget_other_board(now_ns, up, late=self.steps.step_s > 0.0)
        if up or self.blocked:
            if self.blocked or not was_up:  # the diagnosis of a link that stays up is empty
                self._silence.forget()
        elif self._silence.diagnose(now_ns, self.steps.step_s):
            # The board may answer only plain lines, such as the first one after the opening.
            self._unchecked = self._unchecked or self._plain_lines > 0
            why = self.describe_link(setup)
            self.events.append(Event(NAMES[self.link], why.text, "warning", code=why.code))

    def _reject(self, reason: str, line: bytes = b"", more: int = 1) -> None:
        self.rejects[reason] = self.rejects.get(reason, 0) + more
        before, _ = self._rejected.get(reason, (0, b""))
        self._rejected[reason] = (before + more, line)

    def _announce_rejects(self) -> None:
        # After noise on the cable, an event for each line would take too much time.
        for reason, (count, line) in self._rejected.items():
            text = f"{line[:60]!r}" if line else ""
            self.events.append(
                Event("lines_rejected", text, "warning", kind=reason, count=count, news=False)
            )
        self._rejected.clear()

    def _warn_of_pose(self, setup: LinkSetup) -> None:
        changed = self.pose_warning.choose_code(setup, self._timeline, self.good_lines)
        if changed and self.pose_warning.code:
            why = sentence(self.pose_warning.code)
            text = why.text + self.counts_figures(setup)
            self.events.append(Event("pose_doubtful", text, "warning", code=why.code))

    def _announce(self, setup: LinkSetup) -> None:
        link, trouble, before = self._link.state, self._trouble, self._announced
        self._announced = (link, trouble, self.blocked)
        if link != before[0] or self.blocked > before[2]:
            plain = not (self.blocked or self._link.damaged or trouble)
            why = (
                link_diagnosis.describe_state(setup, link, self.steps)
                if plain
                else self.describe_link(setup)
            )
            good = link in ("up", "booting") and not self.blocked
            level: Level = "info" if good else "warning"
            self.events.append(Event(NAMES[link], why.text, level, code=why.code))
        if trouble and trouble != before[1]:
            why = sentence(trouble)
            self.events.append(Event("link_check", why.text, "error", code=why.code))

    # lines

    def _decode(self, setup: LinkSetup, out: Output, piece: Received) -> list[Line]:
        lines, timeline, feedback = self._lines.feed(piece.data), self._timeline, []
        link, data = self._link, piece.data
        for line, _ in lines:
            if line.startswith(REMARKS):
                lines = self._without_remarks(setup, out, lines, piece.at.mono_ns)
                data = b"\n".join([line for line, _ in lines])
                break
        if link.state != "up":
            self._silence.now.take(data)
        if lines:
            timeline.process_read(setup, out, piece.at, len(piece.data), len(lines), lines[-1][1])
        for line, following in lines:
            self._echo.received(line, out.lines)
            reply = self._line(setup, out, line, piece.at, following)
            if reply is None:
                timeline.skip_bad(setup, out)
            else:
                feedback.append(reply)
            if link.state != "up":
                self._silence.now.line(line, reply is not None, setup.codec.letters)
        return feedback

    def _without_remarks(
        self, setup: LinkSetup, out: Output, lines: list[tuple[bytes, int]], at_ns: Ns
    ) -> list[tuple[bytes, int]]:
        # A remark is not a reply, so it is not used for the sample times and the link.
        for line, _ in lines:
            if line.startswith(REMARKS):
                self._take_remark(setup, out, line, at_ns)
        return [each for each in lines if not each[0].startswith(REMARKS)]

    def _take_remark(self, setup: LinkSetup, out: Output, line: bytes, at_ns: Ns) -> None:
        if line.startswith(STATUS):
            self._take_status(setup, line, at_ns)
            return
        if line == QUESTION:
            self._reject("echo")
            self._echo.returned(at_ns)
            return
        if not line.startswith(IDENTITY):
            self._reject("malformed", line)
            self._link.bad(setup.checked)
            return
        self._silence.now.identified = self._link.state != "up"
        if not self._echo.named(at_ns):
            self._restart(
                out, f"has restarted and sent its start line: {line.decode('ascii', 'replace')}"
            )

    def _take_status(self, setup: LinkSetup, line: bytes, at_ns: Ns) -> None:
        try:
            self.status.take(line, setup.checked, at_ns)
        except FrameError as error:
            self._reject(error.reason, line)
            return
        if self._link.state != "up":
            self._silence.now.statuses += 1

    def _line(
        self, setup: LinkSetup, out: Output, line: bytes, read_at: Instant, following: int
    ) -> Line | None:
        if self._echo.trouble:
            self._reject(self._echo.trouble)
            self._link.reset_good_lines()
            return None
        reading, asked_ns, at_ns, timeline = None, None, read_at.mono_ns, self._timeline
        try:
            if setup.checked:
                reply = unseal(line, len(setup.codec.letters))
                speeds, reading = setup.codec.decode(reply.plain), reply.reading
                asked_ns = out.find(reply, at_ns)
            else:
                speeds = setup.codec.decode(line)
        except FrameError as error:
            self._refuse(setup, out, line, error)
            return None
        self._echo.measured(speeds, out.set_points, setup.command_interval_ns / NS_PER_S)
        self.good_lines += 1
        before_ns, self._heard_ns = self._heard_ns, at_ns
        if before_ns is not None and at_ns - before_ns >= LONG_GAP_NS:
            self.restarted = True  # even if an earlier update has already reported a restart
        since_ns = self._link.good(at_ns, setup.quiet_ns)
        silent = since_ns is None or since_ns > setup.quiet_ns
        length = len(line) + 2
        waited_ns = self.steps.waited_ns
        placed = timeline.place(
            setup, out, speeds, reading, following, length, silent, asked_ns, waited_ns
        )
        if setup.checked:
            self._check_samples(out, reading)
        return placed

    def _refuse(self, setup: LinkSetup, out: Output, line: bytes, error: FrameError) -> None:
        if (code := link_diagnosis.named(line)) in RESTARTS:
            text = printable_bytes(line, link_diagnosis.MAX_SHOWN_BYTES)
            self._restart(out, f"has restarted{RESTARTS[code]}: it sent `{text}`")
        if error.reason == "repeated":
            self.rejects["repeated"] = self.rejects.get("repeated", 0) + 1
        elif (
            error.reason != "without_crc"
            or self._link.state == "up"
            or not self._plain(setup, line)
        ):
            self._reject(error.reason, line)
            self._link.bad(setup.checked)

    def _check_samples(self, out: Output, reading: Reading | None) -> None:
        # Of a good line on a checked link.
        self._plain_lines, self._unchecked = 0, False
        self._sampled = reading is not None
        if self._says_samples and not self._sampled:
            self._says_samples = False
            self.events.append(Event("link_check", NO_SAMPLES, "warning"))
        if reading is not None:
            if more := self._timeline.leaps - self.rejects.get("count_leap", 0):
                self._reject("count_leap", more=more)
            if self._timeline.restarted:
                self._restart(out, "has restarted: its clock went back")

    def _plain(self, setup: LinkSetup, line: bytes) -> bool:
        # On a checked link that is not up. The first one answers the stop after the opening.
        try:
            setup.codec.decode(line)
        except FrameError:
            return False
        self._plain_lines += 1
        self._unchecked = self._unchecked or self._plain_lines >= GOOD_LINES
        return True
