"""A session with a board in a simulated time, and a port that can be opened and closed."""

from __future__ import annotations

from acsard.core.codes import Reason
from acsard.core.config.settings import McuConfig
from acsard.core.link.checked_line import seal
from acsard.core.link.feedback import Line
from acsard.core.link.link_output import QUESTION_LINE, Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import GOOD_LINES
from acsard.core.link.session import McuSession
from acsard.core.values import AT_REST, NS_PER_S, Instant, Received, WheelSpeeds
from tests.vectors.lines import SEED_LINE, ZERO

MS = 1_000_000
WALL_NS = 1_800_000_000 * NS_PER_S
GOOD, BAD, STOP = SEED_LINE + b"\r\n", b"hello\r\n", ZERO + b"\r\n"
BOOTED = b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1\r\n"
PLAIN, CHECKED = McuConfig(), McuConfig(link_check="on")
SLOW = WheelSpeeds(1.0, 1.0, 1.0, 1.0)


class LinkBench:
    def __init__(self, mcu: McuConfig = PLAIN, longest_reply: float = 0.25) -> None:
        self.setup = LinkSetup.of(mcu, 100.0, longest_reply=longest_reply)
        self.session, self.out = McuSession(), Output()
        self.made: bytes | None = None  # the line that waits for the port
        self.speeds = SLOW  # in this line
        self.now_ns = self.made_ns = 1000 * MS
        self.opened, self.port_open = 0, False

    @property
    def now(self) -> Instant:
        return Instant(self.now_ns, self.now_ns + WALL_NS)

    @property
    def link(self) -> str:
        return self.session.link

    @property
    def why(self) -> Reason:
        return self.session.describe_link(self.setup)

    @property
    def names(self) -> list[str]:
        """The names of the last update's events."""
        return [event.name for event in self.session.events]

    def line(self, speeds: WheelSpeeds = SLOW) -> bytes | None:
        self.made_ns, self.speeds = self.now_ns, speeds
        self.made = self.session.line(self.setup, self.out, self.now_ns, speeds)
        return self.made

    def answer(self, line: bytes | None) -> bytes:
        """Return the checked reply to a line from the host."""
        assert line is not None
        return seal(GOOD, int(line.partition(b"#")[2][:2], 16))

    def update(self, left: bool, ms: float = 10, *reads: bytes) -> list[Line]:
        """Let time pass, then update the session with these reads.

        `left` says whether the port has sent the last line.
        """
        self.now_ns += int(ms * MS)
        received = tuple(Received(self.now, data) for data in reads)
        if self.made is not None:
            self._report(self.made, left)
        self.session.steps.begin(self.setup, self.now_ns)
        return self.session.update(
            self.setup, self.out, self.now, self.port_open, self.opened, received
        )

    def _report(self, line: bytes, left: bool) -> None:
        session, made_ns, self.made = self.session, self.made_ns, None
        if not left:
            self.out.dropped(made_ns, closed=session.link == "down", trip=False)
            return
        silent = session.silent(made_ns)
        self.out.wrote(
            self.setup, line, made_ns, made_ns, AT_REST, self.speeds, silent=silent, trip=False
        )
        if line == QUESTION_LINE:
            session.asks(made_ns)

    def wait(self, ms: float, *reads: bytes) -> list[Line]:
        """Update the session after `ms`.

        Before that, the stop and the question with which a session begins leave the port.
        """
        session = self.session
        if self.made is None and self.port_open and (not self.out.lines or session._echo.due):
            self.line()
        if self.made == QUESTION_LINE:
            reads = BOOTED, *reads
        return self.update(True, ms, *reads)

    def waits(self, count: int, *reads: bytes) -> str:
        for _ in range(count):
            self.wait(10, *reads)
        return self.link

    def talk(self, ms: int = 10, count: int = 1) -> list[Line]:
        """Send a line and receive its answer `ms` later, `count` times."""
        samples = []
        for _ in range(count):
            line = self.line()
            if line is None or line == QUESTION_LINE:
                samples += self.wait(ms)
            else:
                samples += self.wait(ms, self.answer(line) if b"#" in line else STOP)
        return samples

    def open(self) -> LinkBench:
        self.opened += 1
        self.port_open = True
        return self

    def close(self) -> LinkBench:
        self.port_open = False
        return self

    def up(self) -> LinkBench:
        """Open the port and feed good lines until the link is up."""
        self.open().wait(10)
        assert self.waits(1 + GOOD_LINES, GOOD) == "up"
        return self

    def checked(self) -> LinkBench:
        """Open the port and talk until the link is up and checked."""
        self.open().wait(10)
        self.talk(count=3)
        assert (self.link, self.session.check(self.setup)) == ("up", "checked")
        return self

    def echoed(self, speed: float, count: int, board: bytes = b"") -> list[bytes]:
        """Return each line to the host 10 ms later, behind `board`, and return the lines."""
        lines = []
        for _ in range(count):
            line = self.line(WheelSpeeds(*[speed if self.link == "up" else 0.0] * 4))
            lines += [line] if line else []
            self.wait(10, board + (line or b""))
        return lines
