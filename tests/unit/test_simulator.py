"""The fake microcontroller against an independent model of its firmware, and its lines.

What the machine code of a real board does is in `tests/firmware`. `TRUE` has no motor lag and fine
encoders, so it reports exactly the commanded speeds.
"""

from __future__ import annotations

import asyncio
import binascii
import fcntl
import os
import re
import termios
import time
from itertools import pairwise, permutations
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import Baud, Config, McuConfig, SimConfig, WheelMap
from acsard.core.simulator import protocol
from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import MS, RESET_NS, FakeMcu
from acsard.core.simulator.protocol import BoardCommand, plain_only, prefix, reference
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.daemon.serial.simulator_pty import SimPty
from acsard.host import clock
from tests.each import each
from tests.wheels import FOUR, TWO, four_and_two

PLAIN = b"ap12.50,bn08.75,cp15.00,dn10.25"
LINE = PLAIN + b"\r\n"
SPEEDS = [12.5, -8.75, 15.0, -10.25]
ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
STILL = [0.0] * 4
LINE_NS = 33 * 10 * 1_000_000_000 // 115200  # on the wire: 2.86 ms

TRUE = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=1_000_000))

Heard = list[tuple[int, bytes]]


def replies(mcu: FakeMcu, until_ns: int) -> Heard:
    """Advance the board from event to event, and return the data that it sent, with times."""
    chunks = []
    while (due := mcu.next_ns()) is not None and due <= until_ns:
        if data := mcu.advance(due):
            chunks.append((due, data))
    assert mcu.advance(until_ns) == b""
    return chunks


def drive(mcu: FakeMcu, start_ns: int, count: int, line: bytes = LINE) -> Heard:
    """Send a line every 10 ms, `count` times, and listen for 10 ms after the last one."""
    chunks = []
    for n in range(count):
        mcu.receive(start_ns + n * 10 * MS, line)
        chunks += replies(mcu, start_ns + (n + 1) * 10 * MS)
    return chunks


# The board and an independent model of it.


class Model:
    """Obeys the last whole line for 300 ms. Its speeds are those of the four simulated wheels."""

    def __init__(self, wheels: WheelMap) -> None:
        self.speeds, self.until_ms, self.valid = STILL, -1.0, 0
        self.two, letters = wheels is TWO, wheels.letters.encode()
        tokens = b",".join(b"%c([pn])(\\d\\d\\.\\d\\d)" % motor for motor in letters)
        self.whole = re.compile(tokens + rb",?\r?\n")

    def hears(self, line: bytes, ends_ms: float) -> None:
        if found := self.whole.fullmatch(line):
            signs, values = found.groups()[0::2], found.groups()[1::2]
            speeds = [
                float(v) * (1 if s == b"p" else -1) for s, v in zip(signs, values, strict=True)
            ]
            if self.two:  # l is left, and r is right
                left, right = speeds
                speeds = [right, left, left, right]
            self.speeds = speeds
            self.until_ms, self.valid = ends_ms + 300, self.valid + 1

    def at(self, now_ms: float) -> list[float]:
        """Return the speeds at this time, which is not within 5 ms of the watchdog's."""
        if now_ms > self.until_ms + 5:
            self.speeds = STILL
        return self.speeds


speed = st.tuples(st.sampled_from("pn"), st.integers(0, 9999)).map(
    lambda value: f"{value[0]}{value[1] / 100:05.2f}"
)
ends = st.sampled_from(["\r\n", "\n", ",\r\n"])
WHOLE = {
    FOUR: st.tuples(speed, speed, speed, speed, ends).map(
        lambda of: ("a{},b{},c{},d{}{}".format(*of)).encode()
    ),
    TWO: st.tuples(speed, speed, ends).map(lambda of: ("l{},r{}{}".format(*of)).encode()),
}


@st.composite
def damaged(draw: st.DrawFn, wheels: WheelMap) -> bytes:
    """Return a line in which up to two places are lost, doubled or replaced."""
    line = draw(WHOLE[wheels])[:-1]
    for _ in range(draw(st.integers(1, 2))):
        at = draw(st.integers(0, len(line) - 1))
        others = st.sampled_from([b"", b"x", b" ", b",", b"\x00", b"\xff", b"-", b"9", b"ap1"])
        line = line[:at] + draw(others) + line[at + draw(st.integers(0, 1)) :]
    return line + b"\n"


@four_and_two
@given(data=st.data())
def test_the_board_obeys_and_answers_whole_lines_only_and_forgets_them_after_300_ms(
    wheels: WheelMap, data: st.DataObject
) -> None:
    lines = WHOLE[wheels] | damaged(wheels)
    waits = st.sampled_from([20, 60, 280, 330, 900])
    sent = data.draw(st.lists(st.tuples(waits, lines), max_size=9))
    mcu, model, now = FakeMcu(replace(TRUE, mcu=McuConfig(wheels=wheels))), Model(wheels), 0
    answers = 0
    for wait_ms, line in sent:
        cut = len(line) // 3  # in two pieces, it is one line
        mcu.receive(now * MS, line[:cut])
        mcu.receive(now * MS, line[cut:])
        model.hears(line, now + len(line) * 10e3 / 115200)
        answers += len(replies(mcu, (now + 15) * MS))  # on the wire, and 1 to 5 ms later
        assert mcu.vehicle.set_points == pytest.approx(model.at(now + 15))
        now += wait_ms
        answers += len(replies(mcu, now * MS))
        assert mcu.vehicle.set_points == pytest.approx(model.at(now))
    assert [line for _, line in mcu.heard] == [line for _, line in sent]
    assert mcu.valid_lines == answers == model.valid


@each(
    ("wheels", "line", "slow", "zero"),
    [
        (FOUR, LINE, b"ap01.00,bp01.00,cp01.00,dp01.00\r\n", ZERO),
        (TWO, b"lp12.50,rn08.75\r\n", b"lp01.00,rp01.00\r\n", b"lp00.00,rp00.00\r\n"),
    ],
)
def test_the_board_starts_silent_and_then_reports_its_speeds_in_the_form_of_the_line(
    wheels: WheelMap, line: bytes, slow: bytes, zero: bytes
) -> None:
    config = replace(TRUE, mcu=McuConfig(wheels=wheels))
    mcu = FakeMcu(config)
    assert replies(mcu, 1000 * MS) == []
    assert mcu.next_ns() is None
    assert [data for _, data in drive(mcu, 1000 * MS, 6, line)] == [zero] + [line] * 5
    # Two reads of the encoders within 4 ms give the same figures.
    mcu = FakeMcu(config)
    drive(mcu, 0, 4, line)
    mcu.receive(50 * MS, slow + zero)
    assert [data for _, data in replies(mcu, 80 * MS)] == [line] * 2
    mcu.receive(80 * MS, zero)
    assert replies(mcu, 100 * MS)[0][1] != line


def test_coarse_encoders_count_whole_steps_and_motors_lag() -> None:
    coarse = Config(sim=SimConfig(motor_time_constant=0.0, encoder_counts=16))
    speeds = {data[2:7] for _, data in drive(FakeMcu(coarse), 0, 50)}
    assert b"00.00" in speeds
    assert b"12.50" not in speeds
    slow = Config(sim=SimConfig(motor_time_constant=0.05, encoder_counts=1_000_000))
    rising = [float(data[2:7]) for _, data in drive(FakeMcu(slow), 0, 60)]
    assert rising == sorted(rising)
    assert rising[2] < 0.6 * 12.5
    assert rising[-1] == 12.5


@pytest.mark.parametrize(("baud", "line_ns"), [(9600, 34_375_000), (115200, 2_864_583)])
def test_lines_and_answers_follow_each_other_on_the_wire(baud: Any, line_ns: int) -> None:
    mcu = FakeMcu(replace(TRUE, mcu=McuConfig(baud_rate=baud)))
    mcu.receive(1000, LINE * 8)
    sent = [when for when, _ in replies(mcu, 2000 * MS)]
    assert [at for at, _ in mcu.heard] == pytest.approx(
        [1000 + n * line_ns for n in range(1, 9)], abs=8
    )
    assert 1 * MS <= sent[0] - 1000 - 2 * line_ns <= 5 * MS
    assert len(sent) == 8
    assert all(later - sooner >= line_ns - 1 for sooner, later in pairwise(sent))
    delays = [
        at - n * 10 * MS - 2 * LINE_NS for n, (at, _) in enumerate(drive(FakeMcu(TRUE), 0, 40))
    ]
    assert 1 * MS - 10 <= min(delays) < max(delays) - 2 * MS < 3 * MS + 10


def test_the_watchdog_stops_the_motors_exactly_300_ms_after_the_line_took_effect() -> None:
    mcu, now_ns = FakeMcu(TRUE), 0
    mcu.receive(0, LINE)
    while not any(mcu.vehicle.set_points):
        now_ns = mcu.next_ns() or 0
        mcu.advance(now_ns)
    mcu.advance(now_ns + 300 * MS - 1)
    assert mcu.vehicle.set_points == SPEEDS
    mcu.advance(now_ns + 60_000 * MS)  # late
    assert mcu.vehicle.angles == pytest.approx([speed * 0.3 for speed in SPEEDS])
    mcu.receive(now_ns + 60_000 * MS, ZERO)
    mcu.advance(now_ns + 90_000 * MS)
    assert mcu.watchdog_trips == 1  # at rest it does not trip


@pytest.mark.parametrize(("early_ns", "speeds"), [(1, STILL), (0, SPEEDS)])
def test_a_reset_stops_the_motors_and_a_line_is_obeyed_from_its_exact_end(
    early_ns: int, speeds: list[float]
) -> None:
    mcu = FakeMcu(TRUE)
    drive(mcu, 0, 4)
    mcu.receive(40 * MS, LINE + LINE[:10])
    mcu.reset(41 * MS)
    assert mcu.vehicle.set_points == STILL
    noise = mcu.advance(41 * MS + RESET_NS - LINE_NS - early_ns)
    assert noise
    assert b"ap" not in noise
    mcu.receive(41 * MS + RESET_NS - LINE_NS - early_ns, LINE)
    mcu.advance(41 * MS + RESET_NS + 20 * MS)
    assert mcu.vehicle.set_points == speeds


# The lines of each firmware.

VALUES = {0: 12.5, 1: -8.75, 2: 15.0, 3: -10.25}


def closed(body: bytes) -> bytes:
    """Return the body with its correct checksum and a line end."""
    return b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


@each(
    ("line", "command"),
    [
        *((PLAIN + end, BoardCommand(VALUES)) for end in (b"\r\n", b"\n", b",\r\n", b",\n")),
        (closed(PLAIN + b"#07"), BoardCommand(VALUES, b"07")),
        (closed(PLAIN + b"#FFS"), BoardCommand(VALUES, b"FF", True)),
        (closed(PLAIN + b"#00GSZ"), BoardCommand(VALUES, b"00", True)),
        (closed(PLAIN + b",#A0S"), BoardCommand(VALUES, b"A0", True)),
        *((line, None) for line in (
            PLAIN + b"#07\r\n", PLAIN + b"*0000\r\n", closed(PLAIN), closed(PLAIN + b"#7"),
            closed(PLAIN + b"#0a"), closed(PLAIN + b"#07s"), closed(PLAIN + b"#07A"),
            closed(PLAIN + b"#07@"), closed(PLAIN + b"#07*"), closed(PLAIN[:-1] + b"#07"),
            closed(b"#07"), closed(PLAIN + b"#07")[:-3] + b"\r\n",
            closed(PLAIN + b"#07").replace(b"12.50", b"12.51"), closed(PLAIN + b"#07").lower(),
            b"\x00" + closed(PLAIN + b"#07"), b"", b"\r\n", b"?", PLAIN[:30], PLAIN[1:],
            b"\xff" * 50)),
    ],
)  # fmt: skip
def test_a_plain_or_a_checked_line_is_a_command_and_any_other_is_none(
    line: bytes, command: BoardCommand | None
) -> None:
    assert reference(line, "abcd") == command
    if b"#" not in line and b"*" not in line:
        assert plain_only(line, "abcd") == prefix(line, "abcd") == command


OF_TWO = b"lp12.50,rn08.75"
BOTH = {0: 12.5, 1: -8.75}


@each(
    ("line", "command"),
    [
        *((OF_TWO + end, BoardCommand(BOTH)) for end in (b"\r\n", b"\n", b",\r\n")),
        (closed(OF_TWO + b"#07S"), BoardCommand(BOTH, b"07", True)),
        *((line, None) for line in (
            OF_TWO + b"#07\r\n", closed(OF_TWO), closed(OF_TWO[:-1] + b"#07"), OF_TWO[:14],
            OF_TWO[1:], b"rn08.75,lp12.50\r\n", b"lp12.50\r\n", LINE)),
    ],
)  # fmt: skip
def test_a_board_of_two_motors_obeys_lines_with_their_two_values_only(
    line: bytes, command: BoardCommand | None
) -> None:
    assert reference(line, "lr") == command
    if b"#" not in line and b"*" not in line:
        assert plain_only(line, "lr") == prefix(line, "lr") == command


def test_replies_and_the_identity_line_are_written_as_the_firmware_writes_them() -> None:
    speeds = (12.5, -8.75, 0.0, -120.0)
    assert protocol.speeds_text("abcd", speeds, ",", False) == b"ap12.50,bn08.75,cp00.00,dn99.99"
    assert protocol.speeds_text("abcd", speeds, ", ", True) == b"ap12.50, bn8.75, cp0.00, dn99.99"
    assert protocol.speeds_text("lr", speeds[:2], ",", False) == b"lp12.50,rn08.75"
    sample = (65536 + 4000, 1, -1, 32768, -32769)
    for counts, suffix in (((), b"#07"), (sample, b"#07@0FA00001FFFF80007FFF")):
        assert PLAIN + protocol.suffix(PLAIN, b"07", counts) + b"\r\n" == closed(PLAIN + suffix)
    assert protocol.suffix(OF_TWO, b"07", sample[:3]) == closed(OF_TWO + b"#07@0FA00001FFFF")[15:-2]
    line = protocol.identity(3200, 300, sample=True)
    assert line == b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1\r\n"
    decoders = reference, prefix, plain_only
    assert [decode(line, "abcd") for decode in decoders] == [None] * 3


# The wire.


def test_a_line_is_answered_at_its_virtual_time_and_garbled_at_a_wrong_baud_rate() -> None:
    mcu = FakeMcu(Config())
    wire = VirtualWire(mcu, 1000)
    wire.open(115200)
    wire.send(ZERO)
    ((at_ns, data),) = wire.listen(20_000_000)
    assert data == ZERO
    assert 6_700_000 < at_ns < 11_000_000
    assert wire.listen(10) == []
    assert wire.now_ns() == 20_000_000
    wire.open(57600)
    wire.send(ZERO)
    assert wire.listen(70_000_000) == []
    with mcu.fault("wrong_baud", 57600):
        wire.send(b"\r\n" + ZERO)
        assert wire.listen(120_000_000)[0][1] == ZERO
    wire.close()
    with pytest.raises(AssertionError):
        wire.send(ZERO)


def waiting(handle: int) -> int:
    """Return the number of bytes that can be read."""
    count = bytearray(4)
    fcntl.ioctl(handle, termios.FIONREAD, count)
    return int.from_bytes(count, "little")


def test_a_simulator_that_stalled_obeys_the_newest_lines_only() -> None:
    async def stalls(count: int) -> FakeMcu:
        with SimPty(FakeMcu(Config(), clock.mono_ns())) as simulator:
            host = os.open(simulator.path, os.O_WRONLY | os.O_NOCTTY)
            for number in range(count):
                os.write(host, ZERO.replace(b"ap00", b"ap%02d" % number))
            # The kernel hands them over in pieces.
            while waiting(simulator._end.fileno()) < count * len(ZERO):
                time.sleep(0.001)
            while len(simulator.mcu.heard) < min(count, 7):
                await asyncio.sleep(0.01)
            os.close(host)
            return simulator.mcu

    for count, first in ((5, 0), (50, 43)):
        lines = [line for _, line in asyncio.run(asyncio.wait_for(stalls(count), 5.0)).heard]
        assert [int(line[2:4]) for line in lines] == list(range(first, count))


@each(("sent", "rx_rate"), list(permutations(get_args(Baud), 2)))
def test_at_a_wrong_baud_rate_no_line_survives(sent: int, rx_rate: int) -> None:
    assert garbled(ZERO, sent, sent) == garbled(ZERO, 115200, 117000) == ZERO
    data = garbled(ZERO * 5, sent, rx_rate)
    assert ZERO[:-2] not in data
    assert b"ap0" not in data
    # At 9600 baud 0x00 is nine low bits and a high one. At 19200 these are 18 low samples without a
    # stop bit in time. 0xff is one low bit. At 19200 it is a start bit, then a 0 and ones.
    assert garbled(b"\x00\xff", 9600, 19200)[:1] == b"\x00"
    assert garbled(b"\xff", 9600, 19200) == b"\xfe"


def test_a_line_of_more_motors_is_refused_but_not_one_that_is_only_too_long() -> None:
    assert plain_only(LINE, "ab") == prefix(LINE, "ab") == reference(LINE, "ab") is None
    assert prefix(b"ap12.50,bn08.75,ap12.50,bn08.75\r\n", "ab") == BoardCommand({0: 12.5, 1: -8.75})


def test_a_mute_board_does_not_answer_the_question_either() -> None:
    mcu = FakeMcu(TRUE)
    mcu.receive(0, b"?\r\n")
    assert replies(mcu, 100 * MS)
    with mcu.fault("mute"):
        mcu.receive(100 * MS, b"?\r\n")
        assert not replies(mcu, 200 * MS)
