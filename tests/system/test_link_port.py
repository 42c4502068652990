"""The serial port on a real pty sends fresh lines only, and copes with a lost or stuck device."""

from __future__ import annotations

import array
import asyncio
import fcntl
import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
import serial

from acsard.core.link.checked_line import seal
from acsard.core.values import Event, Instant
from acsard.daemon.serial.device import close, open_raw
from acsard.daemon.serial.port import DRIVER_HUNG, SerialPort
from acsard.host import clock
from acsard.host.clock import SuspendDetector
from tests.system.harness import until

PERIOD_NS = 10_000_000
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
TIOCGEXCL = 0x80045440
"""From asm-generic/ioctls.h: ask whether a terminal is exclusive."""

GO = b"ap05.00,bp05.00,cp05.00,dp05.00\r\n"


class Line(NamedTuple):
    """A pty: the board's end, the port's end, and the port's path."""

    board: int
    device: int
    path: str

    def port(
        self,
        tell: Callable[[Event], None] = lambda event: None,
        wake: Callable[[Instant], None] = lambda now: None,
        asleep: SuspendDetector | None = None,
    ) -> SerialPort:
        return SerialPort(self.path, 115200, STOP, PERIOD_NS, wake, tell, asleep)


@pytest.fixture
def line() -> Iterator[Line]:
    board, device = os.openpty()
    tty.setraw(board)
    yield Line(board, device, os.ttyname(device))
    os.close(board)
    os.close(device)


async def test_a_line_made_before_the_process_was_suspended_is_not_sent_after_it(
    line: Line,
) -> None:
    """The process was suspended after a step had made a line.

    The port sends a stop instead if the line is older than one period. It sends a stop of any age.
    """
    async with line.port() as port:
        assert port.offer(STOP, clock.now()) == "sent"
        await asyncio.sleep(0.01)  # the wire is free again
        now = clock.now()
        before = Instant(now.mono_ns - PERIOD_NS - 1, now.wall_ns)
        assert port.offer(GO, before) == "superseded"
        assert port.offer(GO, clock.now()) == "sent"
        await asyncio.sleep(0.03)
        later = clock.now()
        late = Instant(later.mono_ns - PERIOD_NS - 1, later.wall_ns)
        assert port.offer(seal(STOP, 7), late) == "sent"
    assert os.read(line.board, 4096).count(GO) == 1


async def test_the_port_is_reopened_after_a_suspend(line: Line) -> None:
    """The clock simulates the suspend, because this machine cannot be suspended."""
    slept, events = [0], list[Event]()
    async with line.port(events.append, asleep=SuspendDetector(lambda: slept[0])) as port:
        assert port.offer(STOP, clock.now()) == "sent"
        assert port.opened == 1
        await asyncio.sleep(0.01)  # the wire is free again
        slept[0] = 8 * 3600 * 10**9
        assert port.offer(GO, clock.now()) == "down"
        assert not port.is_open
        keeping = asyncio.create_task(port.keep_open())
        while not port.is_open:
            await asyncio.sleep(0.001)
        assert port.offer(STOP, clock.now()) == "sent"
        keeping.cancel()
        assert port.opened == 2
    assert "suspended" in next(event.text for event in events if event.name == "port_lost")
    assert GO not in os.read(line.board, 4096)


async def test_a_port_is_opened_by_the_next_try_if_no_thread_could_start(line: Line) -> None:
    port_events = list[Event]()
    usual = threading.stack_size(1 << 46)  # for which no machine has room
    try:
        port = await line.port(port_events.append).__aenter__()
    finally:
        threading.stack_size(usual)
    assert not port.is_open
    keeping = asyncio.create_task(port.keep_open())
    async with asyncio.timeout(5.0):
        while not port.is_open:
            await asyncio.sleep(0.001)
    keeping.cancel()
    await port.__aexit__(None, None, None)
    assert "cannot start another thread" in port_events[0].text


async def test_a_late_step_reads_waiting_bytes_before_it_judges_a_silence(
    line: Line,
) -> None:
    """After a stall the step may run before the reader. It then reads the waiting bytes itself."""
    async with line.port() as port:
        os.write(line.board, GO)
        assert port.take() == ()
        now = clock.now()
        end_ns = clock.mono_ns() + 5 * 10**9
        late = port.take(now)  # no reader has run: the event loop has not reached it
        while not late and clock.mono_ns() < end_ns:
            late = port.take(now)
        assert [chunk.data for chunk in late] == [GO]
        await asyncio.sleep(0.01)
        assert port.take() == ()


async def test_a_line_sent_right_after_the_device_hung_up_is_lost_without_an_error() -> None:
    """The reader and the step can notice the hang-up in the same round of the event loop."""
    loop, errors, names = asyncio.get_running_loop(), list[str](), list[str]()
    loop.set_exception_handler(lambda _, context: errors.append(str(context)))
    board, device = os.openpty()
    tty.setraw(board)
    unplugged = Line(board, device, os.ttyname(device))
    async with unplugged.port(lambda event: names.append(event.name)) as port:
        assert port.offer(STOP, clock.now()) == "sent"
        await asyncio.sleep(0.01)  # the wire is free again
        offered = list[str]()
        loop.call_later(0.001, lambda: offered.append(port.offer(GO, clock.now())))
        os.close(board)
        os.close(device)
        time.sleep(0.005)  # both are due when the event loop looks next
        await asyncio.sleep(0.01)
        assert offered == ["down"]
        assert names == ["port_open", "port_lost"]
    assert errors == []


async def test_a_released_port_is_closed_with_zeros_and_opened_again(line: Line) -> None:
    async with line.port() as port:
        keeper = asyncio.create_task(port.keep_open())
        assert port.offer(STOP, clock.now()) == "sent"
        port.release(True)
        await asyncio.sleep(0.5)
        assert (port.is_open, port.opened, port.offer(STOP, clock.now())) == (False, 1, "down")
        other = open_raw(line.path, 115200)
        port.release(False)
        await asyncio.sleep(0.3)
        assert not port.is_open, "the other program still has it"
        close(other, wait_s=1.0)
        other.close()
        async with asyncio.timeout(5.0):
            while not port.is_open:
                await asyncio.sleep(0.01)
        assert port.opened == 2
        keeper.cancel()


async def test_a_device_that_opened_too_late_is_not_left_exclusive(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    opens, opened = threading.Event(), threading.Event()

    def open_late(path: str, baud_rate: int) -> serial.Serial:
        opens.wait(10.0)
        device = open_raw(path, baud_rate)
        opened.set()
        return device

    def exclusive() -> bool:
        mark = array.array("i", [0])
        fcntl.ioctl(line.device, TIOCGEXCL, mark)
        return bool(mark[0])

    monkeypatch.setattr("acsard.daemon.serial.port.OPEN_TIMEOUT_S", 0.01)
    monkeypatch.setattr("acsard.daemon.serial.port.open_raw", open_late)
    async with line.port() as port:
        assert DRIVER_HUNG in port.trouble
    opens.set()
    assert opened.wait(10.0)
    until(lambda: not exclusive(), 1.0, "others may open the device")
