"""Tests of the built-in simulator as a device.

They show how `[sim] faults` changes the bytes that the simulator sends.
"""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable

from acsard.core.config.settings import Config, SimConfig
from acsard.core.simulator.faults import USB_PACKET
from acsard.daemon.serial.simulator_pty import Simulated

LINE = b"ap00.00,bp00.00,cp00.00,dp00.00\n"


async def first_piece(faults: tuple[str, ...], enough: Callable[[bytes], bool]) -> bytes:
    """Send lines and read one piece of data after each, until `enough` accepts a piece.

    Return it.
    """
    future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
    with Simulated(Config(sim=SimConfig(faults=faults))) as simulated:
        device = os.open(simulated.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(device)

        def more() -> None:
            piece = os.read(device, 4096)
            os.write(device, LINE)
            if enough(piece) and not future.done():
                future.set_result(piece)

        asyncio.get_running_loop().add_reader(device, more)
        try:
            os.write(device, LINE * 12)
            return await asyncio.wait_for(future, 20.0)
        finally:
            asyncio.get_running_loop().remove_reader(device)
            os.close(device)


def test_with_ftdi_replies_come_in_the_adapters_packets_and_not_line_by_line() -> None:
    def packets(piece: bytes) -> bool:
        # A late read may also get the rest that the adapter sent after its latency.
        return len(piece) % USB_PACKET == 0 and not piece.endswith(b"\n")

    assert asyncio.run(first_piece(("ftdi",), packets))


def test_several_simulated_faults_act_together() -> None:
    def noisy(piece: bytes) -> bool:
        return b"\x00\xff~ap0.00, bp" in piece

    assert asyncio.run(first_piece(("noise", "spaces", "unpadded"), noisy))
