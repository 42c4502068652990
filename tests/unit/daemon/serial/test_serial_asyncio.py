"""`SerialPort` needs this of pyserial-asyncio, which nobody maintains, on each Python.

The nightly job runs these tests on the newest Python. If one fails there, `port.py` can read the
descriptor with `loop.add_reader` itself.
"""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest
import serial
import serial_asyncio

from acsard.daemon.serial.device import close, open_raw

pytestmark = pytest.mark.filterwarnings("error")

LINE = b"ap05.00,bp05.00,cp05.00,dp05.00\r\n"


class Calls(asyncio.Protocol):
    def __init__(self) -> None:
        self.made: list[asyncio.BaseTransport] = []
        self.data = b""
        self.lost: list[Exception | None] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.made.append(transport)

    def data_received(self, data: bytes) -> None:
        self.data += data

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.append(exc)


class Connection:
    """A pty, of which the library reads one end and the test has the other."""

    def __init__(self) -> None:
        self.board, slave = os.openpty()
        tty.setraw(self.board)
        self.device: serial.Serial = open_raw(os.ttyname(slave), 115200)
        os.close(slave)
        self.fd: int = self.device.fileno()
        self.calls = Calls()

    async def connect(self) -> serial_asyncio.SerialTransport:
        loop = asyncio.get_running_loop()
        transport, calls = await serial_asyncio.connection_for_serial(
            loop, lambda: self.calls, self.device
        )
        assert calls is self.calls
        assert transport.serial is self.device
        await until(lambda: self.calls.made == [transport])
        return transport

    def unplug(self) -> None:
        os.close(self.board)
        self.board = -1


@pytest.fixture
def connection() -> Iterator[Connection]:
    connection = Connection()
    yield connection
    with suppress(OSError):
        os.close(connection.board)


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(5.0):
        while not holds():
            await asyncio.sleep(0.001)


def has_reader(fd: int) -> bool:
    return asyncio.get_running_loop().remove_reader(fd)


async def test_the_reader_gets_all_bytes_in_their_order_until_it_is_paused(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    text = b"".join(b"%04d\r\n" % number for number in range(500))
    os.write(connection.board, text)
    await until(lambda: len(connection.calls.data) >= len(text))
    assert connection.calls.data == text
    transport.pause_reading()
    os.write(connection.board, LINE)
    await asyncio.sleep(0.02)
    assert connection.calls.data == text
    assert os.read(connection.fd, 100) == LINE
    assert connection.calls.lost == []
    transport.abort()
    await until(lambda: connection.calls.lost == [None])


async def test_the_library_sends_nothing_and_keeps_none_of_the_bytes_that_the_driver_refuses(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    sent = 0
    with suppress(BlockingIOError):
        while True:
            sent += os.write(connection.fd, LINE)
    assert transport.get_write_buffer_size() == 0
    os.set_blocking(connection.board, False)
    received = b""
    for _ in range(50):
        with suppress(BlockingIOError):
            received += os.read(connection.board, 65536)
        await asyncio.sleep(0.001)
    assert received == (LINE * sent)[:sent]
    os.write(connection.board, LINE)  # a full port reads on
    await until(lambda: connection.calls.data == LINE)
    transport.abort()
    await until(lambda: connection.calls.lost == [None])


async def test_an_unplugged_device_is_lost_once_with_an_error_and_has_no_reader(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    connection.unplug()
    await until(lambda: bool(connection.calls.lost))
    await asyncio.sleep(0.02)
    (error,) = connection.calls.lost
    assert isinstance(error, serial.SerialException)
    assert transport.is_closing()
    assert not connection.device.is_open
    assert not has_reader(connection.fd)


async def test_an_aborted_connection_ends_without_an_error_and_closes_its_descriptor(
    connection: Connection,
) -> None:
    transport = await connection.connect()
    transport.pause_reading()
    close(connection.device, wait_s=5.0)  # the descriptor of `device` is now /dev/null
    transport.abort()
    assert transport.is_closing()
    await until(lambda: bool(connection.calls.lost))
    assert connection.calls.lost == [None]
    assert transport.serial is None
    assert not connection.device.is_open
    assert not has_reader(connection.fd)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(connection.fd)
