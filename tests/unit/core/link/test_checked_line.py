"""The suffix of a checked line is built exactly, and is accepted only if all of it is right."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.checked_line import Checked, Reading, seal, unseal
from acsard.core.link.codec import FrameError
from acsard.core.link.lines import MAX_LINE_BYTES
from tests.each import each
from tests.vectors.lines import SEED_LINE

PLAIN = SEED_LINE + b"\r\n"
REPLY = b"ap12.50,bn08.75,cp15.00,dn10.25#07*585F"
SAMPLE = b"ap12.50,bn08.75,cp15.00,dn10.25#07@0FA00001FFFF80007FFF*0000"


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


def reason(line: bytes) -> str:
    with pytest.raises(FrameError) as caught:
        unseal(line)
    return caught.value.reason


def test_the_crc_matches_the_check_value_of_its_catalogue() -> None:
    assert crc(b"123456789") == 0x31C3
    assert seal(b"123456789\r\n", 0)[:12] == b"123456789#00"


@pytest.mark.parametrize(
    ("sequence", "letters", "suffix"),
    [(0, b"", b"#00"), (7, b"", b"#07"), (255, b"S", b"#FFS"), (171, b"S", b"#ABS")],
)
def test_a_sealed_command_is_the_line_followed_by_its_suffix_and_check(
    sequence: int, letters: bytes, suffix: bytes
) -> None:
    assert seal(PLAIN, sequence, letters) == closed(SEED_LINE + suffix) + b"\r\n"


def test_the_comma_of_the_dialect_stays_before_the_suffix() -> None:
    assert seal(SEED_LINE + b",\r\n", 7) == closed(SEED_LINE + b",#07") + b"\r\n"


def test_a_sealed_command_has_41_bytes_and_42_with_a_request() -> None:
    assert (len(seal(PLAIN, 7)), len(seal(PLAIN, 7, b"S"))) == (41, 42)


def test_the_example_of_the_protocol_is_right() -> None:
    assert closed(REPLY[:-5]) == REPLY
    assert unseal(REPLY) == Checked(SEED_LINE, 7, None)


def test_a_sampled_reply_contains_milliseconds_and_four_counts() -> None:
    line = closed(SAMPLE[:-5])
    assert len(line) + 2 == 62 < MAX_LINE_BYTES
    reading = Reading(0x0FA0, (0x0001, 0xFFFF, 0x8000, 0x7FFF))
    assert unseal(line) == Checked(SEED_LINE, 7, reading)


@given(sequence=st.integers(0, 255), text=st.text("abcdnp0123456789., ", max_size=60))
def test_unsealing_returns_the_sealed_line(sequence: int, text: str) -> None:
    sealed = seal(text.encode() + b"\r\n", sequence)
    assert unseal(sealed.removesuffix(b"\r\n")) == Checked(text.encode(), sequence, None)


@each("line", [SEED_LINE, SEED_LINE + b",", b"", b"hello", SEED_LINE[:9]])
def test_a_line_without_suffix_is_unchecked(line: bytes) -> None:
    assert reason(line) == "without_crc"


@each(
    "body",
    [
        SEED_LINE + b"#0",
        SEED_LINE + b"#",
        SEED_LINE,  # a line with neither check nor sequence
        SEED_LINE + b"#7A7",
        SEED_LINE + b"#0a",
        SEED_LINE + b"#0x",
        SEED_LINE + b"#07S",  # an echo of the host's own question
        SEED_LINE + b"# 7",
        SEED_LINE + b"#07@",
        SEED_LINE + b"#07@0FA00001FFFF80007FF",
        SEED_LINE + b"#07@0FA00001FFFF80007FFF0",
        SEED_LINE + b"#07@0fa00001ffff80007fff",
        SEED_LINE + b"#07#08",
        SEED_LINE + b"*#07",
        SEED_LINE + b"#07*0000",
        b"\x00\x00" + SEED_LINE + b"#07",  # the check alone does not detect this
    ],
)
def test_a_suffix_of_another_form_is_wrong_even_under_a_right_check(body: bytes) -> None:
    assert reason(closed(body)) == "crc_error"


@each(
    "line",
    [REPLY[:-1], REPLY + b"1", REPLY + b" ", REPLY + b",", b" " + REPLY, REPLY.lower(),
     REPLY[:-4] + b"585f", REPLY[:-5], REPLY[:-4], REPLY + REPLY, b"\x00" + REPLY],
)  # fmt: skip
def test_anything_but_the_exact_line_is_wrong(line: bytes) -> None:
    assert reason(line) == "crc_error"


@pytest.mark.parametrize("line", [REPLY, closed(SAMPLE[:-5])], ids=["checked", "sampled"])
def test_no_single_or_double_bit_error_leaves_a_right_line(line: bytes) -> None:
    bits = len(line) * 8
    number = int.from_bytes(line, "big")
    singles = [1 << bit for bit in range(bits)]
    doubles = [1 << bit | 1 << (bit * 7 + 3) % bits for bit in range(bits)]
    for error in singles + [e for e in doubles if e & (e - 1)]:
        damaged = (number ^ error).to_bytes(len(line), "big")
        assert reason(damaged) in ("crc_error", "without_crc")


@given(line=st.binary(max_size=80))
def test_noise_is_refused_and_raises_nothing_else(line: bytes) -> None:
    assert reason(line) in ("crc_error", "without_crc")
