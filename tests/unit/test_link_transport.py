"""The daemon's port needs this of pyserial-asyncio's transport, on a real pty and on each Python.

The library has no release since 2021, so the nightly job runs these tests on the newest Python.
"""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
import serial
from serial_asyncio import SerialTransport, connection_for_serial

from acsard.core.values import Event
from acsard.daemon.serial.device import close, open_raw
from acsard.daemon.serial.port import SerialPort
from acsard.host import clock
from tests.each import each

pytestmark = pytest.mark.filterwarnings("error")

LINE = b"ap05.00,bp05.00,cp05.00,dp05.00\r\n"


class Connection(asyncio.Protocol):
    """The transport at one end of a pty. The test has the other end, the board's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.board, slave = os.openpty()
        tty.setraw(self.board)
        self.path = os.ttyname(slave)
        self.device = open_raw(self.path, 115200)
        os.close(slave)
        self.fd: int = self.device.fileno()
        self.made: list[asyncio.BaseTransport] = []
        self.chunks: list[bytes] = []
        self.lost: list[Exception | None] = []
        self.errors: list[dict[str, Any]] = []
        # Each of these calls may block in a driver. From here on, none may be made.
        for name in ("tcgetattr", "tcsetattr", "tcdrain", "tcflush", "tcsendbreak"):
            monkeypatch.setattr(termios, name, None)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.made.append(transport)

    def data_received(self, data: bytes) -> None:
        self.chunks.append(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.append(exc)

    async def connect(self) -> SerialTransport:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: self.errors.append(context))
        transport, _ = await connection_for_serial(loop, lambda: self, self.device)
        assert transport.serial is self.device
        return transport

    def unplug(self) -> None:
        os.close(self.board)
        self.board = -1


@pytest.fixture
def connection(monkeypatch: pytest.MonkeyPatch) -> Iterator[Connection]:
    connection = Connection(monkeypatch)
    yield connection
    with suppress(OSError):
        os.close(connection.board)
    assert connection.errors == []


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(5.0):
        while not holds():
            await asyncio.sleep(0.001)


def has_reader(fd: int) -> bool:
    return asyncio.get_running_loop().remove_reader(fd)


async def test_the_protocol_gets_all_bytes_in_their_order(connection: Connection) -> None:
    transport = await connection.connect()
    await until(lambda: connection.made == [transport])
    text = b"".join(b"%04d\r\n" % number for number in range(500))
    os.write(connection.board, text)
    await until(lambda: sum(map(len, connection.chunks)) >= len(text))
    assert b"".join(connection.chunks) == text
    transport.abort()
    await until(lambda: connection.lost == [None])


async def test_one_read_takes_the_lines_of_a_stall_that_are_longer_than_a_read_of_the_library(
    connection: Connection,
) -> None:
    os.write(connection.board, LINE * 100)
    # A thread of the kernel carries them through the pty, in pieces.
    await until(lambda: connection.device.in_waiting == 100 * len(LINE))
    transport = await connection.connect()
    await until(lambda: connection.chunks)
    assert connection.chunks == [LINE * 100]
    transport.abort()
    await until(lambda: connection.lost == [None])


async def test_bytes_that_the_driver_refuses_are_not_kept_and_the_port_still_reads(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    sent = 0
    with suppress(BlockingIOError):
        while True:
            sent += connection.device.write(LINE)
    assert transport.get_write_buffer_size() == 0
    os.set_blocking(connection.board, False)
    received = b""

    def has_all() -> bool:
        nonlocal received
        with suppress(BlockingIOError):
            received += os.read(connection.board, 65536)
        return len(received) >= sent

    await until(has_all)
    assert received == (LINE * sent)[:sent]
    os.write(connection.board, LINE)
    await until(lambda: b"".join(connection.chunks) == LINE)
    transport.abort()
    await until(lambda: connection.lost == [None])


async def test_an_unplugged_device_is_lost_once_with_an_error_and_has_no_reader(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    connection.unplug()
    await until(lambda: connection.lost)
    await asyncio.sleep(0.02)
    (error,) = connection.lost
    assert isinstance(error, serial.SerialException)
    assert str(error).startswith("[Errno 5] ")
    assert transport.is_closing()
    assert not connection.device.is_open
    assert not has_reader(connection.fd)


@pytest.mark.parametrize("begun", [True, False])
async def test_an_aborted_transport_ends_without_an_error_and_does_not_touch_the_closed_device(
    connection: Connection, begun: bool
) -> None:
    """The port closes the device itself, perhaps before the transport has begun to read."""
    transport = await connection.connect()
    if begun:
        await asyncio.sleep(0.01)
    transport.abort()
    assert transport.is_closing()
    assert not has_reader(connection.fd)
    close(connection.device, wait_s=5.0)
    connection.device.close()
    again = os.dup2(connection.board, connection.fd)  # another file has the number now
    await until(lambda: connection.lost)
    assert connection.lost == [None]
    assert transport.serial is None
    assert not has_reader(connection.fd)
    os.fstat(again)
    os.close(again)


@each("by", ["the reader", "a late step", "the reader and a late step", "the line", "a release"])
async def test_a_lost_port_is_closed_once_and_says_so_unless_it_was_released_before(
    by: str,
) -> None:
    """Whatever notices the loss first, the same events follow, and no traceback."""
    errors, events = list[dict[str, Any]](), list[Event]()
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: errors.append(context))
    board, slave = os.openpty()
    tty.setraw(board)
    port = SerialPort(os.ttyname(slave), 115200, LINE, 10_000_000, lambda _: None, events.append)
    async with port:
        await asyncio.sleep(0.01)
        os.close(slave)
        os.close(board)
        match by:
            case "the reader":
                await until(lambda: not port.is_open)
            case "a late step":
                port.take(clock.now())
            case "the reader and a late step":
                # The period has ended when the event loop looks next, and is served second.
                loop.call_soon(loop.call_soon, port.take, clock.now())
                await until(lambda: not port.is_open)
            case "the line":
                assert port.offer(LINE, clock.now()) == "down"
            case _:
                port.release(True)
        assert (port.is_open, port.opened, port.take()) == (False, 1, ())
        assert port.offer(LINE, clock.now()) == "down"
        await asyncio.sleep(0.02)
    released = by == "a release"
    assert [event.name for event in events] == ["port_open"] + ["port_lost"] * (not released)
    assert ("[Errno 5] " in port.trouble) is not released
    assert errors == []
