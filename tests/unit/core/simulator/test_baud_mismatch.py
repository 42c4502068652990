"""Tests of bytes that are received at the wrong baud rate."""

from __future__ import annotations

from itertools import permutations
from typing import get_args

from acsard.core.config.settings import Baud, WheelMap
from acsard.core.link.codec import Codec
from acsard.core.simulator.baud_mismatch import garbled
from tests.each import each

LINE = Codec(WheelMap()).stop


def test_at_the_right_baud_rate_data_are_unchanged() -> None:
    assert garbled(LINE, 9600, 9600) == LINE
    assert garbled(b"", 9600, 115200) == b""


@each(("sent", "rx_rate"), list(permutations(get_args(Baud), 2)))
def test_at_a_wrong_baud_rate_no_line_survives(sent: int, rx_rate: int) -> None:
    data = garbled(LINE * 5, sent, rx_rate)
    assert LINE[:-2] not in data
    assert b"ap0" not in data


def test_a_byte_read_at_twice_its_baud_rate_is_resampled_bit_by_bit() -> None:
    # At 9600 baud 0x00 is nine low bits and a high one. At 19200 these are 18 low samples without a
    # stop bit in time.
    assert garbled(b"\x00", 9600, 19200) == b"\x00"
    # At 9600 baud 0xff is one low bit. At 19200 it is a start bit, then a 0 and ones.
    assert garbled(b"\xff", 9600, 19200) == b"\xfe"


def test_a_baud_rate_that_is_nearly_right_changes_no_data() -> None:
    assert garbled(LINE, 115200, 117000) == LINE
