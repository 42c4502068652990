"""The robot on its blocks: commands to the motors a to d, their answers, and what keeps it safe.

Every step of the check speaks through here. Speeds are the motors', not the wheels': which wheel a
motor turns is what the check has to find out. A motor that runs away, or an MCU that falls silent
while one turns, ends the check at once: zeros, then silence.
"""

from __future__ import annotations

from math import ceil

from acsard.checkup import limits, manual, motion
from acsard.checkup.findings import StoppedError, WireLostError, motor_name, motor_names
from acsard.checkup.motion import ZERO, Reply
from acsard.checkup.outside import Wire
from acsard.config.settings import McuConfig, WheelMap
from acsard.config.wire_time import line_bytes, wire_ns
from acsard.mcu.check import ASK_SAMPLE, SEQUENCES, seal, unseal
from acsard.mcu.frames import LETTERS, Codec, FrameError, Motors
from acsard.mcu.lines import LineReader
from acsard.values import NS_PER_S, STILL, WheelSpeeds

LEAST_S = 0.001
"""No line goes out for less than this."""

FAREWELL = 5
"""How many times the last zeros go out, in each form."""


class Board:
    """One wire; enter it to begin, leaving sends zeros and falls silent, whatever happened."""

    def __init__(self, wire: Wire, mcu: McuConfig, rate_hz: float) -> None:
        self.wire, self.mcu, self.rate_hz = wire, mcu, rate_hz
        self.is_open = False
        self.baud_rate: int = mcu.baud_rate
        self.comma = mcu.trailing_comma
        self.latched = False
        """Zeros without what is `comma` now left the last motor turning."""
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
        self.sent_s = 0.0
        self.sent_lines = 0
        self.longest_pause_s = 0.0
        """Between two lines of ours while driving: too long, and the watchdog strikes."""
        self.slowest_rest_s = 0.0
        """The longest that the motors took to come to rest after zeros."""
        self._fled = False
        """Zeros do not stop a motor, or make it run: silence, and the MCU's watchdog, may."""
        self._commanded = ZERO
        self._excused_s = 0.0
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

    def __enter__(self) -> Board:
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

    # time

    @property
    def now_s(self) -> float:
        """The time."""
        return self.wire.now_ns() / NS_PER_S

    @property
    def line_s(self) -> float:
        """What the wire needs for a line and a little room."""
        longest = line_bytes(True, self.sealed, self.sampled)
        return 1.25 * wire_ns(longest, self.baud_rate) / NS_PER_S

    @property
    def period_s(self) -> float:
        """Between two lines."""
        return max(limits.PERIOD_S, self.line_s)

    # sending

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
        self.sent_s = self.now_s

    def zeros(self) -> None:
        """Zeros that any firmware takes: on a line of their own, with the comma and without."""
        self._commanded = ZERO
        plain = self._codecs[True].stop + self._codecs[False].stop
        sealed = self.line(ZERO) if self.sealed else b""
        self.wire.send(b"\r\n" + plain + sealed)
        self.sent_s = self.now_s

    def ask(self, motors: Motors = ZERO, wait_s: float = 0.0, comma: bool | None = None) -> None:
        """One command, and its answer waited for, a period at the least."""
        self.send(motors, comma)
        self.listen(max(wait_s, self.period_s))

    # listening

    def listen(self, seconds: float) -> list[Reply]:
        """What the MCU answers in the next so many seconds, in which nothing need come."""
        got = self._listen(seconds)
        self._excused_s = self.now_s
        return got

    def _listen(self, seconds: float) -> list[Reply]:
        got = []
        for at_ns, data in self.wire.listen(self.wire.now_ns() + ceil(seconds * NS_PER_S)):
            self.heard_bytes += len(data)
            for line, following in self._lines.feed(data):
                at_s = (at_ns - wire_ns(following, self.baud_rate)) / NS_PER_S
                reply = self._reply(line, at_s)
                if reply is not None:
                    got.append(reply)
        self.replies += got
        if self.armed and any(abs(v) > limits.RUNAWAY for r in got for v in r.motors):
            self._guard()
        return got

    def _reply(self, line: bytes, at_s: float) -> Reply | None:
        try:
            plain, reading = line, None
            if self.sealed or b"#" in line:
                checked = unseal(line)
                plain, reading = checked.plain, checked.reading
            return Reply(at_s, self._codecs[False].decode(plain).as_tuple(), line, reading)
        except FrameError:
            self.others.append(line)
            return None

    def drive(
        self, motors: Motors, seconds: float, period_s: float = 0.0, comma: bool | None = None
    ) -> list[Reply]:
        """Command these speeds for so long, line after line; the answers of that time."""
        period_s = period_s or self.period_s
        end_s = self.now_s + seconds
        got: list[Reply] = []
        while (now_s := self.now_s) < end_s - LEAST_S:
            self.longest_pause_s = max(self.longest_pause_s, now_s - self.sent_s)
            self.send(motors, comma)
            got += self._listen(min(period_s, end_s - now_s))
            if self.now_s - now_s > period_s + limits.WATCHDOG_LEAST_S:
                self._excused_s = self.now_s  # it was the host that paused
            self._present()
        return got

    def begin(self) -> float:
        """Motors are to turn from here on: what was before it, a question say, does not count."""
        self._excused_s = self.sent_s = self.now_s
        self.longest_pause_s = 0.0
        return self.now_s

    # standing

    def standing(self, since_s: float) -> bool:
        """The last two replies since then say that every motor stands."""
        last = motion.since(self.replies[-2:], since_s)
        return len(last) == 2 and all(abs(v) < limits.STANDING for r in last for v in r.motors)

    def rest(self) -> None:
        """Stop, and wait until everything stands; ends the check when nothing does that.

        Where zeros in the other form stop the last motor, which kept its speed, that form is in
        force from then on.
        """
        began_s = self.now_s
        if self._settles(self.comma):
            return
        turning = self.turning()
        kept = turning == [3] and not self._slows()
        if self._settles(not self.comma):
            if kept:
                self.latched, self.comma = True, not self.comma
            return
        self._let_go()
        motors = motor_names(self.mcu, turning, ", ") or "something"
        seconds = round(self.now_s - began_s, 1)
        raise StoppedError(manual.find("stop: turns", motors=motors, seconds=seconds))

    def _settles(self, comma: bool) -> bool:
        """Zeros until everything stands; False when it does not, be it that no motor slows down
        any more."""
        began_s = self.now_s
        while not self.standing(began_s):
            waited_s = self.now_s - began_s
            if waited_s >= limits.PATIENCE_S or (waited_s >= limits.MOTOR_S and not self._slows()):
                return False
            self.ask(ZERO, comma=comma)
        self.slowest_rest_s = max(self.slowest_rest_s, self.now_s - began_s)
        return True

    def _slows(self) -> bool:
        """Some motor slows down."""
        return min(motion.trend(self.replies, self.now_s, self.gap_s)) < motion.FALLS

    def turning(self) -> list[int]:
        """The motors that turn by the last reply."""
        speeds = self.replies[-1].motors if self.replies else ()
        return [motor for motor, speed in enumerate(speeds) if abs(speed) >= limits.STANDING]

    # safety

    def _guard(self) -> None:
        fastest = self._fastest()
        if fastest is None:
            return
        motor, seen = fastest
        told = self._commanded[motor]
        self._let_go()
        outcome = "runaway: against" if told * seen < 0 else "runaway: along"
        name, letter, most = motor_name(self.mcu, motor), LETTERS[motor], limits.RUNAWAY
        found = manual.find(outcome, motor=name, letter=letter, told=told, seen=seen, most=most)
        raise StoppedError(found)

    def _let_go(self) -> None:
        """Zeros once, and none after them."""
        self._fled = True
        self.zeros()

    @property
    def named_counts(self) -> int:
        """Encoder counts per turn by the identification, 0 when it does not say."""
        named = self.identity.get("counts", "")
        return int(named) if named.isdigit() and len(named) < 9 else 0

    def _fastest(self) -> tuple[int, float] | None:
        """A motor that runs away, and its speed."""
        per_turn = self.named_counts or self.mcu.encoder_counts
        return motion.fastest(self.replies, limits.RUNAWAY, per_turn)

    def _present(self) -> None:
        """Ends the check when the MCU has fallen silent: nobody would see a runaway."""
        last_s = self.replies[-1].at_s if self.replies else 0.0
        silent_s = self.now_s - max(last_s, self._excused_s)
        if not self.armed or silent_s <= limits.WATCHDOG_S + 4 * self.gap_s:
            return
        asked = [motor for motor, speed in enumerate(self._commanded) if speed]
        self.zeros()
        motors = motor_names(self.mcu, asked) or "nothing"
        raise StoppedError(manual.find("link: silent", motors=motors, seconds=silent_s))
