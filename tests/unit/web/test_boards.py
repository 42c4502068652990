"""Tests of the ports that the page offers for a check."""

from __future__ import annotations

import pytest

from acsard.host.processes import Holder
from acsard.machine.serial_ports import SerialDevice
from acsard.web.guide import boards

MEGA = SerialDevice(
    "/dev/ttyACM0", ["/dev/acsar"], "cdc_acm", "2341:0042", "", "Arduino Mega 2560 R3", []
)
HELD = SerialDevice("/dev/ttyUSB0", [], "ch341", "", "USB Serial", "", [Holder(7, "acsard")])


@pytest.mark.parametrize("configured", ["/dev/acsar", "/dev/ttyACM0"])
def test_the_configured_one_stands_under_its_configured_name(
    configured: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA, HELD])
    found = {one.port: one.what for one in boards(configured)}
    assert found == {
        configured: "Arduino Mega 2560 R3, configured",
        "/dev/ttyUSB0": "USB Serial, in use by acsard (process 7)",
        "sim": "the simulator: no real robot moves",
    }


def test_one_that_is_not_there_is_offered_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA])
    first = boards("/dev/none")[0]
    assert (first.port, first.what) == ("/dev/none", "configured, not there now")


def test_the_simulator_is_there_once_whatever_is_configured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", list)
    assert [one.port for one in boards("sim")] == ["sim"]


@pytest.mark.parametrize("configured", ["sim", "/dev/ttyUSB0"])
def test_the_configured_one_is_the_first_choice(
    configured: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page that shows the simulator must not select a real port by itself."""
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA, HELD])
    assert boards(configured)[0].port == configured
