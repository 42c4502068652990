"""The stop script sends zeros on the configured port without the daemon, and never hangs."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import shutil
import struct
import subprocess
import termios
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from acsard.daemon.serial.device import baud_rate_of, set_baud_rate
from tests.system.harness import ROOT, ZERO_LINE

SCRIPT = ROOT / "deploy" / "systemd" / "acsard-stop"

STOP = b"\r\n" + 3 * ZERO_LINE

UNREAD_AT_MOST = 4095
"""The size of a terminal's buffer in Linux. Further bytes wait behind it."""

pytestmark = pytest.mark.skipif(
    shutil.which("stty") is None or shutil.which("awk") is None, reason="needs stty and awk"
)


class Wire:
    """A pty: the settings of its slave end, and the bytes that came out of its master end."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self.slave)

    def read_bytes(self) -> bytes:
        try:
            return os.read(self.master, 65536)
        except BlockingIOError:
            return b""

    def unread(self) -> int:
        """Return how many bytes wait at the master end."""
        waiting = fcntl.ioctl(self.master, termios.FIONREAD, struct.pack("i", 0))
        return int(struct.unpack("i", waiting)[0])

    def fill(self) -> None:
        """Write until the pty accepts nothing more.

        It is full only when its master end is full as well.
        """
        os.set_blocking(self.slave, False)
        while self.unread() < UNREAD_AT_MOST or select.select([], [self.slave], [], 0)[1]:
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(self.slave, b"\r\n" * 100)
            time.sleep(0.001)

    def close(self) -> None:
        os.close(self.master)
        os.close(self.slave)


class Ended(NamedTuple):
    code: int
    err: str
    bytes: bytes


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    wire.close()


Stop = Callable[..., Ended]


@pytest.fixture
def stop(tmp_path: Path, wire: Wire) -> Stop:
    """Run the stop script as systemd does, with this configuration, in which PORT is the wire."""

    def run(text: str, **env: str) -> Ended:
        path = tmp_path / "acsard.toml"
        path.write_text(text.replace("PORT", wire.name))
        words = [str(SCRIPT), *([] if "ACSARD_CONFIG" in env else [str(path)])]
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=5, env=os.environ | env
        )
        return Ended(done.returncode, done.stderr, wire.read_bytes())

    return run


REFERENCE = (ROOT / "acsard.toml").read_text().replace('port = "sim"', 'port = "PORT"')


@pytest.mark.parametrize(
    "text",
    [
        REFERENCE,
        '[mcu]\nport = "PORT"\n',
        "[mcu]\nport = 'PORT'\n",
        '[mcu]\nport="PORT"# the left socket\n',
        '  [ mcu ] # the board\n\t"port"\t=\t"PORT"\n',
        'mcu.port = "PORT"\n',
        'mcu . port = "PORT"\n[sim]\nport = "/dev/null"\n',
        '[sim]\nport = "/dev/null"\n[mcu]\n# port = "/dev/null"\nport = "PORT"\n',
        '[mcu]\nport = "PORT"\n[mcu.wheels]\nport = "/dev/null"\n',
        '[mcu]\r\nport = "PORT"\r\nbaud_rate = 115200\r\n',
        '[mcu]\nport = "PORT"',
        '\ufeff[mcu]\r\nport = "PORT"\r\n',
        '\ufeffmcu.port = "PORT"\r\n',
        '[mcu]\nport = "PORT"\ntrailing_comma = false # true\n',
    ],
)
def test_the_stop_script_finds_the_port_in_every_toml_notation(stop: Stop, text: str) -> None:
    assert stop(text) == (0, "", STOP)


def test_the_stop_script_reads_the_configuration_that_the_environment_names(
    stop: Stop, tmp_path: Path
) -> None:
    ended = stop('[mcu]\nport = "PORT"\n', ACSARD_CONFIG=str(tmp_path / "acsard.toml"))
    assert ended == (0, "", STOP)


def test_the_stop_script_adds_a_trailing_comma_if_it_is_configured(stop: Stop) -> None:
    ended = stop('[mcu]\nport = "PORT"\ntrailing_comma = true\n')
    assert ended.bytes == STOP.replace(b"00\r\n", b"00,\r\n")


@pytest.mark.parametrize(
    ("text", "speed"),
    [("", termios.B115200), ("baud_rate = 9600", termios.B9600), ("baud_rate = 57_600", 4097)],
)
def test_the_port_is_set_raw_at_its_baud_rate_and_keeps_dtr(
    stop: Stop, wire: Wire, text: str, speed: int
) -> None:
    cooked = termios.tcgetattr(wire.slave)
    cooked[2] |= termios.HUPCL
    cooked[0] |= termios.IXON
    termios.tcsetattr(wire.slave, termios.TCSANOW, cooked)
    stop(f'[mcu]\nport = "PORT"\n{text}\n')
    inputs, outputs, control, local, ispeed, ospeed, _ = termios.tcgetattr(wire.slave)
    assert (ispeed, ospeed) == (speed, speed)
    assert not outputs & termios.OPOST
    assert not local & (termios.ECHO | termios.ICANON | termios.ISIG)
    assert not inputs & (termios.IXON | termios.IXOFF | termios.ICRNL)
    assert not control & termios.HUPCL, "closing would reset the board"
    assert control & termios.CLOCAL


def test_a_rate_that_stty_does_not_know_stays_as_the_daemon_has_set_it(
    stop: Stop, wire: Wire
) -> None:
    set_baud_rate(wire.slave, 250000)
    assert stop('[mcu]\nport = "PORT"\nbaud_rate = 250000\n') == (0, "", STOP)
    assert baud_rate_of(wire.slave) == 250000
    assert not termios.tcgetattr(wire.slave)[3] & (termios.ECHO | termios.ICANON)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *[
            (f'[mcu]\nport = "{port}"\n', "")
            for port in (
                "sim",
                "/dev/no-such-port",
                "/etc/passwd",
                "/tmp",
                "$(touch /tmp/never) -x",
            )
        ],
        *[
            (text, "/dev/acsar")
            for text in ("", "[mcu]\n", "this is no TOML", 'mcu = { port = "/dev/ttyUSB0" }\n')
        ],
        ('[mcu]\nport = "/dev/null"\n', "cannot set every option of /dev/null"),
    ],
)
def test_without_a_usable_port_the_stop_script_ends_without_a_failure(
    stop: Stop, text: str, said: str
) -> None:
    """Without a port in the configuration it uses /dev/acsar, and says so."""
    ended = stop(text)
    assert (ended.code, ended.bytes) == (0, b"")
    assert said in ended.err
    assert bool(said) == bool(ended.err)


@pytest.mark.parametrize(
    ("result", "ended_by", "code"),
    [
        ("success", "exited", 0),
        ("success", "killed", 1),  # systemd calls SIGHUP and SIGPIPE a success
        ("signal", "killed", 1),
        ("watchdog", "dumped", 1),
        ("exit-code", "exited", 1),
    ],
)
def test_a_port_that_accepts_no_bytes_is_always_logged_and_is_a_failure_if_the_daemon_died(
    stop: Stop, wire: Wire, result: str, ended_by: str, code: int
) -> None:
    tty.setraw(wire.slave)
    for _ in range(10):
        wire.fill()
        ended = stop('[mcu]\nport = "PORT"\n', SERVICE_RESULT=result, EXIT_CODE=ended_by)
        if "does not take zeros" in ended.err:
            break
    assert ended.code == code
    assert f"<4>acsard-stop: {wire.name} does not take zeros" in ended.err
