"""A serial device on a pty: why it cannot be opened, how it is closed, and the simulated one."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import pty
import subprocess
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
import serial

from acsard.core.config.settings import Baud
from acsard.daemon.serial.blocking import BlockingPort
from acsard.daemon.serial.device import (
    baud_rate_of,
    close,
    draining,
    in_use,
    open_raw,
    refusal,
    set_baud_rate,
    unsent,
)
from acsard.host import clock, processes
from acsard.host.errors import Exit, InUseError
from acsard.host.port_access import denial
from acsard.host.processes import Holder
from tests.each import each


@pytest.fixture
def path() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


@each(
    ("number", "code", "words"),
    [
        (errno.ENOENT, Exit.NO_PORT, "does not exist"),
        (errno.ENXIO, Exit.NO_PORT, "does not exist"),
        (errno.ENOTTY, Exit.NO_PORT, "is not a serial port"),
        (errno.EACCES, Exit.NO_PORT, "does not exist any more"),
        (errno.EBUSY, Exit.IN_USE, "in use by another process"),
        (errno.EAGAIN, Exit.IN_USE, "in use by another process"),
        (errno.EIO, Exit.FAILURE, "the driver of the serial port did not answer"),
    ],
)
def test_each_error_of_the_port_has_an_exit_code_and_a_text(
    number: int, code: Exit, words: str
) -> None:
    refused = refusal(
        "/dev/acsar_that_is_not", OSError(number, "the driver of the serial port did not answer")
    )
    assert refused.code is code
    assert str(refused).count("/dev/acsar_that_is_not") == 1
    assert words in str(refused)


@each("baud_rate", get_args(Baud))
def test_a_port_is_opened_and_changed_at_each_baud_rate(path: str, baud_rate: int) -> None:
    device, again = open_raw(path, baud_rate), 115200
    assert baud_rate_of(device.fileno()) == baud_rate
    raw = termios.tcgetattr(device.fileno())
    set_baud_rate(device.fileno(), again)
    assert baud_rate_of(device.fileno()) == again
    assert termios.tcgetattr(device.fileno())[:2] == raw[:2]
    close(device, wait_s=1.0)
    device.close()


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives a file to any group")
@each(
    ("group", "mode", "words"),
    [
        (54321, 0o660, "belongs to group 54321, but you are not in it; run `sudo usermod"),
        (0, 0o660, "belongs to group root, and you are in it, but something else"),
        (20, 0o600, "has the mode 600, so no group may open it; run `sudo chmod g+rw"),
        (5, 0o600, "a login console (agetty) probably uses it; on a Raspberry Pi"),
        (5, 0o620, "serial-getty@ttyAMA0`"),
        (65534, 0o620, "is not open to the group dialout"),
    ],
)
def test_a_device_without_permission_is_named_with_what_is_really_so(
    tmp_path: Path, group: int, mode: int, words: str
) -> None:
    path = tmp_path / "ttyAMA0"
    path.touch()
    os.chown(path, 0, group)
    path.chmod(mode)
    refused = refusal(str(path), OSError(errno.EACCES, "Permission denied"))
    assert refused.code is Exit.NO_PERMISSION
    assert words in str(refused)


def test_the_pty_of_a_simulator_of_another_user_is_not_taken_for_a_login_console() -> None:
    master, slave = pty.openpty()
    os.chmod(slave, 0o620)
    refused = refusal(os.ttyname(slave), OSError(errno.EACCES, "Permission denied"))
    os.close(master)
    os.close(slave)
    assert "has the mode 620, so no group may open it; run" in str(refused)


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives a file to any group")
@each("group", [0, 5])
def test_a_device_of_root_or_of_the_terminals_gets_another_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: int
) -> None:
    path = tmp_path / "ttyUSB0"
    path.touch()
    os.chown(path, 0, group)
    path.chmod(0o660)
    monkeypatch.setattr(os, "getgid", lambda: 54321)
    monkeypatch.setattr(os, "getgroups", list)
    advice = denial(str(path))[1]
    assert advice.startswith(f"run `sudo chown root:dialout {path}`")
    assert "usermod" not in advice


def test_an_empty_read_is_not_a_hang_up_and_a_hang_up_is_reported() -> None:
    master, slave = pty.openpty()
    device = open_raw(os.ttyname(slave), 115200)
    os.close(slave)
    assert device.read() == b""
    os.close(master)
    with pytest.raises(serial.SerialException, match=r"^\[Errno 5\]"):
        device.read()
    with open(os.devnull, "wb") as unreadable:
        os.dup2(unreadable.fileno(), device.fileno())
    with pytest.raises(serial.SerialException, match=r"^\[Errno 9\]"):
        device.read()
    device.close()


def test_a_port_that_no_thread_could_close_is_closed_by_the_next_opening(path: str) -> None:
    device = open_raw(path, 115200)
    usual = threading.stack_size(1 << 46)  # no machine has room for such a thread
    try:
        close(device, lost=True)
    finally:
        threading.stack_size(usual)
    device.close()
    again = open_raw(path, 115200)  # the lock would refuse this if the first one were still open
    close(again, wait_s=5.0)
    again.close()


def test_a_port_is_closed_without_waiting_for_the_thread_that_closes_it(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The control loop releases a port between two periods, which must not be late."""
    device = open_raw(path, 115200)
    monkeypatch.setattr(threading.Thread, "start", None)  # it waits
    close(device, wait_s=5.0)
    device.close()


def test_a_program_that_reads_the_port_without_a_lock_is_named_before_the_check(path: str) -> None:
    port = BlockingPort(path)
    with open(path) as there, subprocess.Popen(["cat"], stdin=there, stdout=subprocess.PIPE) as cat:
        there.close()
        try:
            with pytest.raises(InUseError, match=rf"in use by process {cat.pid} \(cat\); stop"):
                port.open(115200)
        finally:
            cat.kill()
    port.open(115200)
    port.close()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "python3\0/usr/bin/acsard\0mcu\0check",
            "`acsard mcu check` (process 7): wait for its end",
        ),
        ("python3\0/usr/bin/acsard\0run", "process 7 (acsard); stop that process first"),
        (
            "python3\0/usr/bin/acsard\0sim\0--link\0mcu",
            "process 7 (acsard); stop that process first",
        ),
    ],
)
def test_a_check_that_has_the_port_is_waited_for_and_not_stopped(
    command: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "PROC", tmp_path)
    (tmp_path / "7").mkdir()
    (tmp_path / "7/cmdline").write_text(command)
    assert words in str(in_use("/dev/acsar_mcu", Holder(7, "acsard")))


def test_a_port_is_locked_while_it_is_open_and_free_when_it_is_closed(path: str) -> None:
    device = open_raw(path, 115200)
    with pytest.raises(OSError, match=r"lock|busy") as locked:
        open_raw(path, 115200)
    assert isinstance(refusal(path, locked.value), InUseError)
    close(device, wait_s=5.0)
    # Root may open a locked device anyway, so the test reads the lock itself.
    after = os.open(path, os.O_RDWR | os.O_NOCTTY)
    exclusive = bytearray(4)
    fcntl.ioctl(after, 0x80045440, exclusive)  # TIOCGEXCL
    os.close(after)
    assert not any(exclusive)
    again = open_raw(path, 115200)
    close(again, wait_s=5.0)
    again.close()
    device.close()


@pytest.mark.parametrize(
    ("name", "call"),
    [(name, call) for name, calls in (("tcgetattr", 2), ("tcsetattr", 2), ("tcflush", 3))
     for call in range(1, calls + 1)],
)  # fmt: skip
def test_a_device_that_vanishes_inside_any_call_of_the_opening_is_a_lost_device(
    path: str, monkeypatch: pytest.MonkeyPatch, name: str, call: int
) -> None:
    real, calls = getattr(termios, name), itertools.count(1)

    def vanishing(*arguments: object) -> object:
        if next(calls) >= call:
            raise termios.error(errno.EIO, "Input/output error")
        return real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(termios, name, vanishing)
        with pytest.raises(OSError, match="Input/output error") as lost:
            open_raw(path, 115200)
    assert lost.value.errno == errno.EIO
    assert refusal(path, lost.value).code is Exit.FAILURE
    close(open_raw(path, 115200), wait_s=5.0)  # the failed attempt left nothing open or locked


def test_a_transport_may_flush_and_close_its_device_before_and_after_it_was_closed(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A transport that ends does both. The flush does not drain, because a driver may block."""
    device = open_raw(path, 115200)
    monkeypatch.setattr(termios, "tcdrain", None)
    device.flush()
    close(device, lost=True, wait_s=5.0)
    assert os.readlink(f"/proc/self/fd/{device.fileno()}") == os.devnull
    for _ in range(2):
        device.flush()
        device.close()


def test_a_file_without_an_output_queue_counts_as_drained(path: str) -> None:
    with open(os.devnull) as null:
        assert unsent(null.fileno()) == 0
        assert list(draining(null.fileno(), clock.mono_ns() + 10**9)) == []
