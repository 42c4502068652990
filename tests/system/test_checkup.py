"""`acsard mcu check` works at a terminal, and finds the planted faults of boards on ptys."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import ROOT, Bus, Daemon, Program, acsard, finish, until
from tests.system.terminals import Terminal, at_terminal
from tests.system.typed import typed

CHECK_S = 200.0
"""A check takes 13 to 25 s.

The limit is for a machine that is busy with other work, on which the check repeats the measurements
that this spoilt.
"""

BESIDE = 6
"""Number of parallel checks that leave the cores of a small machine enough time for each."""

WHEELS = ("fr", "fl", "rl", "rr")


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


def test_a_port_that_is_not_there_ends_with_66() -> None:
    ended = typed("mcu", "check", "--port", "/dev/acsar_none", "--yes")
    assert ended.code == 66
    assert "acsard ports" in ended.err


def test_mcu_check_without_a_terminal_ends_with_2() -> None:
    ended = typed("mcu", "check", "--port", "sim")
    assert (ended.code, ended.out) == (2, "")
    assert "terminal" in ended.err


def test_yes_alone_is_refused_on_a_pty_that_is_not_the_simulator_s() -> None:
    ends = pty.openpty()
    try:
        ended = typed("mcu", "check", "--yes", "--port", os.ttyname(ends[1]))
    finally:
        for end in ends:
            os.close(end)
    assert (ended.code, ended.out) == (2, "")
    assert "--wheels-are-lifted" in ended.err


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


@pytest.mark.slow
def test_the_operator_s_answers_become_the_wheel_map(tmp_path: Path) -> None:
    (tmp_path / "acsard.toml").write_text("# mine\n")
    with at_terminal(tmp_path, "mcu", "check", "--port", "sim", "--write") as (terminal, program):
        answer(terminal, 'then type "lifted"', "yes", 1, 10.0)
        until(lambda: "please type lifted" in terminal.screen, 5.0, "what to type")
        answer_all(terminal, ("fl", "fr", "rl", "rr"), "ffbf", 10.0)
        assert program.ended(CHECK_S) == 1
    written = tomllib.loads((tmp_path / "acsard.toml").read_text())
    assert written["mcu"]["wheels"] == {
        "front_right": "+b",
        "front_left": "+a",
        "rear_left": "-c",
    }


@pytest.mark.slow
def test_ctrl_c_at_the_first_question_ends_mcu_check_with_130(tmp_path: Path) -> None:
    with at_terminal(tmp_path, "mcu", "check", "--port", "sim") as (terminal, program):
        until(lambda: "lifted" in terminal.screen, 10.0, "the question")
        terminal.press("\x03")
        assert program.ended(5.0) == 130
        assert "Traceback" not in terminal.screen


@pytest.mark.slow
def test_q_without_enter_ends_mcu_check_while_a_motor_turns(tmp_path: Path) -> None:
    with Program(acsard("sim"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        with at_terminal(tmp_path, "mcu", "check", "--port", port) as (terminal, program):
            answer(terminal, 'then type "lifted"', "lifted", 1, 10.0)
            until(lambda: "motor a" in terminal.screen, CHECK_S, "the first motor")
            terminal.press("q")
            assert program.ended(5.0) == 130
            assert "Traceback" not in terminal.screen


# on ptys, in real time

FAULTS: dict[str, tuple[str, list[str], dict[str, object]]] = {
    "good": ("", [], {}),
    "swapped": ("swapped_encoders=a:d", ["motor a (front right)", "motor d (rear right)"], {}),
    "reversed": ("reversed_encoder=b", ["motor b (front left)"], {}),
    "comma": (
        "comma_latched",
        ["trailing comma", "watchdog", "damaged lines"],
        {"mcu.trailing_comma": True},
    ),
    "no watchdog": ("no_watchdog", ["watchdog"], {}),
    "fed watchdog": ("watchdog_fed_by_bad_lines", ["watchdog"], {}),
    "late watchdog": ("late_watchdog", ["watchdog"], {}),
    "dead encoder": ("stuck_encoder=c", ["motor c (rear left)"], {}),
    "baud": ("wrong_baud=57600", ["baud rate"], {"mcu.baud_rate": 57600}),
    "10 Hz": ("free_running", ["reply rate"], {"mcu.reply_period": 0.1}),
    "spaces": ("spaces", [], {}),
    "unpadded": ("unpadded", [], {}),
}


def checked(where: Path, name: str) -> tuple[int, dict[str, Any], str]:
    """Check one faulty robot; return exit code, answer and the written configuration."""
    fault = FAULTS[name][0]
    place = where / name
    place.mkdir()
    config = place / "acsard.toml"
    shutil.copy(ROOT / "acsard.toml", config)
    words = ["--fault", fault] if fault else []
    with Program(acsard("sim", *words), place) as sim:
        port = sim.says("acsard run --port").split()[-1]
        check = acsard("mcu", "check", "--port", port, "--yes", "--json", "--write")
        ended = finish(check, place, CHECK_S)
    assert ended.err == ""
    return ended.code, json.loads(ended.out), config.read_text()


@pytest.mark.soak
@pytest.mark.network
@pytest.mark.timeout(3 * CHECK_S)
def test_each_planted_fault_is_found_on_a_pty_and_a_good_board_passes(tmp_path: Path) -> None:
    """The check finds the fault, or does not judge it because this machine was late.

    A test in virtual time shows that this is the only reason for not judging it.
    """
    with ThreadPoolExecutor(BESIDE) as pool:
        results = dict(zip(FAULTS, pool.map(lambda n: checked(tmp_path, n), FAULTS), strict=True))
    for name, (_, failed, changes) in FAULTS.items():
        code, report, text = results[name]
        named = [finding["name"] for finding in report["findings"] if finding["verdict"] == "FAIL"]
        late = any(finding["figure"] == "not judged" for finding in report["findings"])
        assert named == failed or (late and set(named) <= set(failed)), (name, report)
        assert code == (1 if named or late else 0)
        assert late or changes.items() <= report["changes"].items(), name
        if name in ("spaces", "unpadded"):
            form = next(
                finding for finding in report["findings"] if finding["name"] == "reply form"
            )
            assert (form["verdict"], form["figure"]) == ("WARN", name)
        # Every line of the reference is still there, apart from the values of the keys that
        # changed.
        reference = (ROOT / "acsard.toml").read_text().splitlines()
        pairs = zip(reference, text.splitlines(), strict=True)
        differing = [after for before, after in pairs if before != after]
        assert sorted(re.split(" =", line)[0] for line in differing) == sorted(
            key.rpartition(".")[2] for key in report["changes"]
        )


BUSY = "while True: pass"


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("loops", [0, 4])
def test_a_busy_computer_finds_no_fault_of_a_good_board(tmp_path: Path, loops: int) -> None:
    """Run five checks at once, or one beside busy loops. They blame only this computer."""
    spinning = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(loops)]
    places = [tmp_path / str(n) for n in range(1 if loops else 5)]
    for place in places:
        place.mkdir()
    try:
        with ThreadPoolExecutor(len(places)) as pool:
            results = list(pool.map(lambda place: checked(place, "good"), places))
    finally:
        for item in spinning:
            item.kill()
            item.wait()
    for code, report, _ in results:
        problems = [item for item in report["findings"] if item["verdict"] in ("FAIL", "WARN")]
        print(*problems, sep="\n")
        assert code == (1 if problems else 0), report
        assert all("this computer ran the check" in item["text"] for item in problems), report
        assert report["changes"].keys() <= {"mcu.port", "mcu.link_check", "mcu.encoder_counts"}
        assert report["changes"].get("mcu.encoder_counts", 3200) == 3200


@pytest.mark.network
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGTERM, marks=pytest.mark.soak), signal.SIGINT]
)
def test_a_signal_while_a_wheel_turns_ends_in_zeros(tmp_path: Path, number: signal.Signals) -> None:
    with Program(acsard("sim", "--fault", "no_watchdog"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        words = acsard("mcu", "check", "--port", port, "--yes")
        with Program(words, tmp_path) as check:
            check.says("checked link")
            # The check prints nothing from now on while motor a turns.
            with pytest.raises(subprocess.TimeoutExpired):
                check.process.wait(0.5)
            check.signal(number)
            assert check.ended(5.0) == (130 if number == signal.SIGINT else 128 + number)
            assert "sends zero speeds" in check.stderr
            assert "Traceback" not in check.stderr
        # The next check finds the wheels at rest, and the port free.
        words = acsard("mcu", "check", "--port", port, "--yes")
        with Program(words, tmp_path) as again:
            again.says("PASS    motor a", 30.0)


@pytest.mark.network
@pytest.mark.nightly
def test_a_person_at_a_real_port_is_asked_after_each_motor(tmp_path: Path) -> None:
    with Program(acsard("sim", "--fault", "reversed_wheel=c"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        with at_terminal(tmp_path, "mcu", "check", "--port", port) as (terminal, program):
            answer_all(terminal, WHEELS, "ffbf", 20.0)
            assert program.ended(CHECK_S) == 1
            until(lambda: 'rear_left = "-c"' in terminal.screen, 5.0, "the line")


@pytest.mark.network
def test_a_port_that_is_lost_while_a_wheel_turns_is_a_finding(tmp_path: Path) -> None:
    with Program(acsard("sim"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        with Program(acsard("mcu", "check", "--port", port, "--yes"), tmp_path) as check:
            check.says("checked link")
            sim.process.kill()
            assert check.ended(10.0) == 1
        assert "FAIL    serial line" in check.stdout
        assert "Traceback" not in check.stderr
