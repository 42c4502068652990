"""The checked link: a suffix that is exactly right, one reply for each line, and counts."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import FeedbackConfig, McuConfig, WheelMap
from acsard.core.link.board_counts import Encoders, Turned, Unknown
from acsard.core.link.checked_line import Checked, Reading, seal, unseal
from acsard.core.link.codec import FrameError
from acsard.core.link.lines import MAX_LINE_BYTES
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import BAD_LINES
from tests.each import each
from tests.unit.link_bench import BAD, CHECKED, GOOD, MS, PLAIN, LinkBench
from tests.vectors.lines import SEED_LINE, ZERO
from tests.wheels import FOUR, MAPS

law = settings(max_examples=100)
REPLY = b"ap12.50,bn08.75,cp15.00,dn10.25#07*585F"
SAMPLE = b"ap12.50,bn08.75,cp15.00,dn10.25#07@0FA00001FFFF80007FFF"
SAMPLE_OF_TWO = b"lp12.50,rn08.75#07@0FA00001FFFF"


def crc(data: bytes) -> int:
    """Return CRC-16/XMODEM by its definition: bit by bit, x16 + x12 + x5 + 1, from 0."""
    register = 0
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ (0x11021 if register & 0x8000 else 0)
    return register


def closed(body: bytes) -> bytes:
    """Return the body with its correct checksum, even if the body itself is wrong."""
    return b"%b*%04X" % (body, crc(body))


def reason(line: bytes, motors: int = 4) -> str:
    with pytest.raises(FrameError) as caught:
        unseal(line, motors)
    return caught.value.reason


@each(
    ("body", "sequence", "letters", "suffix"),
    [
        (SEED_LINE, 0, b"", b"#00"), (SEED_LINE, 7, b"", b"#07"), (SEED_LINE, 255, b"S", b"#FFS"),
        (SEED_LINE, 171, b"S", b"#ABS"),
        (SEED_LINE + b",", 7, b"", b"#07"),  # the comma of the dialect stays before it
        (b"lp12.50,rn08.75", 7, b"S", b"#07S"),
    ],
)  # fmt: skip
def test_a_sealed_command_is_the_line_followed_by_its_suffix_and_check(
    body: bytes, sequence: int, letters: bytes, suffix: bytes
) -> None:
    sealed = seal(body + b"\r\n", sequence, letters)
    assert sealed == closed(body + suffix) + b"\r\n"
    assert len(sealed) == len(body) + 10 + len(letters)


def test_the_examples_of_the_protocol_are_right() -> None:
    assert crc(b"123456789") == 0x31C3  # the check value of the catalogue
    assert closed(REPLY[:-5]) == REPLY
    assert unseal(REPLY, 4) == Checked(SEED_LINE, 7, None)
    line = closed(SAMPLE)
    assert len(line) + 2 == 62 < MAX_LINE_BYTES
    reading = Reading(0x0FA0, (0x0001, 0xFFFF, 0x8000, 0x7FFF))
    assert unseal(line, 4) == Checked(SEED_LINE, 7, reading)
    of_both = closed(SAMPLE_OF_TWO)
    assert unseal(of_both, 2) == Checked(b"lp12.50,rn08.75", 7, Reading(0x0FA0, (0x0001, 0xFFFF)))
    # The counts of another number of motors.
    assert reason(line, 2) == reason(of_both, 4) == "malformed"


@each(
    "suffix",
    [
        b"#0", b"#", b"", b"#7A7", b"#0a", b"#0x", b"# 7", b"#07@", b"#07#08", b"*#07", b"#07*0000",
        b"#07S",  # an echo of the host's own question
        b"#07@0FA00001FFFF80007FF", b"#07@0FA00001FFFF80007FFF0", b"#07@0fa00001ffff80007fff",
    ],
)  # fmt: skip
def test_a_suffix_of_another_form_is_wrong_even_under_a_right_check(suffix: bytes) -> None:
    assert reason(closed(SEED_LINE + suffix)) == "crc_error"
    # The check alone does not detect leading zeros.
    assert reason(closed(b"\0\0" + SEED_LINE + b"#07")) == "crc_error"


@each(("line", "motors"), [(REPLY, 4), (closed(SAMPLE), 4), (closed(SAMPLE_OF_TWO), 2)])
def test_no_single_or_double_bit_error_leaves_a_right_line(line: bytes, motors: int) -> None:
    bits = len(line) * 8
    number = int.from_bytes(line, "big")
    singles = [1 << bit for bit in range(bits)]
    doubles = [1 << bit | 1 << (bit * 7 + 3) % bits for bit in range(bits)]
    for error in singles + [e for e in doubles if e & (e - 1)]:
        damaged = (number ^ error).to_bytes(len(line), "big")
        assert reason(damaged, motors) in ("crc_error", "without_crc")


@law
@given(line=st.binary(max_size=80))
def test_noise_is_refused_and_raises_nothing_else(line: bytes) -> None:
    assert reason(line) in ("crc_error", "without_crc")


# the session


def test_the_first_right_reply_opens_a_checked_link_and_plain_ones_never() -> None:
    bench = LinkBench(CHECKED).open()
    bench.wait(10)
    bench.talk(count=2)
    assert (bench.link, bench.session.good_lines) == ("booting", 0)
    bench.talk()
    assert (bench.link, bench.session.good_lines) == ("up", 1)
    bench, events = LinkBench(CHECKED).open(), []
    for _ in range(300):
        bench.wait(10, GOOD)
        line = bench.line()
        assert line is None or line.startswith((ZERO, b"?"))
        assert bench.link == "booting"
        events += bench.session.events
    assert bench.session.good_lines == 0
    (outcome,) = [event for event in events if event.name == "link_check"]
    assert (outcome.level, outcome.code, bench.why.code) == ("error", "no_checksum", "no_checksum")
    assert 'mcu.link_check = "off"' in bench.why.text
    bench.wait(100)
    bench.wait(10, bench.answer(bench.line()))  # other firmware was flashed
    assert bench.link == "up"


@each(
    ("mcu", "first", "code", "named"),
    [
        (CHECKED, GOOD, "no_checksum", True),  # it ignores checked lines, not the first stop
        (CHECKED, b"", "received_nothing", True),
        (PLAIN, b"", "received_nothing", False),
    ],
)
def test_a_board_that_does_not_answer_is_told_by_a_reason_with_the_setting(
    mcu: McuConfig, first: bytes, code: str, named: bool
) -> None:
    bench = LinkBench(mcu).open()
    bench.wait(10)
    bench.wait(10, *([first] if first else []))
    for _ in range(320):
        bench.line()
        bench.wait(10)
    assert bench.why.code == code
    assert ("mcu.link_check" in bench.why.text) is named


@each("counts", [0, 3200])
def test_a_board_without_counts_is_reported_only_if_counts_are_configured(counts: int) -> None:
    bench, names = LinkBench(McuConfig(link_check="on", encoder_counts=counts)).open(), list[str]()
    bench.wait(10)
    for _ in range(20):
        bench.talk()
        names += bench.names
    assert names.count("link_check") == bool(counts)


@each(
    ("line", "reason"),
    [
        (GOOD, "without_crc"),
        (seal(GOOD, 200), "stale_sequence"),
        (seal(GOOD, 1).replace(b"12.50", b"12.51"), "crc_error"),
        (seal(b"ap12.50\r\n", 1), "malformed"),
        (b"x" * 200 + b"\n", "too_long"),
    ],
)
def test_a_reply_without_a_right_suffix_is_dropped_and_counted(line: bytes, reason: str) -> None:
    bench = LinkBench(CHECKED).checked()
    bench.session.rejects.clear()
    assert bench.wait(1, line) == []
    assert (bench.session.rejects, bench.link) == ({reason: 1}, "up")


def test_replies_that_arrive_twice_count_once_and_pipelined_ones_each() -> None:
    bench, samples = LinkBench(CHECKED).checked(), []
    for n in range(20):
        reply = bench.answer(bench.line())
        samples += bench.wait(10, *([reply * 2] if n % 2 else [reply, reply * 9]))
        assert bench.names == []
    assert [sample.bridged for sample in samples] == [0.0] * 20
    assert (bench.session.rejects, bench.link) == ({"repeated": 10 + 90}, "up")
    replies = []
    for _ in range(4):
        replies.append(bench.answer(bench.line()))
        bench.wait(10)
    assert len(bench.wait(1, b"".join(replies))) == 4


def test_five_bad_replies_in_a_row_end_the_link_until_the_next_right_one() -> None:
    bench = LinkBench(CHECKED).checked()
    for _ in range(50):
        bench.wait(10, BAD * (BAD_LINES - 1) + bench.answer(bench.line()))
    bench.wait(1, BAD * (BAD_LINES - 1))
    assert bench.link == "up"
    bench.wait(1, BAD)
    assert (bench.link, bench.why.code) == ("stale", "replies_damaged")
    bench.talk()
    assert bench.link == "up"


# counts and the board's clock, both modulo 65536

COUNTS = 3200
FASTEST = 80.0
"""Fastest wheel speed, rad/s: 40744 counts a second, half a wrap in 0.8 s."""
WRAP_MS = 32768 / (FASTEST / math.tau * COUNTS) * 1000


class Board:
    """The readings of a board, and the host's time of each reading."""

    def __init__(self, wheels: WheelMap = FOUR) -> None:
        self.motors = len(wheels.names)
        mcu = McuConfig(link_check="on", encoder_counts=COUNTS, wheels=wheels)
        self.setup = LinkSetup.of(mcu, 100.0, FeedbackConfig(wheel_speed=FASTEST))
        self.encoders, self.mcu_ms, self.at_ms = Encoders(), 60_000.0, 5_000.0
        self.counts = [65_000, 100, 32_768, 0][: self.motors]
        assert self.read() == "unknown"

    def read(
        self, mcu_ms: float = 10, counts: tuple[int, ...] = (), host_ms: float | None = None
    ) -> Turned | Unknown:
        """Advance both clocks and the counts by these amounts and return the result."""
        self.mcu_ms += mcu_ms
        self.at_ms += mcu_ms if host_ms is None else host_ms
        moved = counts or (0,) * self.motors
        self.counts = [c + m for c, m in zip(self.counts, moved, strict=True)]
        read = tuple(count % 65536 for count in self.counts)
        reading = Reading(int(self.mcu_ms) % 65536, read)
        return self.encoders.turned(self.setup, reading, int(self.at_ms * MS))

    def goes_on(self) -> bool:
        five = (5,) * self.motors
        return self.read(10, five) == turned(*five)


def turned(*counts: int, dt: float = 0.01) -> Turned:
    return Turned(tuple(count * (math.tau / COUNTS) for count in counts), dt)


@each("wheels", MAPS)
@each(
    ("mcu_ms", "counts", "host_ms"),
    [
        (200, (COUNTS, -COUNTS, COUNTS // 2, 0), 200),
        (0, (0, 0, 0, 0), 3),
        *[(10, (50, 50, 50, 50), host_ms) for host_ms in (0, 5.4, 10, 50, 700)],
        (int(WRAP_MS) - 4, (-900, 0, 0, 900), int(WRAP_MS) - 4),  # no count can have wrapped
        (109, (0, 0, 0, 0), 10),  # as far as the board's clock may be ahead
    ],
)
def test_a_reading_gives_the_turned_angles_whenever_the_host_reads_it(
    mcu_ms: int, counts: tuple[int, ...], host_ms: float, wheels: WheelMap
) -> None:
    board = Board(wheels)
    counts = counts[: board.motors]
    assert board.read(mcu_ms, counts, host_ms) == turned(*counts, dt=mcu_ms / 1000)


@law
@given(
    steps=st.lists(
        st.tuples(st.integers(1, 400), st.floats(-1.0, 1.0), st.floats(0.0, 300.0)), max_size=40
    )
)
def test_the_angles_add_up_over_any_number_of_wraps(
    steps: list[tuple[int, float, float]],
) -> None:
    board, late_ms, total, clock = Board(), 0.0, [0.0] * 4, 0.0
    began = list(board.counts)
    for ms, share, later_ms in steps:
        moved = int(share * FASTEST / math.tau * COUNTS * ms / 1000)
        host_ms = max(0.0, ms + later_ms - late_ms)  # each reading has a different delay
        late_ms += host_ms - ms
        result = board.read(ms, (moved, -moved, moved // 2, 0), host_ms)
        assert isinstance(result, Turned)
        total = [t + m for t, m in zip(total, result.motors, strict=True)]
        clock += result.dt
    counted = [now - then for now, then in zip(board.counts, began, strict=True)]
    assert total == pytest.approx([c * math.tau / COUNTS for c in counted], abs=1e-6)
    assert clock == pytest.approx(sum(ms for ms, _, _ in steps) / 1000)


@each(
    ("mcu_ms", "host_ms", "result"),
    [
        # A gap in which a count could have wrapped; a clock that is ahead, or went back.
        (810, 810, "unknown"), (10, 810, "unknown"), (810, 780, "unknown"),
        (9000, 9000, "unknown"), (200_000, 200_000, "unknown"), (111, 10, "restarted"),
        (-60_010, 30, "restarted"),
    ],
)  # fmt: skip
def test_what_no_reading_can_tell(mcu_ms: float, host_ms: float, result: str) -> None:
    board = Board()
    assert board.read(mcu_ms, (1, 1, 1, 1), host_ms) == result
    assert board.goes_on()
    board.mcu_ms = 0.0
    assert board.read(3, host_ms=10.0) == "restarted"
    board.encoders.forget()
    assert board.read(10, (50, 50, 50, 50)) == "unknown"
    assert board.goes_on()


@each(("wheels", "motor"), [(wheels, n) for wheels in MAPS for n in range(len(wheels.names))])
@each("sign", [1, -1])
def test_a_movement_beyond_five_times_the_fastest_speed_is_a_leap(
    wheels: WheelMap, motor: int, sign: int
) -> None:
    # Less may be a wrong setting. Two ms of rounding and four counts of play.
    board, moved = Board(wheels), [0] * len(wheels.names)
    moved[motor] = sign * (int(5.0 * FASTEST / math.tau * COUNTS * 0.012) + 4)
    assert isinstance(board.read(10, tuple(moved)), Turned)
    moved[motor] *= 2
    moved[motor] += 2 * sign
    assert board.read(10, tuple(moved)) == "leap"
    assert board.goes_on()


@law
@given(old_ms=st.integers(0, 65535), since_ms=st.integers(0, 90), host_ms=st.integers(1, 100))
def test_a_restart_is_missed_only_if_the_boards_clock_happens_to_match(
    old_ms: int, since_ms: int, host_ms: int
) -> None:
    encoders, setup = Encoders(), Board().setup
    encoders.turned(setup, Reading(old_ms, (9, 9, 9, 9)), 0)
    result = encoders.turned(setup, Reading(since_ms, (0, 0, 0, 0)), host_ms * MS)
    missed = (since_ms - old_ms) % 65536 <= host_ms + 100  # it was up for a whole number of 65.5 s
    assert (result == "restarted") is not missed
