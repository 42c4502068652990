"""The serial port on a real pty sends what it should, and nothing else."""

from __future__ import annotations

import array
import asyncio
import errno
import fcntl
import itertools
import os
import select
import termios
import threading
import tty
from collections.abc import Sequence
from contextlib import suppress

import pytest
import serial

from acsard.core.config.settings import McuConfig
from acsard.core.link.checksum import seal
from acsard.core.link.session import McuSession
from acsard.core.values import NS_PER_S, STILL, Event, Instant, Received
from acsard.daemon.serial.device import open_raw
from acsard.daemon.serial.port import HUNG, SerialPort
from acsard.host import clock
from acsard.host.clock import Asleep
from tests.system.harness import until

PERIOD_NS = 10_000_000
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
TIOCGEXCL = 0x80045440
"""From asm-generic/ioctls.h: ask whether a terminal is exclusive."""

GO = b"ap05.00,bp05.00,cp05.00,dp05.00\r\n"


def test_a_line_made_before_the_process_stood_still_does_not_leave_after_it() -> None:
    """The step was suspended before it wrote, and goes on later. A stop is never too old."""

    async def offered() -> Sequence[str]:
        async with SerialPort(
            path, 115200, STOP, PERIOD_NS, lambda: None, lambda event: None
        ) as port:
            answers = [port.offer(STOP, clock.now())]
            await asyncio.sleep(0.01)  # the wire is free again
            now = clock.now()
            before = Instant(now.mono_ns - PERIOD_NS - 1, now.wall_ns)
            answers.append(port.offer(GO, before))
            answers.append(port.offer(GO, clock.now()))
            await asyncio.sleep(0.03)
            later = clock.now()
            late = Instant(later.mono_ns - PERIOD_NS - 1, later.wall_ns)
            answers.append(port.offer(seal(STOP, 7), late))
            return answers

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        assert asyncio.run(offered()) == ["sent", "superseded", "sent", "sent"]
        assert os.read(master, 4096).count(GO) == 1
    finally:
        os.close(master)
        os.close(slave)


def test_behind_a_suspend_the_port_is_opened_anew() -> None:
    """The clock simulates the suspend, because this machine cannot be suspended."""
    slept, told = [0], list[Event]()

    async def opened() -> tuple[int, bool, int]:
        asleep = Asleep(lambda: slept[0])
        async with SerialPort(
            path, 115200, STOP, PERIOD_NS, lambda: None, told.append, asleep
        ) as port:
            port.take()
            before, slept[0] = port.opened, 8 * 3600 * 10**9
            assert port.take() == ()
            lost = not port.is_open and port.offer(GO, clock.now()) == "down"
            keeping = asyncio.create_task(port.keep_open())
            while not port.is_open:
                await asyncio.sleep(0.001)
            port.take()
            keeping.cancel()
            return before, lost, port.opened

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        assert asyncio.run(opened()) == (1, True, 2)
        assert "suspended" in next(one.text for one in told if one.name == "port_lost")
        assert GO not in os.read(master, 4096)
    finally:
        os.close(master)
        os.close(slave)


def test_a_port_for_which_there_was_no_thread_is_opened_by_the_next_try() -> None:
    told = list[Event]()

    async def opened() -> bool:
        usual = threading.stack_size(1 << 46)  # for which no machine has room
        try:
            port = await SerialPort(
                path, 115200, STOP, PERIOD_NS, lambda: None, told.append
            ).__aenter__()
        finally:
            threading.stack_size(usual)
        assert not port.is_open
        keeping = asyncio.create_task(port.keep_open())
        async with asyncio.timeout(5.0):
            while not port.is_open:
                await asyncio.sleep(0.001)
        keeping.cancel()
        await port.__aexit__(None, None, None)
        return True

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        assert asyncio.run(opened())
        assert "cannot start another thread" in told[0].text
    finally:
        os.close(master)
        os.close(slave)


def test_a_step_that_comes_late_reads_what_lies_there_before_it_judges_a_silence() -> None:
    """After a stall both the clock and the reader are due, in any order."""

    async def taken() -> tuple[list[bytes], Sequence[Received], list[bytes]]:
        async with SerialPort(
            path, 115200, STOP, PERIOD_NS, lambda: None, lambda event: None
        ) as port:
            os.write(master, GO)
            in_time, now = port.take(), clock.now()
            end_ns = clock.mono_ns() + 5 * 10**9
            late = port.take(now)  # no reader has run: the event loop has not reached it
            while not late and clock.mono_ns() < end_ns:
                late = port.take(now)
            await asyncio.sleep(0.01)
            again = [one.data for one in port.take()]
            return [one.data for one in in_time], late, again

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        in_time, late, again = asyncio.run(taken())
        assert in_time == again == []
        assert [one.data for one in late] == [GO]
    finally:
        os.close(master)
        os.close(slave)


def test_a_reader_whose_turn_comes_behind_a_late_step_s_finds_nothing_and_no_hang_up() -> None:
    """The step takes the bytes that were there when the event loop looked.

    The reader is called nevertheless.
    """

    async def kept() -> tuple[int, bool, str]:
        async with SerialPort(
            path, 115200, STOP, PERIOD_NS, lambda: None, lambda event: None
        ) as port:
            loop, taken = asyncio.get_running_loop(), list[bytes]()

            def late_step() -> None:
                taken.extend(one.data for one in port.take(clock.now()))

            for _ in range(10):
                os.write(master, GO)
                select.select([port._fd], [], [], 5.0)
                # The reader is in the event loop's list before the loop finds that there is
                # something to read.
                loop.call_soon(late_step)
                await asyncio.sleep(0.001)
            return b"".join(taken).count(GO), port.is_open, port.trouble

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        assert asyncio.run(kept()) == (10, True, "")
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize("name", ["tcgetattr", "tcsetattr", "tcflush"])
def test_a_device_that_vanishes_while_it_is_opened_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Suspend each call of the opening in turn until one succeeds. No attempt ends the daemon."""
    master, slave = os.openpty()
    path, real, attempts = os.ttyname(slave), getattr(termios, name), itertools.count(1)
    left = 1

    def vanishing(*arguments: object) -> object:
        nonlocal left
        left -= 1
        if not left:
            left = next(attempts) + 1
            raise termios.error(errno.EIO, "Input/output error")
        return real(*arguments)

    async def opened() -> tuple[bool, list[str]]:
        said = list[str]()
        async with SerialPort(
            path, 115200, STOP, PERIOD_NS, lambda: None, lambda event: said.append(event.name)
        ) as port:
            keeper = asyncio.create_task(port.keep_open())
            deadline_ns = clock.mono_ns() + 10 * 10**9
            while not port.is_open and not keeper.done() and clock.mono_ns() < deadline_ns:
                await asyncio.sleep(0.01)
            found = port.is_open, said
            keeper.cancel()
            await asyncio.wait([keeper])
            return found

    try:
        monkeypatch.setattr(termios, name, vanishing)
        is_open, said = asyncio.run(opened())
    finally:
        monkeypatch.undo()
        os.close(master)
        os.close(slave)
    assert is_open
    assert said[0] == "port_waiting"
    assert said[-1] == "port_open"


def test_a_port_whose_driver_takes_nothing_is_told_though_it_still_receives() -> None:
    """The far end reports by its own clock and does not read."""
    report = GO * 2

    async def links(master: int, full: int) -> list[tuple[str, bool]]:
        wake = asyncio.Event()
        session = McuSession(McuConfig(), 100.0)
        async with SerialPort(path, 115200, STOP, PERIOD_NS, wake.set, lambda event: None) as port:
            unsent, seen = False, [("down", False)]

            async def until(link: str) -> None:
                nonlocal unsent
                deadline_ns = clock.mono_ns() + 5 * NS_PER_S
                while session.link != link and clock.mono_ns() < deadline_ns:
                    os.write(master, report)
                    await asyncio.wait_for(wake.wait(), 5.0)
                    wake.clear()
                    now = clock.now()
                    session.update(now, port.is_open, port.opened, port.take(), unsent)
                    line = session.line(now.mono_ns, STILL)
                    unsent = line is not None and port.offer(line, now) != "sent"
                    await asyncio.sleep(0.01)  # the wire is free again
                seen.append((session.link, session.blocked))

            await until("up")
            with suppress(BlockingIOError):
                while True:
                    os.write(full, bytes(4096))
            await until("stale")
            with suppress(BlockingIOError):
                while True:
                    os.read(master, 65536)
            await until("up")
            return seen

    master, slave = os.openpty()
    try:
        tty.setraw(master)
        path = os.ttyname(slave)
        os.set_blocking(master, False)
        os.set_blocking(slave, False)
        seen = asyncio.run(links(master, slave))
        assert seen == [("down", False), ("up", False), ("stale", True), ("up", False)]
    finally:
        os.close(master)
        os.close(slave)


def test_a_device_that_opened_too_late_is_not_left_exclusive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opens, opened = threading.Event(), threading.Event()

    def open_late(path: str, baud_rate: int) -> serial.Serial:
        opens.wait(10.0)
        device = open_raw(path, baud_rate)
        opened.set()
        return device

    async def trouble() -> str:
        async with SerialPort(path, 115200, STOP, PERIOD_NS, lambda: None, lambda _: None) as port:
            return port.trouble

    def exclusive() -> bool:
        mark = array.array("i", [0])
        fcntl.ioctl(slave, TIOCGEXCL, mark)
        return bool(mark[0])

    monkeypatch.setattr("acsard.daemon.serial.port.OPEN_TIMEOUT_S", 0.01)
    monkeypatch.setattr("acsard.daemon.serial.port.open_raw", open_late)
    master, slave = os.openpty()
    try:
        path = os.ttyname(slave)
        assert HUNG in asyncio.run(trouble())
        opens.set()
        assert opened.wait(10.0)
        until(lambda: not exclusive(), 1.0, "others may open the device")
    finally:
        os.close(master)
        os.close(slave)
