"""Tests of the wire in virtual time."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import Config, WheelMap
from acsard.core.link.codec import Codec
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire

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
