"""A program that drives over the page's WebSocket from another host, and loses the network.

`unit/page_stories.js` has each way to release the stick. Here is what only a network can do: what
the program sent without one arrives later, and no program gets an error.
"""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from acsard.machine.authority import Authority
from tests.system.browser import Hands, Page
from tests.system.bystander import lost
from tests.system.harness import ZERO_LINE, Daemon, FarPeer, until, wheels
from tests.system.hosts import Hosts, inside, on

TIMEOUT_S, TICK_S = 0.25, 0.01
"""The timeout of source teleop, and the period of the control loop."""

SPEED, STEADY, LINES = 0.2, b"ap04.00", 10
"""A speed in m/s, the beginning of its line, and the number of these that count as steady."""

EMPTY = b"-"
"""The line with which the daemon starts again after a busy machine kept the answers from it."""

HANDS = 3
"""The program, server and daemon on the way of a command. A busy machine delays each."""


@pytest.mark.network
async def test_commands_that_a_program_sent_without_a_network_are_not_obeyed_later(
    hosts: Hosts, tmp_path: Path
) -> None:
    """The program does not notice that the network is cut, and drives on, backwards."""
    Authority.make(tmp_path / "tls", "test", 1, [hosts.address]).issue(
        tmp_path / "tls", "robot", [hosts.address], 1
    )
    with (
        FarPeer(tmp_path) as peer,
        on(hosts.robot, Daemon(tmp_path, peer.path)) as daemon,
        on(hosts.robot, Page(daemon, tmp_path, at=hosts.address)) as server,
    ):
        token = server.invite("operator", "phone")
        with inside(hosts.stranger):
            session = server.client(token)
            opened = await session.ws_connect(f"{server.away}/ws")

        def steady() -> bool:
            last = peer.since(begun)[-LINES:]
            return len(last) == LINES and all(entry.line.startswith(STEADY) for entry in last)

        async with session, opened, asyncio.timeout(60.0):
            program, begun = Hands(opened), time.monotonic()
            await program.say(subscribe="state", rate=50)
            await program.until_driving(SPEED)
            driving = asyncio.create_task(program.hold(SPEED, 60.0))
            await asyncio.to_thread(until, steady, 10.0, "it drives")
            hosts.cut()
            cut = time.monotonic()
            try:
                driving.cancel()
                driving = asyncio.create_task(program.hold(-SPEED, 60.0))
                await asyncio.to_thread(peer.awaits, ZERO_LINE.strip(), after=cut)
                await asyncio.sleep(max(0.0, cut + 1.5 - time.monotonic()))
                driving.cancel()
                driving = asyncio.create_task(program.hold(SPEED, 60.0))
            finally:
                hosts.heal()
            # One connection delivers what was sent without a network before anything later. That
            # needs at most as long again as the network was cut.
            await asyncio.sleep(time.monotonic() - cut + 1.0)
            driving.cancel()
        after = [entry for entry in peer.since(cut) if entry.line != EMPTY]
    slower = next(entry.at for entry in after if not entry.line.startswith(STEADY))
    assert slower - cut <= TIMEOUT_S + 2 * TICK_S + HANDS * lost(cut, slower)
    assert [entry.line for entry in after if wheels(entry.line)[0] < 0.0] == []
