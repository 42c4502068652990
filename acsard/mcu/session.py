"""Is the MCU there and in step: link state, sample times and gaps.

Takes what the port received, gives feedback with the time each line was complete, and puts the
lines that leave into the form in force. Decides when the link may carry motion (`up`), nothing
about motion itself.

    down     the port is closed
    booting  the port is open, or the MCU has restarted: fewer than GOOD_LINES good lines since
    up       lines come in time, and right if they are checked
    stale    it was up, then no good line for `quiet`, or BAD_LINES bad checked ones in a row

What a good line is `negotiation.py` says; while it asks, the link is not up.
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

from msgspec.structs import replace

from acsard.config.settings import FeedbackConfig, McuConfig
from acsard.mcu.check import Reading, unseal
from acsard.mcu.feedback import Feedback, Timeline
from acsard.mcu.frames import Codec, FrameError
from acsard.mcu.lines import LineReader
from acsard.mcu.negotiation import BLIND_PERIOD_NS, Negotiation
from acsard.values import NS_PER_S, STILL, Event, Instant, Received, WheelSpeeds

Link = Literal["down", "booting", "up", "stale"]

LINK_WORDS: dict[Link, str] = {
    "down": "the serial port is closed; it is being reopened",
    "booting": "the port is open; waiting for the microcontroller's first good lines",
    "up": "linked",
    "stale": "the microcontroller has fallen silent",
}

GOOD_LINES = 3
"""Good lines before the link is trusted: a board that just reset prints anything for a while."""

BAD_LINES = 5
"""Bad lines in a row after which a checked link is asked anew."""

LONG_GAP_NS = 1 * NS_PER_S
"""A feedback gap this long means the MCU may have been reset: commanders start over."""

IDENTITY = b"!acsard-mcu "
"""Begins the line with which an MCU of ours names itself when it has booted."""


class McuSession:
    """Follows one serial port through opens, losses and silences."""

    def __init__(
        self, mcu: McuConfig, rate_hz: float, wheel_speed: float = FeedbackConfig().wheel_speed
    ) -> None:
        """`wheel_speed` rad/s is the fastest a wheel can turn."""
        self.codec = Codec(mcu.wheels, mcu.trailing_comma)
        self._lines = LineReader()
        self.quiet_ns = int(NS_PER_S * max(0.1, 4 / rate_hz, 3 * mcu.reply_period))
        """Silence after which the link is stale, ns."""
        self.check = Negotiation(mcu, self.codec.stop)
        self._timeline = Timeline(mcu, self.codec, wheel_speed, self.quiet_ns)
        self._wants_samples = mcu.wants_samples
        self.link: Link = "down"
        self.rejects: Counter[str] = Counter()
        self.good_lines = 0
        self.sparse_s = 0.0
        """Time between the last two good lines when it was too long for the link, else 0."""
        self.restarted = False
        """The last `update` saw a new session with the MCU: reopened, it has started again, or it
        is back from a long gap."""
        self.events: list[Event] = []
        """What the last `update` found worth a log line."""
        self._starting_over = False
        self._told = ("down", self.check.in_force, False)
        self._opened = 0
        self._good_in_row = self._bad_in_row = 0
        self._heard_ns: int | None = None
        self._blind_ns = -BLIND_PERIOD_NS

    def update(
        self,
        now: Instant,
        port_open: bool,
        opened: int,
        received: tuple[Received, ...],
        unsent: bool = False,
    ) -> list[Feedback]:
        """Take the port's state and bytes; the good lines in order, and `link` brought up to date.

        `opened` counts the port's openings; a new number starts a new session. `unsent` says that
        the last line did not go out.
        """
        self.restarted, self._starting_over, self.events = False, False, []
        if unsent:
            self.check.unsent()
        if not port_open or opened != self._opened:
            self._begin(opened)
        feedback = []
        if not port_open:
            self.link = "down"
        else:
            for piece in received:
                for line, following in self._lines.feed(piece.data):
                    got = self._line(line, piece.at, following)
                    if got is not None:
                        feedback.append(got)
            if self._lines.too_long > self.rejects["too_long"]:
                self.rejects["too_long"] = self._lines.too_long
                self._bad()
            self._judge(now.mono_ns)
        self._tell()
        return feedback

    def line(self, now_ns: int, speeds: WheelSpeeds) -> bytes | None:
        """The line that says these speeds, in the form in force; None when none is due.

        To an MCU that does not answer, and while the check is asked for, only stops leave: the
        first one at once, for it may be doing what it was told last.
        """
        if self.check.state == "asking":
            return self.check.question(now_ns)
        if self.silent(now_ns):
            if now_ns - self._blind_ns < BLIND_PERIOD_NS:
                return None
            self._blind_ns, speeds = now_ns, STILL
        line = self.codec.stop if speeds == STILL else self.codec.encode(speeds)
        return self.check.seal(line, now_ns)

    def silent(self, now_ns: int) -> bool:
        """No good line within `quiet`, or none at all in this session."""
        return self._heard_ns is None or now_ns - self._heard_ns > self.quiet_ns

    def words(self, port_trouble: str = "") -> str:
        """How the link is, for people; `port_trouble` is why the port is closed."""
        if self.link == "down" and port_trouble:
            return port_trouble
        if self.link in ("booting", "stale"):
            if self.check.refused:
                return self.check.refusal()
            if self._damaged:
                return "the microcontroller's replies come damaged; asking it for the check again"
            if self.sparse_s:
                return (
                    f"the microcontroller's lines come {self.sparse_s:.2f} s apart; if it reports "
                    f"by its own clock, set mcu.reply_period = {self.sparse_s:.2f}"
                )
        return LINK_WORDS[self.link]

    @property
    def note(self) -> str:
        """Which check is in force, to go behind a reason; "" where none is wanted."""
        return "" if self.check.state == "off" else f" (serial lines {self.check.in_force})"

    @property
    def _damaged(self) -> bool:
        """The check is asked for because replies came damaged."""
        return self._bad_in_row >= BAD_LINES and self.check.state == "asking"

    # states

    def _begin(self, opened: int) -> None:
        self._lines.clear()
        self._good_in_row = self._bad_in_row = 0
        self._heard_ns = None
        self.sparse_s = 0.0
        self.link = "booting"
        self.restarted = opened != self._opened
        self._opened = opened
        self._timeline.forget()
        self.check.begin(fresh=True)

    def _restart(self, how: str) -> None:
        """The MCU has started again: its motors stand, and nobody may drive on as if they did."""
        if self.link == "up":
            self.events.append(Event("mcu_restarted", f"the microcontroller {how}", "warning"))
            self.link = "booting"
        self._good_in_row = 0
        self._heard_ns = None
        self.restarted = self._starting_over = True
        self._timeline.forget()
        self.check.begin()

    def _judge(self, now_ns: int) -> None:
        silent = self.silent(now_ns)
        if self.link == "up" and silent:
            self.link = "stale"
            self._good_in_row = 0
        elif self._good_in_row >= GOOD_LINES and not (silent or self._starting_over):
            # Never in the update that saw a restart: who drives has to see the link go first.
            self.link = "up"
        settled = self.check.state in ("plain", "checked")
        if settled and silent and now_ns - self.check.settled_ns > self.quiet_ns:
            self.check.begin()
        self.check.judge(now_ns)

    def _miss(self) -> None:
        """What came, or did not, is no reason to trust the link; a link that is up stays so."""
        if self.link != "up":
            self._good_in_row = 0

    def _bad(self) -> None:
        """A line came that is none; so many in a row that a check in force has to be asked anew."""
        self._miss()
        self._bad_in_row += 1
        if self._bad_in_row == BAD_LINES and self.check.state == "checked":
            if self.link == "up":
                self.link = "stale"
            self._good_in_row = 0
            self.check.begin()

    def _tell(self) -> None:
        """An event for the link and one for the check, when they have changed."""
        link, check = self.link, self.check
        before, self._told = self._told, (link, check.in_force, check.refused)
        if link != before[0]:
            level: Literal["info", "warning"] = "info" if link in ("up", "booting") else "warning"
            text = self.words() if self._damaged else LINK_WORDS[link]
            self.events.append(Event(f"link_{link}", text, level))
        if check.in_force != before[1] and check.state != "asking":
            fallen = check.state == "plain" or (self._wants_samples and not check.samples)
            text = f"the serial lines are {check.in_force}"
            if check.state == "plain":
                text += ": the microcontroller answers without a check"
            elif fallen:
                text += ": the microcontroller sends no counts"
            self.events.append(Event("link_check", text, "warning" if fallen else "info"))
        if check.refused and not before[2]:
            self.events.append(Event("link_check", check.refusal(), "error"))

    # lines

    def _line(self, line: bytes, read_at: Instant, following: int) -> Feedback | None:
        if line.startswith(IDENTITY):
            self._restart(f"has started: {line.decode('ascii', 'replace')}")
            return None
        if self.check.state == "asking" and self.check.echoed(line):
            self.rejects["echo"] += 1
            self._miss()
            return None
        try:
            if self.check.state == "checked" or (self.check.state == "asking" and b"#" in line):
                reply = unseal(line)
                speeds = self.codec.decode(reply.plain)
                asked_ns = self.check.answered(reply, read_at.mono_ns)
                feedback = self._good(speeds, reply.reading, read_at, following)
                return replace(feedback, asked_ns=asked_ns)
            speeds = self.codec.decode(line)
        except FrameError as error:
            self.rejects[error.reason] += 1
            self._bad()
            return None
        if self.check.state == "asking":
            self.check.heard_plain()
            return None
        return self._good(speeds, None, read_at, following)

    def _good(
        self, speeds: WheelSpeeds, reading: Reading | None, read_at: Instant, following: int
    ) -> Feedback:
        if self.silent(read_at.mono_ns):
            self._miss()
            if self._heard_ns is not None:
                self.sparse_s = (read_at.mono_ns - self._heard_ns) / NS_PER_S
        else:
            self.sparse_s = 0.0
        self.good_lines += 1
        self._good_in_row += 1
        self._bad_in_row = 0
        heard, self._heard_ns = self._heard_ns, read_at.mono_ns
        gap = heard is None or read_at.mono_ns - heard > self.quiet_ns
        if heard is not None and read_at.mono_ns - heard >= LONG_GAP_NS:
            self.restarted = True
        feedback = self._timeline.place(speeds, reading, read_at, following, gap)
        if self._timeline.leaps:
            self.rejects["count_leap"] = self._timeline.leaps
        if self._timeline.restarted:
            self._restart("has started again: its clock went back")
        doubt = self._timeline.doubt()
        if doubt:
            self.events.append(Event("encoder_counts", doubt, "warning"))
        return feedback
