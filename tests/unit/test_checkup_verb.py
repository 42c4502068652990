"""`acsard mcu check` on the built-in simulator, inside this process."""

from __future__ import annotations

import fcntl
import json
import math
import os
import pty
import signal
import struct
import sys
import termios
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import pytest
from msgspec import structs

from acsard.checkup import procedure
from acsard.checkup.findings import Finding
from acsard.cli import borrowed_port, mcu, parser
from acsard.cli.borrowed_port import BorrowedPort
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.core.messages import schema
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.daemon.serial.blocking import BlockingPort
from acsard.host import clock
from acsard.host.errors import (
    Exit,
    InUseError,
    MendableError,
    NoAnswerError,
    NoPortError,
    UsageError,
)
from acsard.terminal.prompt import Prompt, ended_by_signals
from tests.each import each


def called(where: Path, *words: str, text: str = "") -> int:
    """Return the exit code of a check with this configuration."""
    file = where / "acsard.toml"
    if not file.exists():
        file.write_text(text)
    args = parser(["mcu"]).parse_args(["mcu", "check", "--config", str(file), *words])
    return int(args.main(args))


@pytest.mark.slow
@pytest.mark.parametrize("wheels", ["", '[mcu.wheels]\nleft = "-m"\nright = "+k"\n'])
def test_json_is_one_object(
    wheels: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(tmp_path, "--port", "sim", "--yes", "--json", text=wheels) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == ""
    assert report["passed"] is True
    assert report["changes"] == {"mcu.link_check": "on", "mcu.encoder_counts": 3200}
    assert parse(report["toml"].encode()).mcu.link_check == "on"
    assert report["written"] is None
    watchdog = next(finding for finding in report["findings"] if finding["name"] == "watchdog")
    assert (watchdog["verdict"], watchdog["figure"][:2]) == ("PASS", "30")


@pytest.mark.slow
def test_write_changes_the_file_and_a_second_check_has_nothing_to_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "# my robot\n[mcu]\nlink_check = 'off' # not yet\n"
    assert called(tmp_path, "--port", "sim", "--yes", "--write", text=text) == 0
    assert "acsard.toml: written" in capsys.readouterr().out
    written = (tmp_path / "acsard.toml").read_text()
    assert written.startswith("# my robot\n")
    assert "# not yet" in written
    assert called(tmp_path, "--port", "sim", "--yes", "--write") == 0
    assert "nothing to change" in capsys.readouterr().out
    assert (tmp_path / "acsard.toml").read_text() == written


REAL = "[mcu]\nport = '/dev/acsar_mcu'\n"


@pytest.mark.slow
def test_findings_of_the_simulator_are_not_offered_for_a_robot_s_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(tmp_path, "--port", "sim", "--yes", "--json", text=REAL) == 0
    report = json.loads(capsys.readouterr().out)
    assert "the configured mcu.port is /dev/acsar_mcu" in report["withheld"]
    assert (report["changes"], report["toml"]) == ({}, "")


def test_findings_are_printed_also_if_the_file_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acsard.host.config_file.replace", full)
    with pytest.raises(MendableError, match="No space left"):
        called(tmp_path, "--port", "sim", "--yes", "--json", "--write")
    assert json.loads(capsys.readouterr().out)["written"] is None
    assert (tmp_path / "acsard.toml").read_text() == ""


@pytest.mark.slow
def test_the_port_that_was_named_is_written_with_the_rate_it_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def board(config: Config, _: object) -> VirtualWire:
        built = structs.replace(config, mcu=structs.replace(config.mcu, baud_rate=57600))
        return VirtualWire(FakeMcu(built))

    monkeypatch.setattr(mcu, "_wire", board)
    words = ("--port", "./acsar_mcu", "--yes", "--wheels-are-lifted", "--write", "--json")
    monkeypatch.chdir("/dev")
    assert called(tmp_path, *words, text="# mine\n") == 1
    assert json.loads(capsys.readouterr().out)["changes"]["mcu.port"] == "/dev/acsar_mcu"
    written = parse((tmp_path / "acsard.toml").read_bytes()).mcu
    assert (written.port, written.baud_rate) == ("/dev/acsar_mcu", 57600)


@pytest.mark.parametrize(("words", "released"), [((), [7, 8]), (("--write",), [8])])
def test_a_robot_whose_file_the_check_changed_stays_switched_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...], released: list[int],
) -> None:  # fmt: skip
    """Its daemon has the wheel map of before until it is restarted."""
    robot = MagicMock()
    robot.__enter__.return_value = robot
    robot.get.return_value = SimpleNamespace(pid=os.getpid(), port="/dev/none")
    robot.call.return_value = schema.ServiceReply(
        success=True, message="", data=schema.ReplyData(numbers=[7], loan=8)
    )
    monkeypatch.setattr(borrowed_port, "answers", lambda _: True)
    monkeypatch.setattr(borrowed_port, "is_daemon_here", lambda _: True)
    monkeypatch.setattr(borrowed_port, "open_connection", lambda _: robot)

    def run(
        wire: BorrowedPort, operator: object, config: Config, tell: Callable[[Finding], None],
        *_: object, **how: object,
    ) -> None:  # fmt: skip
        wire._loan.begin(InUseError("in use"))
        tell(Finding("baud rate", "PASS", keys={"mcu.wheels.front_left": "-b"}))

    monkeypatch.setattr(procedure, "run", run)
    called(tmp_path, "--yes", "--wheels-are-lifted", *words, text="[mcu]\nport = '/dev/none'\n")
    robot.call.assert_called_with("activate", numbers=released)
    said = capsys.readouterr().err
    assert ("restart the daemon" in said) is (7 not in released)
    assert ("each sender must send a zero first" in said) is (7 in released)
    if 7 in released:
        refusal = schema.ServiceReply(success=False, message="a stop holds it")
        robot.call.side_effect = [robot.call.return_value, refusal]
        called(tmp_path, "--yes", "--wheels-are-lifted", text="[mcu]\nport = '/dev/none'\n")
        assert "the robot stays switched off: a stop holds it" in capsys.readouterr().err


class Held:
    """A port that a daemon has opened until its file is closed for the `free`-th attempt."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, free: float) -> None:
        self.attempts = self.loans = 0
        self._free = free
        monkeypatch.setattr(BlockingPort, "open", lambda *_: self._open())

    def begin(self, _: InUseError) -> None:
        self.loans += 1

    def _open(self) -> None:
        self.attempts += 1
        if self.attempts < self._free:
            raise InUseError("in use")


@pytest.mark.parametrize(("free", "loans"), [(1, 0), (3, 1), (math.inf, 1)])
def test_a_lent_port_is_opened_as_soon_as_the_daemon_has_closed_it_or_not_at_all(
    free: float, loans: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, now_s = Held(monkeypatch, free), 100.0

    def sleep(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    monkeypatch.setattr(time, "sleep", sleep)
    monkeypatch.setattr(clock, "steady_s", lambda: now_s)
    port = BorrowedPort("/dev/none", cast(Any, held))
    if free < math.inf:
        port.open(115200)
        assert (held.attempts, held.loans) == (free, loans)
    else:
        with pytest.raises(InUseError):
            port.open(115200)
        assert now_s == pytest.approx(100.0 + borrowed_port.CLOSE_TIMEOUT_S, abs=0.1)


@pytest.mark.parametrize(
    ("port", "pid", "lends"),
    [("link", 77, True), ("ttyS9", 77, True), ("ttyS8", 77, False), ("link", 78, False)],
)
def test_only_the_daemon_that_has_the_port_lends_it_also_under_another_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: str, pid: int, lends: bool
) -> None:
    (tmp_path / "ttyS9").touch()
    (tmp_path / "link").symlink_to(tmp_path / "ttyS9")
    robot, config = MagicMock(), Config()
    robot.__enter__.return_value = robot
    robot.get.return_value = SimpleNamespace(pid=77, port=str(tmp_path / port))
    robot.call.return_value = schema.ServiceReply(success=True, message="")
    monkeypatch.setattr(borrowed_port, "answers", lambda _: True)
    monkeypatch.setattr(borrowed_port, "is_daemon_here", lambda _: True)
    monkeypatch.setattr(borrowed_port, "holder_of", lambda _: SimpleNamespace(pid=pid))
    monkeypatch.setattr(borrowed_port, "open_connection", lambda _: robot)
    own = structs.replace(config, mcu=structs.replace(config.mcu, port=str(tmp_path / "ttyS9")))
    loan, in_use = borrowed_port.Loan(own, lambda _: None), InUseError("in use")
    with nullcontext() if lends else pytest.raises(InUseError, match="in use"):
        loan.begin(in_use)
    assert robot.call.called == lends


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ("refuses", "the daemon keeps /dev/none: a stop holds it"),
        ("nobody", "^in use$"),
        ("silent", "in use; the daemon did not lend it: nobody answers"),
    ],
)
def test_a_port_that_the_daemon_does_not_lend_stays_in_use_with_the_reason(
    trouble: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = MagicMock()
    robot.__enter__.return_value = robot
    robot.__exit__.return_value = None
    robot.get.return_value = SimpleNamespace(pid=os.getpid(), port="/dev/none")
    robot.call.return_value = schema.ServiceReply(success=False, message="a stop holds it")
    if trouble == "silent":
        robot.get.side_effect = NoAnswerError("nobody answers")
    monkeypatch.setattr(borrowed_port, "answers", lambda _: trouble != "nobody")
    monkeypatch.setattr(borrowed_port, "is_daemon_here", lambda _: True)
    monkeypatch.setattr(borrowed_port, "holder_of", lambda _: None)
    monkeypatch.setattr(borrowed_port, "open_connection", lambda _: robot)
    config, said = Config(), list[str]()
    own = structs.replace(config, mcu=structs.replace(config.mcu, port="/dev/none"))
    with borrowed_port.Loan(own, said.append) as loan, pytest.raises(InUseError, match=words):
        loan.begin(InUseError("in use"))
    assert said == []
    assert not robot.call.called or robot.call.call_args.args == ("deactivate",)


def test_a_daemon_that_ends_during_a_check_is_named_at_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said = list[str]()
    monkeypatch.setattr(
        borrowed_port, "open_connection", MagicMock(side_effect=NoAnswerError("it has ended"))
    )
    with borrowed_port.Loan(Config(), said.append) as loan:
        loan._data = schema.ReplyData(numbers=[7], loan=8)
    assert said == ["the daemon did not take the port back (it has ended): `acsard call activate`"]


def test_without_json_a_check_that_cannot_go_on_prints_only_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(NoPortError):
        called(tmp_path, "--port", str(tmp_path / "none"), "--yes")
    file = tmp_path / "acsard.toml"
    assert capsys.readouterr() == (f"port {tmp_path / 'none'}, configuration {file}\n", "")


def test_a_port_without_an_answer_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(NoPortError):
        called(tmp_path, "--port", str(tmp_path / "none"), "--yes", "--write", "--json")
    report = json.loads(capsys.readouterr().out)
    assert (report["passed"], report["changes"]) == (False, {})
    assert "acsard ports" in report["error"]
    assert (tmp_path / "acsard.toml").read_text() == ""


def test_yes_alone_is_refused_on_what_is_no_simulator(tmp_path: Path) -> None:
    ends = pty.openpty()
    try:
        for port in (os.ttyname(ends[1]), "/dev/null"):
            for text, speed in (("", 3), ("[limits]\nwheel_speed = 12.0\n", 12)):
                (tmp_path / "acsard.toml").write_text(text)
                with pytest.raises(UsageError, match="--wheels-are-lifted") as end:
                    called(tmp_path, "--yes", "--port", port)
                assert end.value.code == Exit.USAGE
                assert f"at up to {speed} rad/s" in str(end.value)
    finally:
        for end_fd in ends:
            os.close(end_fd)


@each(
    ("text", "fast"),
    [
        ("", False),
        ("linear_speed = 0.2", False),
        ("linear_acceleration = 0.2", False),
        ("linear_speed = 0.2\nangular_speed = 1.0", True),
        ("wheel_speed = 12.0", True),
    ],
)
def test_without_questions_only_a_speed_of_the_file_is_driven(
    text: str, fast: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "acsard.toml").unlink(missing_ok=True)
    run = MagicMock()
    monkeypatch.setattr(procedure, "run", run)
    begun = MagicMock()
    monkeypatch.setattr(Prompt, "begin", begun)
    nothing_judged = called(tmp_path, "--port", "sim", "--yes", text=f"[limits]\n{text}\n")
    assert "the built-in SIMULATOR" in begun.call_args.args[-1]
    assert nothing_judged == Exit.FAILURE
    assert run.call_args.kwargs == {"fast": fast}


def test_findings_of_the_simulator_are_not_written_into_a_robot_s_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--write cannot change .*/dev/acsar_mcu"):
        called(tmp_path, "--port", "sim", "--yes", "--write", text=REAL)
    assert (tmp_path / "acsard.toml").read_text() == REAL


def on_terminal(columns: int, do: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> str:
    """Run `do` with a terminal of this width as standard error and return the text it wrote."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with os.fdopen(slave, "w") as end, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", end)
        do()
        end.write("$")  # a mark for the end, so that there is always something to read
        end.flush()
        written = b""
        while not written.endswith(b"$"):  # the text arrives in pieces
            written += os.read(master, 1 << 16)
    os.close(master)
    return written.decode().removesuffix("$")


@pytest.mark.slow
@pytest.mark.parametrize("columns", [0, 40, 120])
def test_progress_is_one_line_on_a_terminal_that_the_next_one_writes_over(
    tmp_path: Path, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    check = ("--port", "sim", "--yes")
    written = on_terminal(columns, lambda: called(tmp_path, *check), monkeypatch)
    assert "listening for 3 s at the configu" in written
    assert "\n" not in written
    lines = [line for line in written.split("\r\033[K") if line]
    assert len(lines) > 8
    assert max(map(len, lines)) < (columns or 80)
    assert written.endswith("\r\033[K"), "what is printed at last stands on a line of its own"


@pytest.mark.parametrize(
    ("number", "end"),
    [
        (signal.SIGINT, KeyboardInterrupt),
        (signal.SIGTERM, SystemExit),
        (signal.SIGTSTP, SystemExit),
    ],
)
def test_a_second_signal_does_not_interrupt_the_final_zeros(
    number: signal.Signals, end: type[BaseException]
) -> None:
    before = signal.getsignal(number)
    reached = []

    def signalled() -> None:
        with ended_by_signals(exits=True):
            try:
                os.kill(os.getpid(), number)
            finally:
                os.kill(os.getpid(), number)
                reached.append(True)

    with pytest.raises(end):
        signalled()
    assert reached == [True]
    assert signal.getsignal(number) is before
