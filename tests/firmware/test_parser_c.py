"""The firmware's parser accepts a whole line or refuses it, as the daemon's parser does.

The parser is compiled for this machine.
"""

from __future__ import annotations

import binascii
import random
import re
from collections.abc import Callable
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import WheelMap
from acsard.core.link.codec import Codec, FrameError
from acsard.core.link.lines import LineReader
from acsard.core.values import WheelSpeeds
from tests.each import each
from tests.firmware.board import Library, checked, read_identity, read_reply, speeds_line
from tests.vectors.lines import ACCEPTED, REFUSED, SEED_LINE, ZERO

pytestmark = pytest.mark.slow


class Command(NamedTuple):
    """The decoded fields of a line to the board."""

    hundredths: tuple[int, ...]
    checked: bool = False
    sample: bool = False
    sequence: int = 0


class Parser:
    """The firmware's C functions for lines, with Python types as arguments and results."""

    def __init__(self, library: Library) -> None:
        self._library, self._c = library, library.c
        self._command, self._reader = library.new("command"), library.new("line_reader")

    def parse(self, line: bytes) -> Command | None:
        """Decode a line. Return None, and check that nothing changes, if the parser refuses it."""
        command = self._command
        before = bytes(self._library.ffi.buffer(command))
        if not self._c.line_parse(line, len(line), command):
            assert bytes(self._library.ffi.buffer(command)) == before
            return None
        return Command(tuple(command.hundredths), command.checked, command.sample, command.sequence)

    def lines(self, data: bytes) -> list[bytes]:
        """Return the whole lines in these bytes. The reader stores an incomplete line."""
        feed, reader, buffer = self._c.line_feed, self._reader, self._library.ffi.buffer
        return [
            bytes(buffer(reader.text, length)) for byte in data if (length := feed(reader, byte))
        ]

    def stream(self, data: bytes) -> list[Command]:
        """Return the commands in a stream, read by a parser that has just started."""
        self._reader = self._library.new("line_reader")
        commands = [self.parse(line) for line in self.lines(data)]
        return [command for command in commands if command is not None]

    def asks(self, line: bytes) -> bool:
        return bool(self._c.line_asks(line, len(line)))

    @property
    def too_long(self) -> int:
        """Lines since the last `stream` began that were too long."""
        return int(self._reader.too_long)

    def identity(self, lines: int, refused: int, trips: int, runaways: int, reset: bytes) -> bytes:
        """Return the identity line, with CR LF."""
        record = self._library.new("record", [lines, refused, trips, runaways])
        return self._library.text(lambda out: self._c.line_identity(out, record, reset))

    def counted_up(self, count: int) -> int:
        """Return the counter after one more event. It stays at its largest value."""
        counter = self._library.ffi.new("uint16_t *", count)
        self._c.count_up(counter)
        return int(counter[0])

    def reply(self, command: Command, ms: int, counts: list[int], hundredths: list[int]) -> bytes:
        """Return the board's reply to this command, with CR LF."""
        asked = self._library.new("command", list(command))
        reading = self._library.new("reading", [ms, counts, hundredths])
        return self._library.text(lambda out: self._c.line_reply(out, asked, reading))


@pytest.fixture(scope="session")
def parser(library: Library) -> Parser:
    return Parser(library)


FIGURE = re.compile(rb"[pn]\d\d\.\d\d(?!\d)")


def parsed_speeds(line: bytes) -> tuple[int, ...] | None:
    """Return the speeds that the daemon's parser reads from a plain line, hundredths of a rad/s.

    Returns None unless each number has the daemon's format, because the board accepts no other.
    """
    if len(FIGURE.findall(line)) != 4:
        return None
    try:
        speeds = Codec(WheelMap()).decode(line)
    except FrameError:
        return None
    return tuple(round(speed * 100) for speed in speeds.as_tuple())


# plain lines: the host's language, with numbers of one form


@each(("line", "motors"), ACCEPTED)
def test_a_line_that_the_host_accepts_gives_the_same_values_or_is_refused(
    parser: Parser, line: bytes, motors: tuple[float, ...]
) -> None:
    usual = len(FIGURE.findall(line)) == 4
    same = Command(tuple(round(speed * 100) for speed in motors))
    assert parser.parse(line) == (same if usual else None)


@each("line", [line for line, _ in REFUSED])
def test_a_line_that_the_host_refuses_is_refused(parser: Parser, line: bytes) -> None:
    assert parser.parse(line) is None


MUTATIONS: list[Callable[[random.Random, bytes], bytes]] = [
    lambda r, line: line,
    lambda r, line: line[: r.randrange(len(line) + 1)],
    lambda r, line: line[r.randrange(len(line)) :],
    lambda r, line: line.replace(b",", r.choice([b", ", b",  ", b" ,", b";", b",,"])),
    lambda r, line: line + r.choice([b",", b", ", b" ", b",,", b"\r", b"0", b"\x00"]),
    lambda r, line: line.replace(r.choice([b"a", b"p", b".", b"0"]), r.choice([b"b", b"n", b""])),
    lambda r, line: _with(line, r.randrange(len(line)), r.randrange(256)),
    lambda r, line: line[: (at := r.randrange(len(line)))] + b"0" + line[at:],
    lambda r, line: b",".join(sorted(line.split(b","), key=lambda _: r.random())),
]


def _with(line: bytes, at: int, byte: int) -> bytes:
    return line[:at] + bytes([byte]) + line[at + 1 :]


@pytest.mark.slow
def test_mutated_lines_give_the_same_result_as_in_the_host_s_parser(parser: Parser) -> None:
    """Both parsers give the same result for valid lines with one to three changes."""
    rng = random.Random(1)
    valid_count = 0
    for _ in range(50_000):
        line = speeds_line([rng.choice([0.0, 9.99, -10.0, 99.99, -0.01, 12.5]) for _ in range(4)])
        for _ in range(rng.randrange(1, 4)):
            line = rng.choice(MUTATIONS)(rng, line) or line
        if b"#" in line or b"*" in line:
            continue
        command = parser.parse(line)
        assert (command and command.hundredths) == parsed_speeds(line), line
        valid_count += command is not None
    assert 5_000 < valid_count < 45_000, "both kinds"


wheels = st.builds(WheelSpeeds, *[st.floats(-101.0, 101.0)] * 4)


@given(wheels, st.booleans())
def test_every_line_the_host_writes_is_accepted_with_the_same_value(
    parser: Parser, speeds: WheelSpeeds, comma: bool
) -> None:
    line = Codec(WheelMap(), trailing_comma=comma).encode(speeds)
    (command,) = parser.stream(line)
    assert command == Command(parsed_speeds(line.rstrip(b"\r\n")) or ())


@given(wheels, st.booleans(), st.integers(0, 255), st.sampled_from(["", "S", "GS", "Z", "SS"]))
def test_a_checked_line_is_accepted_with_its_sequence_and_request(
    parser: Parser, speeds: WheelSpeeds, comma: bool, sequence: int, letters: str
) -> None:
    line = Codec(WheelMap(), trailing_comma=comma).encode(speeds).rstrip(b"\r\n")
    command = Command(parsed_speeds(line) or (), True, "S" in letters, sequence)
    assert parser.parse(checked(line, sequence, letters)) == command


@given(st.binary(max_size=300))
def test_a_stream_is_split_into_lines_as_on_the_host(parser: Parser, data: bytes) -> None:
    data = data.replace(b"\x07", b"\n")  # more of them than by chance
    reader = LineReader()
    parser.stream(b"\n")
    assert parser.lines(data) == [line for line, _ in reader.feed(data)]


def test_lines_of_128_bytes_or_more_are_counted_as_too_long(parser: Parser) -> None:
    parser.stream(b"a" * 1000 + b"\n" + ZERO + b"\n" + b"b" * 127 + b"\n" + b"c" * 128 + b"\n")
    assert parser.too_long == 2


def test_only_a_lone_question_mark_requests_the_identity(parser: Parser) -> None:
    assert parser.asks(b"?")
    assert not any(parser.asks(line) for line in (b"??", b" ?", b"? ", ZERO + b"?", b"!"))
    assert parser.parse(b"?") is None


# checked lines


WRONG_SUFFIXES = [
    b"#", b"*", b"*1234", b"#07*", b"#07*123", b"#7*1234", b"#07s*1234",
    b"#07F*1234", b"#07 *1234", b"#07*1234 ", b"#07*1234*1234", b"#07#07*1234", b"@0000",
    b"#07S\x00*1234", b"#0", b"#7", b"#007", b"#0a", b"#07F", b"#07s", b"#07 ", b"#07S0", b" #07",
    b"#07#07", b"#07S\x00", b",,#07", b"#07@0000", b",ap00.00#07",
]  # fmt: skip


@each("suffix", WRONG_SUFFIXES)
def test_a_line_with_a_wrong_suffix_is_refused_even_if_its_check_is_right(
    parser: Parser, suffix: bytes
) -> None:
    head = ZERO + suffix
    assert parser.parse(head) is None
    assert parser.parse(head + b"*%04X" % binascii.crc_hqx(head, 0)) is None


def test_lower_case_and_a_wrong_check_are_refused(parser: Parser) -> None:
    right = checked(SEED_LINE, 0xAB, "S")
    assert parser.parse(right) is not None
    assert parser.parse(right[:-4] + right[-4:].lower()) is None or right[-4:].isdigit()
    assert parser.parse(right.replace(b"#AB", b"#ab")) is None
    for wrong in range(1, 65536, 97):
        crc = int(right[-4:], 16) ^ wrong
        assert parser.parse(right[:-4] + b"%04X" % crc) is None


def flipped(rng: random.Random, checked_lines: bool) -> tuple[bytes, list[tuple[int, ...]]]:
    """Return three random lines, one bit of the second one inverted, and the intended speeds."""
    sent, data = [], []
    for i in range(3):
        hundredths = [rng.randrange(-9999, 10000) for _ in range(4)]
        line = speeds_line([value / 100 for value in hundredths])
        sent.append(tuple(hundredths))
        if checked_lines:
            line = checked(line, rng.randrange(256), rng.choice(["", "S"]))
        data.append(line + b"\r\n")
        if i == 1:
            bit = rng.randrange(8 * len(data[1]))
            data[1] = _with(data[1], bit // 8, data[1][bit // 8] ^ (1 << bit % 8))
    return b"".join(data), sent


def wrong_values(parser: Parser, count: int, checked_lines: bool) -> int:
    """Return how many of `count` single-bit errors make the parser accept unsent speeds."""
    rng = random.Random(count)
    wrong = 0
    for _ in range(count):
        data, sent = flipped(rng, checked_lines)
        wrong += any(command.hundredths not in sent for command in parser.stream(data))
    return wrong


@pytest.mark.parametrize("count", [3_000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_no_single_bit_error_in_checked_lines_puts_a_wrong_speed_in_force(
    parser: Parser, count: int
) -> None:
    assert wrong_values(parser, count, checked_lines=True) == 0
    plain = wrong_values(parser, count, checked_lines=False)
    print(f"single-bit errors: 0 of {count} checked lines wrong; plain {100 * plain / count:.1f} %")
    assert plain, "the same errors must be seen in plain lines"


def test_no_part_of_a_line_is_valid_after_a_byte_became_a_line_end(parser: Parser) -> None:
    """Damage turns one byte of a line into a line end, and neither part is then a valid line.

    There is one exception. If the `#` before the suffix becomes a line end, the plain line remains.
    That needs at least two bit errors.
    """
    for line in (checked(SEED_LINE, 7, "S"), checked(SEED_LINE + b",", 7), SEED_LINE):
        (whole,) = parser.stream(line + b"\r\n")
        for at in range(len(line)):
            for end in (b"\n", b"\r\n", b"\r"):
                commands = parser.stream(line[:at] + end + line[at + 1 :] + b"\r\n")
                if line[:at] in (SEED_LINE, SEED_LINE + b",") and end != b"\r":
                    assert [command.hundredths for command in commands] == [whole.hundredths]
                else:
                    assert not commands, (line, at, end)


# the identity


counters = st.one_of(st.integers(0, 1100), st.integers(0, 65535))


@given(st.integers(0, 2**32 - 1), counters, counters, counters)
def test_the_identity_line_is_readable_by_the_host_and_not_taken_for_feedback(
    parser: Parser, lines: int, refused: int, trips: int, runaways: int
) -> None:
    line = parser.identity(lines, refused, trips, runaways, b"brown-out")
    fields = (lines, min(refused, 999), min(trips, 999), min(runaways, 9), "brown-out")
    assert read_identity(line.removesuffix(b"\r\n"))[4:] == fields
    ((text, _),) = LineReader().feed(line)
    assert text.startswith(b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1 ")
    with pytest.raises(FrameError):
        Codec(WheelMap()).decode(text)


def test_counts_configured_as_a_product_are_reported_as_a_number(coarse_library: Library) -> None:
    assert b" counts=96 " in Parser(coarse_library).identity(0, 0, 0, 0, b"pin")


def test_a_full_counter_stays_at_its_maximum(parser: Parser) -> None:
    assert [parser.counted_up(count) for count in (0, 65534, 65535)] == [1, 65535, 65535]


# replies


@given(
    st.lists(st.integers(-9999, 9999), min_size=4, max_size=4),
    st.lists(st.integers(0, 65535), min_size=4, max_size=4),
    st.integers(0, 65535), st.integers(0, 255), st.booleans(), st.booleans(),
)  # fmt: skip
def test_a_reply_has_the_values_it_was_given(
    parser: Parser,
    hundredths: list[int],
    counts: list[int],
    milliseconds: int,
    sequence: int,
    check: bool,
    sample: bool,
) -> None:
    command = Command((0,) * 4, check, sample, sequence)
    line = parser.reply(command, milliseconds, counts, hundredths)
    assert line.endswith(b"\r\n")
    assert len(line) == (33 if not check else 62 if sample else 41)
    reply = read_reply(line[:-2])
    assert [round(speed * 100) for speed in reply.speeds] == hundredths
    assert reply.sequence == (sequence if check else None)
    if check and sample:
        assert reply.milliseconds == milliseconds
        assert list(reply.counts) == counts
    assert parsed_speeds(line[:31]) == tuple(hundredths)
