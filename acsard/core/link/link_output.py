"""Remembers what left the daemon for the board, and when.

`Robot.sent` calls `wrote` for a line that left and `dropped` for one that did not; nothing else
does. The question of `echo_check.py` moves nothing and is no line here, but its bytes left. A line
is open until its reply comes, or until it is given up. The guard has a memory of its own, because
it shares no code with what it checks, and the port knows until when the wire is busy.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.link.checked_line import SEQUENCES, Checked
from acsard.core.link.codec import FrameError
from acsard.core.link.echo_check import QUESTION
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import WATCHDOG_NS
from acsard.core.values import AT_REST, STILL, Motion, Ns, WheelSpeeds

QUESTION_LINE = QUESTION + b"\r\n"

# Far below 256 numbers: no reply can match the wrong line.
MAX_OPEN_LINES = 64

# A later reply is rejected: a board that got no other line has stopped the motors by then.
ANSWER_TIMEOUT_NS = WATCHDOG_NS

COMPARED_LINES = 8  # at 100 Hz, an echo within 70 ms is noticed


class OpenLine(Struct, frozen=True, gc=False):
    at_ns: Ns
    number: int | None  # of a checked line


class Output(Struct):
    # The last line: its motion, or rest since the motors have stopped without a line; the speeds of
    # its wheels, which may turn so until the next one; and the step that made it.
    motion: Motion = AT_REST
    speeds: WheelSpeeds = STILL
    made_ns: Ns = 0
    # The last bytes, or the opening or closing of the port; and the time before them without any.
    at_ns: Ns = 0
    pause_ns: Ns = 0
    blocked_since: Ns | None = None  # the port has accepted no line since
    stop_ns: Ns | None = None  # the last stop to a silent board was made
    rest_ns: Ns = 0  # the last command to move ended: zeros, or the board's watchdog
    # Since the opening of the port: the newest lines, with their ends, and the number of all.
    lines: list[bytes] = []
    set_points: list[WheelSpeeds] = []  # in `lines`
    count: int = 0
    # Of this session. An older reply, which is not expected any more, may still come.
    open: list[OpenLine] = []
    given_up: list[OpenLine] = []
    newest_ns: Ns = 0  # the last line that a board answers
    number: int = 0  # of the last checked line, which may not have left
    # Numbers of the last lines that were answered: a hub or a repeater may send a reply twice.
    answered: list[int] = []

    def wrote(
        self,
        setup: LinkSetup,
        line: bytes,
        at_ns: Ns,
        made_ns: Ns,
        motion: Motion,
        speeds: WheelSpeeds,
        *,
        silent: bool,
        trip: bool,
    ) -> None:
        """Record a line that left. `silent`: the board is, so the line is a stop or the question.

        `trip`: the line has zeros in place of one that the guard forbids, and the board is not
        expected to answer it.
        """
        self.pause_ns, self.at_ns, self.blocked_since = at_ns - self.at_ns, at_ns, None
        if line == QUESTION_LINE:
            self.stop_ns = None
            return
        if silent:
            self.stop_ns = made_ns
        self.motion, self.speeds, self.made_ns = motion, speeds, made_ns
        if trip:
            return
        lines, set_points = self.lines, self.set_points
        lines.append(line)
        set_points.append(speeds)
        if len(lines) > COMPARED_LINES:
            del lines[0], set_points[0]
        self.count += 1
        moves = not line.startswith(setup.rest)
        self.rest_ns = at_ns + WATCHDOG_NS if moves else min(self.rest_ns, at_ns)
        if not setup.period_ns:
            self.newest_ns = at_ns
            self.open.append(OpenLine(at_ns, self.number if b"#" in line else None))
            if len(self.open) > MAX_OPEN_LINES:
                self.give_up()

    def dropped(self, made_ns: Ns, *, closed: bool, trip: bool) -> None:
        """Record that no line left; `closed`: the port is, `trip`: the guard forbade the line."""
        if self.blocked_since is None:
            self.blocked_since = self.at_ns
        if closed:
            self.stop_ns = made_ns
        if trip:
            self.motion = AT_REST

    def moves(self, setup: LinkSetup) -> bool:
        """Return whether a speed in the last line is not zero."""
        return bool(self.lines) and not self.lines[-1].startswith(setup.rest)

    def reopen(self, now_ns: Ns, port_open: bool) -> None:
        self.at_ns, self.blocked_since = now_ns, None
        if port_open:
            self.stop_ns = None
        self.lines.clear()
        self.set_points.clear()
        self.count = 0

    def restart(self) -> None:
        """Expect no reply: the board may be another one."""
        self.open.clear()
        self.given_up.clear()
        self.newest_ns = 0

    def next_number(self) -> int:
        self.number = (self.number + 1) % SEQUENCES
        return self.number

    def give_up(self) -> None:
        """Give up the oldest open line: its reply is damaged, or does not come."""
        if self.open:
            self.given_up.append(self.open.pop(0))
            del self.given_up[:-MAX_OPEN_LINES]

    def take_back(self) -> None:
        """Open the line again that was given up last."""
        self.open.insert(0, self.given_up.pop())

    def find(self, reply: Checked, at_ns: Ns) -> Ns:
        """Return when the line that a correct reply answers was written.

        Raises `FrameError` if no line of the last `ANSWER_TIMEOUT_NS` has its number; "repeated" if
        the line was answered before, which is no damage.
        """
        for line in self.open:
            if line.number == reply.sequence and at_ns - line.at_ns <= ANSWER_TIMEOUT_NS:
                self.answered.append(reply.sequence)
                del self.answered[:-MAX_OPEN_LINES]
                return line.at_ns
        again = reply.sequence in self.answered
        raise FrameError("repeated" if again else "stale_sequence", reply.plain)
