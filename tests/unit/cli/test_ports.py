"""Tests of the text that `acsard ports` prints about the ports it finds."""

from __future__ import annotations

import json

import pytest
from msgspec.structs import replace

from acsard.cli import main
from acsard.machine.serial_ports import SerialDevice

ON_THE_MAINBOARD = SerialDevice("/dev/ttyS0", [], "port", "", "", "", [])
UNKNOWN = SerialDevice("/dev/ttyUSB0", [], "pl2303", "067b:2303", "USB Serial", "", [])
MEGA = SerialDevice(
    "/dev/ttyACM0", ["/dev/acsar"], "cdc_acm", "2341:0042", "", "Arduino Mega 2560 R3", []
)


@pytest.mark.parametrize(
    ("ports", "code", "words"),
    [
        ([], 1, "no serial ports: check that the board is plugged in"),
        ([ON_THE_MAINBOARD], 0, "acsard finds no board: check that the board is plugged in"),
        ([ON_THE_MAINBOARD, UNKNOWN], 0, "unplug the board and run this again"),
        ([ON_THE_MAINBOARD, UNKNOWN, MEGA], 0, ""),
    ],
)
def test_the_tool_says_that_no_port_looks_like_a_board(
    ports: list[SerialDevice],
    code: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("acsard.cli.ports.serial_devices", lambda: ports)
    assert main(["ports"]) == code
    out, err = capsys.readouterr()
    assert words in err
    assert bool(words) == bool(err)
    assert ('port = "/dev/acsar"' in out) == (MEGA in ports)
    assert all(port.device in out for port in ports)


def test_json_has_no_control_characters_from_the_description_of_a_device(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port = replace(UNKNOWN, description="USB \x9b2J Serial")
    monkeypatch.setattr("acsard.cli.ports.serial_devices", lambda: [port])
    assert main(["ports", "--json"]) == 0
    out = capsys.readouterr().out
    assert out.strip().isprintable()
    assert json.loads(out)[0]["description"] == port.description
