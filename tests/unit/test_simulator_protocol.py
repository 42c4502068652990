"""Tests of the lines that each firmware accepts as commands, and of its exact answers."""

from __future__ import annotations

import binascii

from acsard.core.simulator import protocol
from acsard.core.simulator.protocol import Command, latched, plain_only, prefix, reference
from tests.each import each

PLAIN = b"ap12.50,bn08.75,cp15.00,dn10.25"
VALUES = {0: 12.5, 1: -8.75, 2: 15.0, 3: -10.25}
END = b"\r\n"


def closed(body: bytes) -> bytes:
    """Return the body with its correct checksum and a line end."""
    return b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


@each("end", [END, b"\n", b",\r\n", b",\n"])
def test_every_parser_accepts_a_plain_line(end: bytes) -> None:
    assert reference(PLAIN + end) == plain_only(PLAIN + end) == Command(VALUES)
    assert prefix(PLAIN + end) == Command(VALUES)
    assert latched(PLAIN + b",").values == VALUES


@each(
    ("suffix", "sequence", "sample"),
    [
        (b"#07", b"07", False),
        (b"#FFS", b"FF", True),
        (b"#00GSZ", b"00", True),
        (b",#A0S", b"A0", True),
    ],
)
def test_a_checked_line_is_parsed_with_its_sequence_and_requests(
    suffix: bytes, sequence: bytes, sample: bool
) -> None:
    assert reference(closed(PLAIN + suffix)) == Command(VALUES, sequence, sample)


@each(
    "line",
    [
        PLAIN + b"#07" + END,
        PLAIN + b"*0000" + END,
        closed(PLAIN),
        closed(PLAIN + b"#7"),
        closed(PLAIN + b"#0a"),
        closed(PLAIN + b"#07s"),
        closed(PLAIN + b"#07A"),
        closed(PLAIN + b"#07@"),
        closed(PLAIN + b"#07*"),
        closed(PLAIN[:-1] + b"#07"),
        closed(b"#07"),
        closed(PLAIN + b"#07")[:-3] + END,
        closed(PLAIN + b"#07").replace(b"12.50", b"12.51"),
        closed(PLAIN + b"#07").lower(),
        b"\x00" + closed(PLAIN + b"#07"),
    ],
)
def test_a_line_with_any_error_in_its_suffix_is_refused(line: bytes) -> None:
    assert reference(line) is None


def test_the_old_firmwares_obey_a_checked_line_as_a_plain_one() -> None:
    assert prefix(closed(PLAIN + b"#07S")) == Command(VALUES)
    assert latched(closed(PLAIN + b",#07S")).values == VALUES
    assert latched(closed(PLAIN + b"#07S")).values == {0: 12.5, 1: -8.75, 2: 15.0}
    assert plain_only(closed(PLAIN + b"#07")) is None


@each("line", [b"", b"\r\n", b"?", PLAIN[:30], PLAIN[1:], b"\xff" * 50])
def test_data_that_are_not_a_line_are_refused(line: bytes) -> None:
    assert reference(line) is plain_only(line) is prefix(line) is None


def test_a_reply_is_written_with_or_without_padding() -> None:
    speeds = (12.5, -8.75, 0.0, -120.0)
    assert protocol.speeds_text(speeds, ",", False) == b"ap12.50,bn08.75,cp00.00,dn99.99"
    assert protocol.speeds_text(speeds, ", ", True) == b"ap12.50, bn8.75, cp0.00, dn99.99"


def test_the_suffix_of_a_reply_contains_its_check_and_sample() -> None:
    assert PLAIN + protocol.suffix(PLAIN, b"07", ()) + END == closed(PLAIN + b"#07")
    sample = (65536 + 4000, 1, -1, 32768, -32769)
    assert PLAIN + protocol.suffix(PLAIN, b"07", sample) + END == closed(
        PLAIN + b"#07@0FA00001FFFF80007FFF"
    )


def test_the_identity_line_names_the_firmware_and_is_not_a_command() -> None:
    line = protocol.identity(3200, 300, sample=True)
    assert line == b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1\r\n"
    assert reference(line) is prefix(line) is plain_only(line) is None
