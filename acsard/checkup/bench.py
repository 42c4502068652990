"""The robot on its blocks: commands to the motors a to d, their answers, and what keeps it safe.

Every step of the check speaks through here. Speeds are the motors', not the wheels': which wheel a
motor turns is what the check has to find out. A motor that runs away, or an MCU that falls silent
while one turns, ends the check at once: zeros, then silence.
"""

from __future__ import annotations

from typing import Literal

from acsard.checkup import ends, motion
from acsard.checkup.findings import WireLostError
from acsard.checkup.motion import Reply
from acsard.checkup.outside import Wire
from acsard.config.baud import line_bytes, wire_ns
from acsard.config.settings import McuConfig, WheelMap
from acsard.mcu.check import ASK_SAMPLE, SEQUENCES, seal, unseal
from acsard.mcu.frames import Codec, FrameError, Motors
from acsard.mcu.lines import LineReader
from acsard.values import NS_PER_S, STILL, WheelSpeeds

SPEED = 3.0
"""rad/s, the fastest a motor is asked to turn: half a turn in a second."""

RUNAWAY = 2.0
"""A motor faster than this many times `SPEED` ends the check."""

STANDING = 0.1 * SPEED
"""rad/s; slower than this is standing."""

REST_S = 2.0
"""How long a lifted wheel may take to come to rest, unless it is seen to slow down."""

SLOWEST_S = 6.0
"""The longest wait for wheels that slow down: a heavy one, or a hub motor that coasts."""

KEPT = 0.8
"""A wheel still this share as fast after the wait as at its start has not been stopped."""

SILENCE_S = 0.3
"""How long the MCU may not answer while a motor turns, besides its own pace."""

LATE_S = 0.1
"""A wait that takes this much longer was the host's own pause."""

PERIOD_S = 0.02
"""Between two lines, where the wire carries that."""

FAREWELL = 5
"""How many times the last zeros go out, in each form."""

ZERO: Motors = (0.0, 0.0, 0.0, 0.0)


class Bench:
    """One wire; enter it to begin, leaving sends zeros and falls silent, whatever happened."""

    def __init__(self, wire: Wire, mcu: McuConfig, rate_hz: float) -> None:
        self.wire, self.mcu, self.rate_hz = wire, mcu, rate_hz
        self.is_open = False
        self.baud_rate: int = mcu.baud_rate
        self.comma = mcu.trailing_comma
        self.sealed = self.sampled = False
        """Lines go out with the check, and ask for the sample fields."""
        self.own_clock = False
        """It reports by its own clock."""
        self.gap_s = 0.0
        """Between two replies while lines go out."""
        self.armed = False
        """The motors have been seen to stand: from now on a runaway ends the check."""
        self.identity: dict[str, str] = {}
        self.replies: list[Reply] = []
        self.others: list[bytes] = []
        """Lines that are no good replies."""
        self.heard_bytes = 0
        self.sent_ns = 0
        self.sent_lines = 0
        self.longest_pause_s = 0.0
        """Between two lines of ours while driving: too long, and the watchdog strikes."""
        self.slowest_rest_s = 0.0
        """The longest that the motors took to come to rest after zeros."""
        self._fled = False
        """Zeros do not stop a motor, or make it run: silence, and the MCU's watchdog, may."""
        self._commanded = ZERO
        self._excused_ns = 0
        """Up to then nobody was driving, and the MCU may have been silent."""
        self._sequence = 0
        self._lines = LineReader()
        self._codecs = {comma: Codec(WheelMap(), comma) for comma in (False, True)}

    def open(self, baud_rate: int) -> None:
        """Open the line at this rate; what was half received is forgotten."""
        self.wire.open(baud_rate)
        self.is_open, self.baud_rate = True, baud_rate
        self._lines.clear()
        self.replies.clear()
        self.others.clear()
        self.heard_bytes = 0

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        if not self.is_open:
            return
        try:
            self._farewell()
        except BaseException:
            self._farewell()  # a signal in the middle of it: the zeros still have to go
            raise
        finally:
            self.wire.close()

    def _farewell(self) -> None:
        """Zeros, then silence.

        Where zeros make a motor run away (its encoder is reversed, and the firmware regulates it
        to zero), each further one would feed the watchdog that can cut it.
        """
        self.armed = False
        try:
            for _ in range(FAREWELL):
                if self._fled:
                    break
                self.zeros()
                self._listen(2 * self.period_s)
                self._fled = self._fastest() is not None
        except WireLostError:
            pass  # nothing reaches the motors any more; the MCU's own watchdog has to

    # sending

    @property
    def period_s(self) -> float:
        """Between two lines."""
        longest = line_bytes(True, self.sealed, self.sampled)
        return max(PERIOD_S, 1.25 * wire_ns(longest, self.baud_rate) / NS_PER_S)

    def line(self, motors: Motors, comma: bool | None = None) -> bytes:
        """The command for these speeds in the form in force, or with or without its last comma."""
        codec = self._codecs[self.comma if comma is None else comma]
        speeds = WheelSpeeds(*motors)
        line = codec.stop if speeds == STILL else codec.encode(speeds)
        if not self.sealed:
            return line
        self._sequence = (self._sequence + 1) % SEQUENCES
        return seal(line, self._sequence, ASK_SAMPLE if self.sampled else b"")

    def send(self, motors: Motors, comma: bool | None = None) -> None:
        """One command, now."""
        self._commanded = motors
        self.wire.send(self.line(motors, comma))
        self.sent_lines += 1
        self.sent_ns = self.wire.now_ns()

    def zeros(self) -> None:
        """Zeros that any firmware takes: on a line of their own, with the comma and without."""
        self._commanded = ZERO
        plain = self._codecs[True].stop + self._codecs[False].stop
        sealed = self.line(ZERO) if self.sealed else b""
        self.wire.send(b"\r\n" + plain + sealed)
        self.sent_ns = self.wire.now_ns()

    # listening

    def listen(self, seconds: float) -> list[Reply]:
        """What the MCU answers in the next so many seconds, in which nothing need come."""
        got = self._listen(seconds)
        self._excused_ns = self.wire.now_ns()
        return got

    def _listen(self, seconds: float) -> list[Reply]:
        pieces = self.wire.listen(self.wire.now_ns() + int(seconds * NS_PER_S))
        got = []
        for at_ns, data in pieces:
            self.heard_bytes += len(data)
            for line, following in self._lines.feed(data):
                reply = self._reply(line, at_ns - wire_ns(following, self.baud_rate))
                if reply is not None:
                    got.append(reply)
        self.replies += got
        if self.armed and any(abs(v) > RUNAWAY * SPEED for r in got for v in r.motors):
            self._guard()
        return got

    def _reply(self, line: bytes, at_ns: int) -> Reply | None:
        try:
            plain, reading = line, None
            if self.sealed or b"#" in line:
                checked = unseal(line)
                plain, reading = checked.plain, checked.reading
            return Reply(at_ns, self._codecs[False].decode(plain).as_tuple(), line, reading)
        except FrameError:
            self.others.append(line)
            return None

    def drive(
        self,
        motors: Motors,
        seconds: float,
        comma: bool | None = None,
        period_s: float | None = None,
    ) -> list[Reply]:
        """Command these speeds for so long, line after line; the answers of that time."""
        period_s = period_s or self.period_s
        end_ns = self.wire.now_ns() + int(seconds * NS_PER_S)
        got: list[Reply] = []
        while (now_ns := self.wire.now_ns()) < end_ns:
            pause_s = (now_ns - self.sent_ns) / NS_PER_S
            self.longest_pause_s = max(self.longest_pause_s, pause_s)
            self.send(motors, comma)
            got += self._listen(min(period_s, (end_ns - now_ns) / NS_PER_S))
            if self.wire.now_ns() - now_ns > int((period_s + LATE_S) * NS_PER_S):
                self._excused_ns = self.wire.now_ns()  # it was the host that paused
            self._present()
        return got

    def begin(self) -> None:
        """Motors are to turn from here on: what was before it, a question say, does not count."""
        self._excused_ns = self.sent_ns = self.wire.now_ns()
        self.longest_pause_s = 0.0

    # standing

    def standing(self, since_ns: int) -> bool:
        """The last two replies since then say that every motor stands."""
        last = [reply for reply in self.replies[-2:] if reply.at_ns >= since_ns]
        return len(last) == 2 and all(abs(v) < STANDING for r in last for v in r.motors)

    def rest(self) -> Literal["rest", "comma"]:
        """Stop, and wait until everything stands.

        "comma" when the last motor alone keeps its speed until zeros with the other last comma
        stop it; ends the check when nothing does.
        """
        began_ns = self.wire.now_ns()
        if self._settles():
            return "rest"
        turning = self.turning()
        latched = turning == [3] and self._kept(3, began_ns)
        self.comma = not self.comma
        settled = self._settles()
        if settled and latched:
            return "comma"
        self.comma = not self.comma
        if settled:
            return "rest"
        self._let_go()
        waited_s = (self.wire.now_ns() - began_ns) / NS_PER_S
        raise ends.stays_turning(self.mcu, turning, round(waited_s, 1))

    def _settles(self) -> bool:
        """Zeros in the form in force until everything stands; False when it does not, be it that
        no motor slows down any more."""
        began_ns = self.wire.now_ns()
        while not self.standing(began_ns):
            now_ns = self.wire.now_ns()
            waited_s = (now_ns - began_ns) / NS_PER_S
            if waited_s >= SLOWEST_S or (waited_s >= REST_S and not self._slows()):
                return False
            self.send(ZERO)
            self.listen(self.period_s)
        waited_s = (self.wire.now_ns() - began_ns) / NS_PER_S
        self.slowest_rest_s = max(self.slowest_rest_s, waited_s)
        return True

    def _slows(self) -> bool:
        """Some motor slows down."""
        now_ns = self.wire.now_ns()
        return min(motion.trend(self.replies, now_ns, self.gap_s)) < motion.FALLS

    def _kept(self, motor: int, began_ns: int) -> bool:
        """It is about as fast now as it was then: zeros have not reached it."""
        span, now_ns = 0.4 * REST_S * NS_PER_S, self.wire.now_ns()
        first = motion.between(self.replies, began_ns, began_ns + span)[motor]
        return motion.between(self.replies, now_ns - span, now_ns)[motor] >= KEPT * first

    def turning(self) -> list[int]:
        """The motors that turn by the last reply."""
        if not self.replies:
            return []
        return [m for m, speed in enumerate(self.replies[-1].motors) if abs(speed) >= STANDING]

    # safety

    def _guard(self) -> None:
        found = self._fastest()
        if found is None:
            return
        motor, speed = found
        asked = self._commanded[motor]
        self._let_go()
        raise ends.runaway(self.mcu, motor, asked, speed, RUNAWAY * SPEED)

    def _let_go(self) -> None:
        """Zeros once, and none after them."""
        self._fled = True
        self.zeros()

    def _fastest(self) -> tuple[int, float] | None:
        """A motor that runs away, and its speed."""
        named = self.identity.get("counts", "")
        per_turn = int(named) if named.isdigit() else self.mcu.encoder_counts
        return motion.fastest(self.replies, RUNAWAY * SPEED, per_turn)

    @property
    def _last_ns(self) -> int:
        return self.replies[-1].at_ns if self.replies else 0

    def _present(self) -> None:
        """Ends the check when the MCU has fallen silent: nobody would see a runaway."""
        heard_ns = max(self._last_ns, self._excused_ns)
        silent_s = (self.wire.now_ns() - heard_ns) / NS_PER_S
        if not self.armed or silent_s <= SILENCE_S + 4 * self.gap_s:
            return
        asked = [motor for motor, speed in enumerate(self._commanded) if speed]
        self.zeros()
        raise ends.silent(self.mcu, asked, silent_s)
