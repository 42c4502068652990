"""`acsard sim` inside this process: its device, its link, and its end."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.cli import sim
from acsard.core.config.settings import Config
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.host.errors import Exit, UsageError
from tests.system.typed import typed


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("acsard.toml").write_text("")


def in_time(condition: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + 20.0
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.005)
    return False


def ended_by(number: signal.Signals, as_soon_as: Callable[[], bool]) -> None:
    """Send a signal to this process, in a thread. Without a handler it would end the tests."""

    before = signal.getsignal(number)

    def send() -> None:
        if in_time(as_soon_as) and signal.getsignal(number) is not before:
            os.kill(os.getpid(), number)

    threading.Thread(target=send, daemon=True).start()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_simulated_board_and_removes_its_link(
    tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, boards = tmp_path / "board", list[FakeMcu]()

    def made(config: Config, now_ns: int) -> FakeMcu:
        boards.append(FakeMcu(config, now_ns))
        return boards[0]

    monkeypatch.setattr(sim, "FakeMcu", made)

    def writes() -> bool:
        if not link.exists():
            return False
        board = os.open(link, os.O_RDWR | os.O_NOCTTY)
        os.write(board, b"ap00.00,bp00.00,cp00.00,dp00.00\r\n")
        received = in_time(lambda: boards[0].valid_lines == 1)
        os.close(board)
        return received

    ended_by(number, writes)
    ended = typed("sim", "--link", str(link), "--fault", "ftdi", "--fault", "bias=a:0.9")
    assert ended.code == Exit.OK
    assert ended.out == f"acsard run --port {link}"
    first, last = ended.err.splitlines()
    assert first.startswith("simulated MCU on /dev/pts/")
    assert first.endswith(", faults: ftdi, bias=a:0.9; Ctrl-C ends it")
    assert last == "the simulated MCU received 1 valid lines"
    assert not link.is_symlink()


def test_without_a_link_the_command_has_the_device_itself() -> None:
    before = signal.getsignal(signal.SIGTERM)
    ended_by(signal.SIGTERM, lambda: signal.getsignal(signal.SIGTERM) is not before)
    ended = typed("sim")
    device = ended.out.removeprefix("acsard run --port ")
    assert device.startswith("/dev/pts/")
    assert ended.err.splitlines()[0] == f"simulated MCU on {device}, faults: none; Ctrl-C ends it"


@pytest.mark.parametrize("fault", ["fidt", "bias=x:0.9", "stall=soon"])
def test_a_fault_that_does_not_exist_is_refused_before_the_board_begins(fault: str) -> None:
    ended = typed("sim", "--fault", fault)
    assert (ended.code, ended.out) == (Exit.USAGE, "")
    assert ended.err.startswith(f"acsard: --fault {fault}: ")


def test_a_link_of_an_earlier_board_is_replaced_and_a_living_one_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "board"
    link.symlink_to("/dev/pts/gone")
    sim._make_link(link, "/dev/null")
    assert (os.readlink(link), capsys.readouterr().err) == ("/dev/null", "")
    sim._make_link(link, "/dev/zero")
    assert os.readlink(link) == "/dev/zero"
    assert capsys.readouterr().err == f"{link} now leads to /dev/zero, no longer to /dev/null\n"


def test_a_link_that_leads_elsewhere_in_the_meantime_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "board"
    link.symlink_to("/dev/null")
    sim._remove_link(link, "/dev/zero")
    assert link.is_symlink()
    sim._remove_link(link, "/dev/null")
    assert not link.is_symlink()
    link.touch()
    sim._remove_link(link, "/dev/null")
    assert link.exists()


def test_a_file_is_not_replaced_by_a_link(tmp_path: Path) -> None:
    link = tmp_path / "board"
    link.write_text("mine")
    with pytest.raises(UsageError, match=r"cannot make the symbolic link .*: File exists; give"):
        sim._make_link(link, "/dev/null")
    assert link.read_text() == "mine"
