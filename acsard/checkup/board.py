"""The robot on its blocks: what goes out to the motors a to d, what came back, what keeps it safe.

Every step of the check is an experiment: lines go out for some time, all that comes back is one
recording, `replies`, and the step judges what it holds. Speeds are the motors', not the wheels':
which wheel a motor turns is what the check has to find out. A motor that runs away, or an MCU that
falls silent while one turns, ends any experiment at once, as one that starts anew: zeros, silence.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

from acsard.checkup import limits, manual, motion
from acsard.checkup.findings import StoppedError, WireLostError, motor_name, motor_names
from acsard.checkup.lateness import Lateness
from acsard.checkup.motion import ZERO, Reply
from acsard.checkup.outside import Wire
from acsard.checkup.restarts import RestartedError, Restarts
from acsard.config.motion_rules import LONGEST_REPLY_S
from acsard.config.settings import McuConfig, WheelMap
from acsard.config.wire_time import line_bytes, wire_ns
from acsard.mcu.check import ASK_SAMPLE, SEQUENCES, seal, unseal
from acsard.mcu.codec import LETTERS, Codec, FrameError, Motors
from acsard.mcu.contract import WATCHDOG_S
from acsard.mcu.hearing import Heard
from acsard.mcu.lines import LineReader
from acsard.values import NS_PER_S, WheelSpeeds

LEAST_S = 0.001
"""No line goes out for less than this."""

BEAT_NS = int(limits.PERIOD_S * NS_PER_S)
"""So often it is looked whether this computer is late, however long is listened."""

FAREWELL = 5
"""How many times the last zeros go out, in each form."""


class Known(NamedTuple):
    """What later steps use of what earlier ones found out; each has its words at `Board`."""

    comma: bool
    latched: bool
    sealed: bool
    sampled: bool
    own_clock: bool
    gap_s: float
    paced: bool
    lost: float


class Board:
    """One wire; entering opens it, leaving sends zeros and falls silent, whatever happened."""

    def __init__(
        self, wire: Wire, mcu: McuConfig, rate_hz: float, longest_reply: float = LONGEST_REPLY_S
    ) -> None:
        self.wire, self.mcu, self.rate_hz = wire, mcu, rate_hz
        self.longest_reply_s = longest_reply
        """The most that mcu.reply_period may be."""
        self.armed = False
        """The motors have been seen to stand: from now on a runaway ends the check."""
        # what is found out of it
        self.baud_rate: int = mcu.baud_rate
        self.comma = mcu.trailing_comma
        self.latched = False
        """Zeros without what is `comma` now left the last motor turning."""
        self.sealed = self.sampled = False
        """Lines go out with the check, and ask for the sample fields."""
        self.identity: dict[str, str] = {}
        self.own_clock = False
        """It reports by its own clock."""
        self.gap_s = mcu.reply_period
        """Between two replies while lines go out."""
        self.paced = False
        """Those two were measured."""
        self.lost = 0.0
        """Share of the lines that get lost or damaged, of either way."""
        # the recording
        self.replies: list[Reply] = []
        self.others: list[bytes] = []
        """Lines that are no good replies."""
        self.heard = Heard()
        """All that came since the line was opened."""
        self.sent_lines = 0
        self.sent_s = 0.0
        self.lateness = Lateness()
        """Of this computer; of the board, too, where it is one of its programs."""
        self.fled = False
        """Zeros do not stop a motor, or make it run: silence, and the MCU's watchdog, may."""

        self._commanded = ZERO
        self._unanswered_s = 0.0
        """For how long `drive` has had no reply; what this host paused does not count."""
        self._listened_s = 0.0
        self._sequence = 0
        self._lines = LineReader()
        self.restarts = Restarts()
        self._codecs = {comma: Codec(WheelMap(), comma) for comma in (False, True)}

    def open(self, baud_rate: int) -> None:
        """Open the line at this rate; what was half received is forgotten."""
        self.wire.open(baud_rate)
        self.baud_rate, self.heard = baud_rate, Heard()
        self.forget()

    def forget(self) -> None:
        """What was heard says nothing of the board that is there now; how it speaks, it does."""
        self.restarts, self._unanswered_s = Restarts(), 0.0
        for heard in (self._lines, self.replies, self.others):
            heard.clear()

    def __enter__(self) -> Board:
        self.open(self.mcu.baud_rate)
        return self

    def __exit__(self, *error: object) -> None:
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
        self.armed, self.restarts.watched = False, False
        try:
            for _ in range(FAREWELL):
                if self.fled:
                    break
                self.zeros()
                self.listen(2 * self.period_s)
                self.fled = motion.fastest(self.replies, limits.RUNAWAY) is not None
        except WireLostError:
            pass  # nothing reaches the motors any more; the MCU's own watchdog has to

    @property
    def now_s(self) -> float:
        """The time."""
        return self.wire.now_ns() / NS_PER_S

    @property
    def known(self) -> Known:
        """What a step may have found out of it, to be what it was when that is tried again."""
        return Known(*(getattr(self, name) for name in Known._fields))

    @known.setter
    def known(self, known: Known) -> None:
        for name, value in known._asdict().items():
            setattr(self, name, value)

    @property
    def line_s(self) -> float:
        """What the wire needs for a line and a little room."""
        longest = line_bytes(True, self.sealed, self.sampled)
        return 1.25 * wire_ns(longest, self.baud_rate) / NS_PER_S

    @property
    def period_s(self) -> float:
        """Between two lines."""
        return max(limits.PERIOD_S, self.line_s)

    # what goes out

    def line(self, motors: Motors, comma: bool | None = None) -> bytes:
        """The command for these speeds in the form in force, or with or without its last comma."""
        line = self._codecs[self.comma if comma is None else comma].encode(WheelSpeeds(*motors))
        if not self.sealed:
            return line
        self._sequence = (self._sequence + 1) % SEQUENCES
        return seal(line, self._sequence, ASK_SAMPLE if self.sampled else b"")

    def send(self, motors: Motors, comma: bool | None = None) -> None:
        """One command, now."""
        turned, self._commanded = any(self._commanded), motors
        self.wire.send(self.line(motors, comma))
        self.sent_lines += 1
        self.sent_s = self.now_s
        if turned:
            self.lateness.look(self.sent_s - self._listened_s, self.sent_s)
        self.restarts.sent(motors, self.sent_s)

    def zeros(self) -> None:
        """Zeros that any firmware takes: on a line of their own, with the comma and without."""
        self._commanded = ZERO
        plain = self._codecs[True].stop + self._codecs[False].stop
        self.wire.send(b"\r\n" + plain + (self.line(ZERO) if self.sealed else b""))
        self.restarts.sent(ZERO, self.now_s)

    def wakes(self, seconds: float) -> bool:
        """Zeros until it answers; False when it does not for so long."""
        before, end_s = len(self.replies), self.now_s + seconds
        while len(self.replies) == before:
            if self.now_s >= end_s:
                return False
            self.zeros()
            self.listen(self.period_s)
        return True

    def ask(self, wait_s: float = 0.0, comma: bool | None = None) -> None:
        """Zeros once, and their answer waited for, a period at the least."""
        self.send(ZERO, comma)
        self.listen(max(wait_s, self.period_s))

    def answers(
        self, lines: int, wait_s: float, comma: bool | None = None
    ) -> list[tuple[float, Reply]]:
        """The first reply to each of so many lines, sent one by one, and how soon it came."""
        self.listen(max(limits.GLANCE_S / 4, wait_s))  # one to an earlier line is none to these
        got: list[tuple[float, Reply]] = []
        for _ in range(lines):
            self.ask(max(wait_s, 1.5 * self.period_s), comma)
            first = motion.since(self.replies, self.sent_s)[:1]
            got += [(reply.at_s - self.sent_s, reply) for reply in first]
        return got

    def drive(self, motors: Motors, seconds: float, period_s: float = 0.0) -> list[Reply]:
        """Command these speeds for so long, line after line; the answers of that time.

        Ends the check when the MCU falls silent meanwhile: nobody would see a runaway.
        """
        period_s = period_s or self.period_s
        end_s = self.now_s + seconds
        got: list[Reply] = []
        while (began_s := self.now_s) < end_s - LEAST_S:
            self.send(motors)
            answers = self.listen(min(period_s, end_s - began_s))
            took_s = self.now_s - began_s
            self._unanswered_s += 0.0 if answers else min(took_s, period_s)
            if self.armed and self._unanswered_s > WATCHDOG_S + 4 * self.gap_s:
                self.zeros()
                names = motor_names(self.mcu, [m for m in range(4) if motors[m]]) or "nothing"
                found = manual.find("link: silent", motors=names, seconds=self._unanswered_s)
                raise StoppedError(found)
            got += answers
        return got

    def let_go(self, silent_s: float) -> None:
        """Zeros once, then silence: it is the watchdog that cuts a motor that zeros do not stop."""
        self.zeros()
        self.listen(silent_s)

    # what comes back

    def listen(self, seconds: float) -> list[Reply]:
        """What the MCU answers in the next so many seconds; a runaway or new start in it raises."""
        end_ns = self.wire.now_ns() + ceil(seconds * NS_PER_S)
        if self.now_s - self._listened_s > BEAT_NS / NS_PER_S:
            self.wire.late_ns()  # that was while nothing was measured
        got: list[Reply] = []
        while True:
            until_ns = min(end_ns, self.wire.now_ns() + BEAT_NS)
            got += self._hear(until_ns)
            now_ns = self.wire.now_ns()
            self._listened_s = now_ns / NS_PER_S
            late_ns = max(now_ns - until_ns, self.wire.late_ns())
            self.lateness.look(late_ns / NS_PER_S, self._listened_s)
            if now_ns >= end_ns:
                return got

    def _hear(self, until_ns: int) -> list[Reply]:
        """One beat of it."""
        got = []
        for at_ns, data in self.wire.listen(until_ns):
            self.heard.take(data)
            for line, following in self._lines.feed(data):
                at_s = (at_ns - wire_ns(following, self.baud_rate)) / NS_PER_S
                reply = self._reply(line, at_s)
                self.heard.line(line, reply is not None)
                if restart := self.restarts.look(line, at_s, reply):
                    raise RestartedError(restart)
                if reply is not None:
                    got.append(reply)
        self.replies += got
        if got:
            self._unanswered_s = 0.0
            if self.armed:
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

    @property
    def silent_s(self) -> float:
        """Since the last reply, 0 where none has come or may be asked for."""
        return self.now_s - self.replies[-1].at_s if self.replies and not self.fled else 0.0

    def _guard(self) -> None:
        fastest = motion.fastest(self.replies, limits.RUNAWAY)
        if fastest is None:
            return
        motor, seen = fastest
        told = self._commanded[motor]
        self._flee()
        outcome = "runaway: against" if told * seen < 0 else "runaway: along"
        name, letter, most = motor_name(self.mcu, motor), LETTERS[motor], limits.RUNAWAY
        found = manual.find(outcome, motor=name, letter=letter, told=told, seen=seen, most=most)
        raise StoppedError(found)

    def _flee(self) -> None:
        """Zeros once, and none after them."""
        self.fled = True
        self.zeros()

    # standing

    def turning(self) -> list[int]:
        """The motors that turn by the last reply."""
        last = self.replies[-1].motors if self.replies else ZERO
        return motion.moving(last, limits.STANDING)

    def rest(self) -> None:
        """Stop, and wait until everything stands; ends the check when nothing does that.

        Where zeros in the other form stop the last motor, which kept its speed, that form is in
        force from then on.
        """
        began_s = self.now_s
        if self.settles(self.comma):
            return
        turning = self.turning()
        kept = turning == [3] and not self._slows()
        if self.settles(not self.comma):
            if kept:
                self.latched, self.comma = True, not self.comma
            return
        self._flee()
        motors = motor_names(self.mcu, turning, ", ") or "something"
        seconds = round(self.now_s - began_s, 1)
        raise StoppedError(manual.find("stop: turns", motors=motors, seconds=seconds))

    def settles(self, comma: bool) -> bool:
        """Zeros until two replies say that every motor stands; False when none of them does, and
        no motor slows down any more."""
        began_s = self.now_s
        while True:
            last = motion.since(self.replies[-2:], began_s)
            if len(last) == 2 and not any(motion.moving(r.motors, limits.STANDING) for r in last):
                return True
            patience_s = limits.PATIENCE_S if self._slows() else limits.MOTOR_S
            if self.now_s - began_s >= patience_s:
                return False
            self.ask(comma=comma)

    def _slows(self) -> bool:
        """Some motor slows down."""
        return min(motion.trend(self.replies, self.now_s, self.gap_s)) < motion.FALLS
