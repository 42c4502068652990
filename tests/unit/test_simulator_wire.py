"""The wire in virtual time, and bytes that are received at the wrong baud rate."""

from __future__ import annotations

from itertools import permutations
from typing import get_args

import pytest

from acsard.core.config.settings import Baud, Config, WheelMap
from acsard.core.link.codec import Codec
from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire
from tests.each import each

LINE = Codec(WheelMap()).stop


def test_a_line_is_answered_at_its_virtual_time() -> None:
    wire = VirtualWire(FakeMcu(Config()), 1000)
    wire.open(115200)
    wire.send(LINE)
    ((at_ns, data),) = wire.listen(20_000_000)
    assert data == LINE
    assert 6_700_000 < at_ns < 11_000_000
    assert wire.now_ns() == 20_000_000
    assert wire.listen(10) == []
    assert wire.now_ns() == 20_000_000


def test_a_line_at_a_wrong_baud_rate_is_garbled() -> None:
    mcu = FakeMcu(Config())
    wire = VirtualWire(mcu)
    wire.open(57600)
    wire.send(LINE)
    assert wire.listen(50_000_000) == []
    assert mcu.valid_lines == 0
    with mcu.wrong_baud(57600):
        wire.send(b"\r\n" + LINE)
        assert wire.listen(100_000_000)[0][1] == LINE


def test_sending_on_a_closed_wire_raises_an_error() -> None:
    wire = VirtualWire(FakeMcu(Config()))
    wire.open(115200)
    wire.close()
    with pytest.raises(AssertionError):
        wire.send(LINE)


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
