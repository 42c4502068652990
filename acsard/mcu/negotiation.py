"""Which check is in force on this line: asked at every opening and after every gap, with stops.

    off      mcu.link_check says so: plain lines, nothing is asked
    asking   only stops leave, some of them questions: stops with a suffix
    plain    "auto" only: the MCU answered, but without the check; asked again after the next gap
    checked  a right reply to a line of ours has come; from now on only such count

Knows sequences and questions, nothing of speeds. An MCU that has answered with the check once is
never believed without it until the port is opened anew: noise must not talk us out of the check.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from acsard.config.baud import line_bytes, wire_ns
from acsard.config.settings import McuConfig
from acsard.mcu.check import ASK_NOTHING, ASK_SAMPLE, SEQUENCES, Checked, seal
from acsard.mcu.frames import FrameError
from acsard.values import NS_PER_S

State = Literal["off", "asking", "plain", "checked"]

TRIES = 3
"""Questions of a kind that go unanswered before the MCU is said not to know it."""

WINDOW = 64
"""Lines whose answers may still come; far fewer than the sequence can tell apart."""

LATE_NS = 3 * NS_PER_S // 10
"""An answer later than this is to a line that the MCU's own watchdog has outlived."""

BLIND_PERIOD_NS = NS_PER_S // 10
"""Zero lines go out at 10 Hz while nothing comes back: enough to wake the MCU, little to queue."""

THINKING_NS = 30_000_000
"""What an MCU and the drivers may take to answer, besides the wire."""

FEW_SAMPLES = 5
"""Right replies in a row without the sample they were asked for: it is not coming back."""


class Negotiation:
    """Asks, seals what leaves, and says whether a reply answers a line of ours."""

    def __init__(self, mcu: McuConfig, stop: bytes) -> None:
        """`stop` is the plain stop line."""
        self._stop, self._wanted = stop, mcu.link_check
        self.state: State = "off" if mcu.link_check == "off" else "asking"
        self.samples = False
        """The MCU sends its encoder counts when asked, and is asked."""
        self.refused = False
        """It answers, but not as it must: asked on and on, and nothing drives meanwhile."""
        self.settled_ns = 0
        """When asking last ended."""
        first = (ASK_SAMPLE,) * TRIES if mcu.wants_samples else (ASK_NOTHING,)
        self._letters = (*first, *(b"",) * TRIES)
        self._question = b""
        """The last one, if an echo of it can be told from an answer."""
        self._echo = False
        longest = line_bytes(mcu.trailing_comma, check=True, sample=mcu.wants_samples)
        self._answer_ns = THINKING_NS + 4 * wire_ns(longest, mcu.baud_rate)
        self._sequence = 0
        self._pending: deque[tuple[int, int]] = deque(maxlen=WINDOW)
        self._handed: int | None = None
        self._asked_ns: int | None = None
        self._awake = self._open = False
        self._failed = self._without = 0
        self._knows = False
        self._plain_next = True

    def begin(self, fresh: bool = False) -> None:
        """Ask from the start: nothing said before counts. `fresh` when the port has been opened."""
        if self.state == "off":
            return
        self.state, self.samples = "asking", False
        self._pending.clear()
        self._failed, self._awake, self._open = 0, False, False
        self._asked_ns = None
        # The port makes the first line after an opening a plain stop, whatever it is given.
        self._plain_next = fresh
        if fresh:
            self.refused = self._knows = self._echo = False

    # what leaves

    def seal(self, line: bytes, now_ns: int) -> bytes:
        """The line as it leaves under the check in force."""
        if self.state != "checked":
            return line
        return self._sealed(line, ASK_SAMPLE if self.samples else b"", now_ns)

    def question(self, now_ns: int) -> bytes | None:
        """While asking: the stop that is due now, or None.

        To an MCU that has said nothing yet every other one is plain: it may know no other.
        """
        wait_ns = self._answer_ns if self._awake else max(BLIND_PERIOD_NS, self._answer_ns)
        if self._asked_ns is not None and now_ns - self._asked_ns < wait_ns:
            return None
        self._asked_ns = now_ns
        plain = self._plain_next and not self._awake
        self._plain_next = not plain
        if plain:
            return self._stop
        self._open = True
        letters = self._letters[self._failed]
        line = self._sealed(self._stop, letters, now_ns)
        self._question = line.removesuffix(b"\r\n") if letters else b""
        return line

    def unsent(self) -> None:
        """The last line did not go out: nobody can answer it."""
        if self._pending and self._pending[-1][0] == self._handed:
            self._pending.pop()
            self._open = False
        self._handed = None

    def _sealed(self, line: bytes, letters: bytes, now_ns: int) -> bytes:
        self._handed = self._sequence = (self._sequence + 1) % SEQUENCES
        self._pending.append((self._sequence, now_ns))
        return seal(line, self._sequence, letters)

    # what comes back

    def echoed(self, line: bytes) -> bool:
        """Is this our own question? Then nothing that comes back can be believed: it never is."""
        if self._question and line == self._question:
            self._echo = self.refused = True
        return self._echo

    def heard_plain(self) -> None:
        """A whole plain line came while asking: the MCU is awake, so silence is an answer too."""
        self._awake = True

    def answered(self, reply: Checked, at_ns: int) -> int:
        """Take a right reply; when the line it answers was made.

        Raises `FrameError` unless it answers a line sent and unanswered.
        """
        while self._pending and at_ns - self._pending[0][1] > LATE_NS:
            self._pending.popleft()
        if reply.sequence not in [sequence for sequence, _ in self._pending]:
            raise FrameError("stale_sequence", reply.plain)
        # Lines are answered in order: those before this one will not be any more.
        sequence, asked_ns = self._pending.popleft()
        while sequence != reply.sequence:
            sequence, asked_ns = self._pending.popleft()
        has_sample = reply.reading is not None
        if self.state == "asking":
            self.state, self.settled_ns = "checked", at_ns
            self.samples, self._without = has_sample, 0
            self._knows, self.refused = True, False
        elif self.samples:
            self._without = 0 if has_sample else self._without + 1
            self.samples = self._without < FEW_SAMPLES
        return asked_ns

    def judge(self, now_ns: int) -> None:
        """Count a question that goes unanswered; after the last one settle for what there is."""
        asked_ns = self._asked_ns
        if self.state != "asking" or not (self._awake and self._open) or asked_ns is None:
            return
        if self._echo:
            self._failed = 0  # it goes on asking, and nothing drives
            return
        if now_ns - asked_ns < self._answer_ns:
            return
        self._open = False
        self._failed += 1
        if self._failed < len(self._letters):
            return
        self._failed = 0
        if self._wanted == "auto" and not self._knows:
            self.state, self.settled_ns = "plain", now_ns
        else:
            self.refused = True

    # words

    @property
    def in_force(self) -> str:
        """The check in force, for people."""
        if self.state == "checked":
            return "checked with samples" if self.samples else "checked"
        return "plain" if self.state in ("off", "plain") else "being asked for"

    def refusal(self) -> str:
        """Why there is no driving, with the mend, when that is because of the check; else ""."""
        if not self.refused:
            return ""
        if self._echo:
            return (
                "what is sent comes back: transmit and receive are joined, or the adapter (RS-485) "
                "repeats what it sends; mend that, then replug it"
            )
        if self._knows:
            return (
                "the microcontroller answered with a check before and now does not: its replies "
                "are damaged on the way (look at cable and baud rate), or it has other firmware "
                "(then replug it)"
            )
        return (
            'the microcontroller answers without a check, and mcu.link_check = "require" drives '
            "only with one: give it firmware that has it, or write "
            'mcu.link_check = "auto"'
        )
