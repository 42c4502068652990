"""Is the MCU there and in step: link state, sample times and gaps.

Takes what the port received, gives feedback with the time each line was complete. Decides when
the link may carry motion (`up`), nothing about motion itself.

    down     the port is closed
    booting  the port is open, fewer than GOOD_LINES good lines since
    up       lines come in time
    stale    it was up, then no good line for `quiet`
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

from msgspec import Struct

from acsard.mcu.frames import Codec, FrameError
from acsard.mcu.lines import LineReader
from acsard.mcu.wire import wire_ns
from acsard.settings import McuConfig
from acsard.values import NS_PER_S, Instant, Received, WheelSpeeds

Link = Literal["down", "booting", "up", "stale"]

LINK_WORDS: dict[Link, str] = {
    "down": "the serial port is closed; it is being reopened",
    "booting": "the port is open; waiting for the microcontroller's first good lines",
    "up": "linked",
    "stale": "the microcontroller has fallen silent",
}

GOOD_LINES = 3
"""Good lines before the link is trusted: a board that just reset prints anything for a while."""

LONG_GAP_NS = 1 * NS_PER_S
"""A feedback gap this long means the MCU may have been reset: commanders start over."""


class Feedback(Struct, frozen=True):
    """One good line: complete at `at`, `dt` s after the previous one.

    After a gap `dt` is 0 (how the robot moved in it is unknown) and `gap` is its length in s.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: float
    gap: float = 0.0


class McuSession:
    """Follows one serial port through opens, losses and silences."""

    def __init__(self, mcu: McuConfig, rate_hz: float) -> None:
        self.codec = Codec(mcu.wheels, mcu.trailing_comma)
        self._lines = LineReader()
        self._baud_rate = mcu.baud_rate
        self.quiet_ns = int(NS_PER_S * max(0.1, 4 / rate_hz, 3 * mcu.reply_period))
        """Silence after which the link is stale, ns."""
        self.link: Link = "down"
        self.rejects: Counter[str] = Counter()
        self.good_lines = 0
        self.sparse_s = 0.0
        """Time between the last two good lines when it was too long for the link, else 0."""
        self.restarted = False
        """The last `update` saw a new session with the MCU: reopened, or back from a long gap."""
        self._opened = 0
        self._good_in_row = 0
        self._last: Instant | None = None
        self._heard_ns: int | None = None

    def update(
        self, now: Instant, port_open: bool, opened: int, received: tuple[Received, ...]
    ) -> list[Feedback]:
        """Take the port's state and bytes; the good lines in order, and `link` brought up to date.

        `opened` counts the port's openings; a new number starts a new session.
        """
        self.restarted = False
        if not port_open or opened != self._opened:
            self._begin(opened)
        if not port_open:
            self.link = "down"
            return []
        feedback = []
        for piece in received:
            for line, following in self._lines.feed(piece.data):
                got = self._line(line, piece.at, following)
                if got is not None:
                    feedback.append(got)
        if self._lines.too_long > self.rejects["too_long"]:
            self.rejects["too_long"] = self._lines.too_long
            self._miss()
        self._judge(now)
        return feedback

    def silent(self, now_ns: int) -> bool:
        """No good line within `quiet`, or none at all in this session."""
        return self._heard_ns is None or now_ns - self._heard_ns > self.quiet_ns

    def words(self, port_trouble: str = "") -> str:
        """How the link is, for people; `port_trouble` is why the port is closed."""
        if self.link == "down" and port_trouble:
            return port_trouble
        if self.link in ("booting", "stale") and self.sparse_s:
            return (
                f"the microcontroller's lines come {self.sparse_s:.2f} s apart; if it reports "
                f"by its own clock, set mcu.reply_period = {self.sparse_s:.2f}"
            )
        return LINK_WORDS[self.link]

    def _begin(self, opened: int) -> None:
        self._lines.clear()
        self._good_in_row = 0
        self._heard_ns = None
        self.sparse_s = 0.0
        self.link = "booting"
        self.restarted = opened != self._opened
        self._opened = opened

    def _judge(self, now: Instant) -> None:
        if self.link == "up" and self.silent(now.mono_ns):
            self.link = "stale"
            self._good_in_row = 0
        elif self.link in ("booting", "stale") and self._good_in_row >= GOOD_LINES:
            self.link = "up"

    def _miss(self) -> None:
        """What came, or did not, is no reason to trust the link; a link that is up stays so."""
        if self.link != "up":
            self._good_in_row = 0

    def _line(self, line: bytes, read_at: Instant, following: int) -> Feedback | None:
        try:
            speeds = self.codec.decode(line)
        except FrameError as error:
            self.rejects[error.reason] += 1
            self._miss()
            return None
        if self.silent(read_at.mono_ns):
            self._miss()
            if self._heard_ns is not None:
                self.sparse_s = (read_at.mono_ns - self._heard_ns) / NS_PER_S
        else:
            self.sparse_s = 0.0
        self.good_lines += 1
        self._good_in_row += 1
        # Bytes that followed in the same read were on the wire after this line was complete.
        age = wire_ns(following, self._baud_rate)
        at = Instant(read_at.mono_ns - age, read_at.wall_ns - age)
        last, heard = self._last, self._heard_ns
        if last is not None and at.mono_ns < last.mono_ns:
            at = Instant(last.mono_ns, max(at.wall_ns, last.wall_ns))
        self._last, self._heard_ns = at, read_at.mono_ns
        if last is None:
            return Feedback(at, speeds, 0.0)
        since = (at.mono_ns - last.mono_ns) / NS_PER_S
        if heard is None or read_at.mono_ns - heard > self.quiet_ns:
            if heard is not None and read_at.mono_ns - heard >= LONG_GAP_NS:
                self.restarted = True
            return Feedback(at, speeds, 0.0, gap=since)
        return Feedback(at, speeds, since)
