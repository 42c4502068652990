"""The serial port itself, on a real pty: what it sends and what it does not."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Sequence

from acsard.host import clock
from acsard.mcu.port import STALE_NS
from acsard.serial.port import SerialPort
from acsard.values import Instant

STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
GO = b"ap05.00,bp05.00,cp05.00,dp05.00\r\n"


def test_a_line_made_before_the_process_stood_still_does_not_leave_after_it() -> None:
    """The step was stopped before it wrote, and goes on later. A stop is never too old."""

    async def offered() -> Sequence[str]:
        async with SerialPort(path, 115200, STOP, lambda: None, lambda event: None) as port:
            answers = [port.offer(STOP, clock.now())]
            await asyncio.sleep(0.01)  # the wire is free again
            now = clock.now()
            before = Instant(now.mono_ns - STALE_NS - 1, now.wall_ns)
            answers.append(port.offer(GO, before))
            answers.append(port.offer(GO, clock.now()))
            await asyncio.sleep(0.03)
            later = clock.now()
            late = Instant(later.mono_ns - STALE_NS - 1, later.wall_ns)
            answers.append(port.offer(STOP, late))
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
