"""The page lists the boards. It may start only a few commands with a few permitted values."""

from __future__ import annotations

import argparse
import asyncio
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.bus.address import Address
from acsard.calibration.guided.drive_plan import NEEDS, SIMULATED
from acsard.calibration.guided.methods import METHODS
from acsard.cli import parser
from acsard.host.processes import Holder
from acsard.machine.serial_ports import SerialDevice
from acsard.web.guide import KEY, NO_DEVICE, Guide, arguments, boards, last_part
from acsard.web.socket_messages import Begin, Ended, FrameError, Guided
from tests.each import each

MEGA = SerialDevice(
    "/dev/ttyACM0", ["/dev/acsar"], "cdc_acm", "2341:0042", "", "Arduino Mega 2560 R3", []
)
HELD = SerialDevice("/dev/ttyUSB0", [], "ch341", "", "USB Serial", "", [Holder(7, "acsard")])


@pytest.mark.parametrize("configured", ["/dev/acsar", "/dev/ttyACM0"])
def test_the_configured_port_is_listed_under_its_configured_name(
    configured: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA, HELD])
    labels = {board.port: board.what for board in boards(configured)}
    assert labels == {
        configured: "Arduino Mega 2560 R3, configured",
        "/dev/ttyUSB0": "USB Serial, in use by acsard (process 7)",
        "sim": "the simulator: no real robot moves",
    }


def test_a_configured_port_that_is_missing_is_offered_as_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA])
    first = boards("/dev/none")[0]
    assert (first.port, first.what) == ("/dev/none", "configured, but it does not exist now")


def test_the_simulator_is_listed_once_whatever_is_configured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", list)
    assert [board.port for board in boards("sim")] == ["sim"]


@pytest.mark.parametrize("configured", ["sim", "/dev/ttyUSB0"])
def test_the_configured_port_is_the_first_choice(
    configured: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page of a simulated robot must not preselect a real port."""
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: [MEGA, HELD])
    assert boards(configured)[0].port == configured


FILE = "/etc/acsard/acsard.toml"
ADDRESS = Address("tls/robot:7447", "robot2", "/etc/acsard/tls")
PORTS = ("/dev/acsar", "sim")


@pytest.mark.parametrize(
    ("configured", "devices", "note"),
    [
        ("sim", [], NO_DEVICE),
        ("/dev/none", [], NO_DEVICE),  # as a service, which sees no device
        ("/dev/none", [MEGA], ""),
        ("/dev/ttyACM0", [MEGA], ""),
    ],
)
async def test_a_server_that_sees_no_port_says_what_to_do(
    configured: str, devices: list[SerialDevice], note: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.web.guide.serial_devices", lambda: devices)
    assert (await Guide(ADDRESS, FILE, configured).choices(simulated=False)).note == note


def parsed(argv: list[str]) -> argparse.Namespace:
    """Return the arguments as the command line parses them."""
    return parser(["calibrate", "mcu"]).parse_args(argv)


def test_a_check_gets_the_port_and_the_file_and_asks_before_it_moves() -> None:
    args = parsed(arguments(Begin("check", "/dev/acsar"), ADDRESS, FILE, PORTS))
    assert (args.port, args.config) == ("/dev/acsar", FILE)
    assert args.json_lines
    assert [args.yes, args.write, args.wheels_are_lifted] == [False] * 3


@each("way", ["", *NEEDS])
def test_a_calibration_is_of_the_page_s_robot_and_asks_before_it_moves(way: str) -> None:
    positions = "sim/pose" if way == "positions" else ""
    args = parsed(arguments(Begin("calibrate", "", way, positions), ADDRESS, FILE, ()))
    assert (args.connect, args.id, args.tls) == (ADDRESS.endpoint, ADDRESS.robot_id, ADDRESS.tls)
    assert (args.method or "", args.positions or "") == (way, positions)
    assert args.json_lines
    assert [args.yes, args.write, args.log] == [False, False, None]


def test_unknown_values_are_not_passed_as_options() -> None:
    argv = arguments(Begin("calibrate"), Address("tcp/127.0.0.1:7448", "acsar", ""), "", ())
    assert not any(
        word.startswith(("--config", "--tls", "--method", "--positions")) for word in argv
    )


@each(
    "wish",
    [
        Begin("check", ""),
        Begin("check", "/etc/passwd"),
        Begin("check", "--yes"),
        Begin("check", "sim --yes"),
        Begin("check", "x" * 300),
        Begin("check", "sim", "tape"),
        Begin("check", "sim", "", "sim/pose"),
        Begin("calibrate", "sim"),
        Begin("calibrate", "", "guess"),
        Begin("calibrate", "", "tape --write"),
        Begin("calibrate", "", "--log=/etc/passwd"),
        Begin("calibrate", "", "tape", "sim/pose"),
        Begin("calibrate", "", "positions"),
        Begin("calibrate", "", "positions", "--yes"),
        Begin("calibrate", "", "positions", "slam/**"),
        Begin("calibrate", "", "positions", "slam\npose"),
        Begin("calibrate", "", "positions", "x" * 81),
    ],
)
def test_a_request_that_was_not_offered_is_refused_with_a_reason(wish: Begin) -> None:
    with pytest.raises(FrameError) as caught:
        arguments(wish, ADDRESS, FILE, PORTS)
    assert caught.value.about == "begin"
    assert str(caught.value)


@given(st.sampled_from(["check", "calibrate"]), st.text(), st.text(), st.text())
def test_no_text_becomes_an_option_of_its_own(
    what: str, port: str, way: str, positions: str
) -> None:
    try:
        argv = arguments(Begin(what, port, way, positions), ADDRESS, FILE, PORTS)  # type: ignore[arg-type]
    except FrameError:
        return
    names = {word.partition("=")[0] for word in argv}
    assert names <= {
        "mcu", "check", "calibrate", "--json-lines", "--config", "--port", "--connect", "--id",
        "--tls", "--method", "--positions",
    }  # fmt: skip


def test_every_calibration_method_has_its_requirements() -> None:
    assert METHODS.keys() == NEEDS.keys()


def test_the_text_about_the_simulator_mentions_every_method() -> None:
    way, why = SIMULATED
    assert way in NEEDS
    assert [method for method in NEEDS if method not in why] == []


@each("key", ["a//b", "a/", "/a", "-a", "a" * 81, "a*", "a b", "a\n"])
def test_an_invalid_key_is_refused_as_a_source_of_positions(key: str) -> None:
    assert not KEY.match(key)
    assert KEY.match("sim/pose")


@each(
    ("data", "expected"),
    [
        (b"short", "short"),
        (b"x\n" * 2000 + b"last", "x\n" * 1997 + "last"),
        ("ü".encode() * 3000 + b"x", "ü" * 1999 + "x"),
    ],
)
def test_a_long_error_text_is_cut_between_lines_or_characters(data: bytes, expected: str) -> None:
    assert last_part(data).decode() == expected


@pytest.mark.parametrize(
    ("end", "code", "meaning"),
    [
        ("os.kill(os.getpid(), 9)", 137, "was ended by signal 9"),
        ("os._exit(5)", 5, "ended with exit code 5"),
        ("os._exit(75)", 75, "port, bus address or robot id in use"),
    ],
)
async def test_the_end_of_a_job_says_how_its_process_ended(
    monkeypatch: pytest.MonkeyPatch, end: str, code: int, meaning: str
) -> None:
    command = [sys.executable, "-c", f"import os; {end}"]
    monkeypatch.setattr("acsard.web.guide.acsard", lambda *words: command)
    said: asyncio.Queue[Guided] = asyncio.Queue()
    guide, viewer = Guide(ADDRESS, FILE, "sim"), object()
    guide.join(viewer, said.put_nowait)
    assert guide.begin(viewer, "joe", Begin("calibrate")) == ""
    async with asyncio.timeout(10.0):
        while not isinstance(ended := (await said.get()).guide, Ended):
            pass
    assert ended == Ended(code, meaning, "")
