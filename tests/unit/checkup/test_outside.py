"""Objects handed to the check satisfy the protocols that it requires."""

from __future__ import annotations

from acsard.checkup.outside import Operator, Wire
from acsard.config.settings import Config
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.virtual_wire import VirtualWire
from tests.unit.checkup.robots import Nobody


def test_the_virtual_wire_is_a_wire_and_nobody_an_operator() -> None:
    wire: Wire = VirtualWire(FakeMcu(Config()))
    operator: Operator = Nobody()
    assert wire.now_ns() == 0
    assert operator.ask("lifted?", ("lifted",)) == "lifted"
    assert operator.ask("which?", ("this", "that")) is None
