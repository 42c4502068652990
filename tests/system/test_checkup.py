"""`acsard mcu check` works at a terminal, and finds the planted faults of boards on ptys."""

from __future__ import annotations

import json
import signal
import tomllib
from pathlib import Path

import pytest
import serial

from acsard.daemon.serial.device import open_raw
from tests.system.harness import Bus, Daemon, FarPeer, Program, acsard, until
from tests.system.terminals import Terminal, at_terminal
from tests.system.typed import typed

CHECK_S = 200.0
"""A check takes 13 to 25 s.

The limit is for a machine that is busy with other work, on which the check repeats the measurements
that this spoilt.
"""


def test_a_port_that_the_daemon_holds_ends_with_75_and_how_to_stop_it(
    shared: Daemon, bus: Bus
) -> None:
    port = bus.get("info")["port"]
    ended = typed("mcu", "check", "--port", port, "--yes")
    assert ended.code == 75
    assert f"process {shared.pid}" in ended.err
    assert "systemctl stop acsard" in ended.err
    bus.comes_to("ready")


@pytest.mark.slow
def test_a_running_daemon_lends_its_port_and_gets_it_back(tmp_path: Path) -> None:
    """The board is silent, so that the check ends soon."""
    with Program(acsard("sim", "--link", "mcu", "--fault", "mute"), tmp_path) as sim:
        sim.says("acsard run --port")
        port = tmp_path / "mcu"
        with Daemon(tmp_path, port) as daemon, Bus(daemon.endpoint) as bus:
            ended = typed("mcu", "check", "--config", str(daemon.config), "--yes")
            assert "FAIL    baud rate              nothing received" in ended.out
            assert "lends the port for this check" in ended.err
            assert "the daemon has the port again" in ended.err
            assert bus.comes_to("waiting")
            until(lambda: len(daemon.events("port_open")) == 2, 5.0, "the port is open again")
            bus.get("srv/stop")
            ended = typed("mcu", "check", "--config", str(daemon.config), "--yes")
            assert ended.code == 1
            assert bus.state()["mode"] == "stopped"
            until(lambda: len(daemon.events("port_open")) == 3, 5.0, "the port is open again")


def test_a_port_that_another_program_holds_is_not_asked_of_the_daemon(tmp_path: Path) -> None:
    with Program(acsard("sim", "--link", "mcu"), tmp_path) as sim:
        sim.says("acsard run --port")
        port = tmp_path / "mcu"
        with Daemon(tmp_path, port) as daemon, Bus(daemon.endpoint) as bus:
            bus.linked()
            assert bus.get("srv/deactivate", {"release_port": True})["success"]
            other = until(lambda: opened(port), 5.0, "the port is closed")
            try:
                ended = typed("mcu", "check", "--config", str(daemon.config), "--yes")
            finally:
                other.close()
            assert ended.code == 75
            assert "is in use by process" in ended.err
            assert "lends" not in ended.err
            assert len(daemon.events("port_open")) == 1


def opened(path: Path) -> serial.Serial | None:
    try:
        return open_raw(str(path), 115200)
    except OSError:
        return None


def answer(terminal: Terminal, question: str, word: str, times: int, within: float) -> None:
    """Wait until the question has been asked this number of times, then type."""
    until(lambda: terminal.screen.count(question) >= times, within, f"{question}, {times} times")
    terminal.press(f"{word}\n")


def answer_all(terminal: Terminal, wheels: tuple[str, ...], ways: str, within: float) -> None:
    answer(terminal, 'then type "lifted"', "lifted", 1, within)
    for n, (wheel, way) in enumerate(zip(wheels, ways, strict=True), 1):
        answer(terminal, "which wheel did", wheel, n, within)
        answer(
            terminal, "which way did the wheel turn", {"f": "forward", "b": "back"}[way], n, within
        )


TWO_WHEELS = '[mcu.wheels]\nleft = "+l"\nright = "+r"\n'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "wheels", "ways", "written"),
    [
        (
            "# mine\n",
            ("fl", "fr", "rl", "rr"),
            "ffbf",
            {"front_right": "+b", "front_left": "+a", "rear_left": "-c"},
        ),
        (TWO_WHEELS, ("r", "l"), "fb", {"left": "-r", "right": "+l"}),
    ],
    ids=["four", "two"],
)
def test_the_operator_s_answers_become_the_wheel_map(
    tmp_path: Path, text: str, wheels: tuple[str, ...], ways: str, written: dict[str, str]
) -> None:
    (tmp_path / "acsard.toml").write_text(text)
    with at_terminal(tmp_path, "mcu", "check", "--port", "sim", "--write") as (terminal, program):
        answer(terminal, 'then type "lifted"', "yes", 1, 10.0)
        until(lambda: "please type lifted" in terminal.screen, 5.0, "what to type")
        answer_all(terminal, wheels, ways, 10.0)
        assert program.ended(CHECK_S) == 1
    assert tomllib.loads((tmp_path / "acsard.toml").read_text())["mcu"]["wheels"] == written


@pytest.mark.slow
@pytest.mark.nightly  # a busy machine runs the check too late
@pytest.mark.parametrize("text", ["", TWO_WHEELS], ids=["four", "two"])
def test_every_row_of_a_sound_board_is_measured_in_real_time(tmp_path: Path, text: str) -> None:
    (tmp_path / "acsard.toml").write_text(f"{text}[limits]\nwheel_speed = 20.0\n")
    with Program(acsard("sim", "--link", "mcu"), tmp_path) as sim:
        sim.says("acsard run --port")
        config, port = str(tmp_path / "acsard.toml"), str(tmp_path / "mcu")
        ended = typed("mcu", "check", "--config", config, "--port", port, "--yes", "--json")
    report = json.loads(ended.out)
    verdicts = {finding["name"]: finding["verdict"] for finding in report["findings"]}
    skipped = {name for name, verdict in verdicts.items() if verdict != "PASS"}
    assert skipped == {"wheel map", "inputs"}, report  # they need a person
    assert {"watchdog", "damaged lines", "encoder counts", "trailing comma"} <= verdicts.keys()
    assert sum(name.startswith("motor ") for name in verdicts) == (2 if text else 4)


# on ptys, in real time


@pytest.mark.network
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGTERM, marks=pytest.mark.nightly), signal.SIGINT]
)
def test_a_signal_while_a_wheel_turns_ends_in_zeros(tmp_path: Path, number: signal.Signals) -> None:
    zeros, words = b"ap00.00,bp00.00,cp00.00,dp00.00", ("--yes", "--wheels-are-lifted")
    with FarPeer(tmp_path) as peer:

        def turns() -> bool:
            return any(line[:1] == b"a" and line[1:7] != b"p00.00" for _, line in peer.lines[-20:])

        check = acsard("mcu", "check", "--port", str(peer.path), *words)
        with Program(check, tmp_path) as program:
            until(turns, 60.0, f"motor a turns\n{program}")
            program.signal(number)
            assert program.ended(5.0) == (130 if number == signal.SIGINT else 128 + number)
        assert "sends zero speeds" in program.stderr
        assert "Traceback" not in program.stderr
        assert peer.lines[-1].line[:31] == zeros
