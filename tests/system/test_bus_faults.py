"""Clients that stand still, and a router that dies, hold up no line (SAFETY section 2).

`test_inputs.py` floods the bus, and `test_lateness_echo.py` delays and cuts it.
"""

from __future__ import annotations

import itertools
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    FarPeer,
    Program,
    ReceivedLine,
    Tables,
    broken,
    client_config,
    free_endpoint,
    until,
)
from tests.system.strangers import COMMANDER, HOARDER, ROUTER, command_line

pytestmark = pytest.mark.slow

TICK_S = 0.01


def longest_gap(lines: list[ReceivedLine]) -> float:
    """Return the longest gap between two lines in s, less the time lost to other programs."""
    pairs = [(a.at, b.at) for a, b in itertools.pairwise(lines)]
    return max(b - a - (lost(a, b) if b - a > 2 * TICK_S else 0.0) for a, b in pairs)


def filled(daemon: Daemon, filler: Bus) -> bool:
    """Return whether the kernel's buffers for the four stopped clients take no more bytes.

    `filler` sends additional messages, because the daemon's own would take a minute to fill them.
    """

    def unsent() -> list[int]:
        port = int(daemon.endpoint.rpartition(":")[2])
        rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        mine = [row for row in rows if int(row[1].partition(":")[2], 16) == port and row[3] == "01"]
        return sorted(int(row[4].partition(":")[0], 16) for row in mine)[-4:]

    before = unsent()
    for _ in range(40):
        filler.session.put("acsard/acsar/cmd/filler", b"." * 50_000)
    time.sleep(0.3)
    return unsent() == before and min(before) > 0


def test_four_stopped_subscribers_hold_up_no_line(tmp_path: Path) -> None:
    with FarPeer(tmp_path) as peer, Daemon(tmp_path, peer.path) as daemon, ExitStack() as stack:
        peer.awaits(b"ap00.00")
        words = command_line(HOARDER, f"{daemon.endpoint}#so_rcvbuf=4096")
        four = [stack.enter_context(Program(words, tmp_path)) for _ in range(4)]
        for listener in four:
            listener.says("listening")
        for listener in four:
            listener.signal(signal.SIGSTOP)
        try:
            filler = stack.enter_context(Bus(daemon.endpoint))
            until(lambda: filled(daemon, filler), 60.0, "the kernel takes no more for them")
            begun = time.monotonic()
            until(lambda: len(peer.since(begun)) > 40, 5.0, "40 lines")
            assert longest_gap(peer.since(begun)) < 0.1
            with Bus(daemon.endpoint) as healthy, healthy.follow("odom") as odom:
                odom.find(lambda _: True, 2.0, "odometry for one that listens")
        finally:
            for listener in four:
                listener.signal(signal.SIGCONT)


def test_a_router_that_dies_and_returns_does_not_touch_local_driving(tmp_path: Path) -> None:
    routed = free_endpoint()
    config: Tables = {"bus": {"connect": [routed]}}
    with ExitStack() as stack:
        peer = stack.enter_context(FarPeer(tmp_path))
        router = stack.enter_context(Program(command_line(ROUTER, routed), tmp_path))
        router.says("routing")
        daemon = stack.enter_context(Daemon(tmp_path, peer.path, config))
        commander = command_line(COMMANDER, daemon.endpoint, "app", 0.2, 1)
        stack.enter_context(Program(commander, tmp_path))
        with Bus(routed) as remote, remote.follow("odom") as odom:
            odom.find(lambda _: True, 5.0, "odometry behind the router")
        states = stack.enter_context(stack.enter_context(Bus(daemon.endpoint)).follow("state"))
        steady = peer.awaits(b"ap04.00").at
        router.signal(signal.SIGKILL)
        router.ended(5.0)
        again = stack.enter_context(Program(command_line(ROUTER, routed), tmp_path))
        back = float(again.says("routing").split()[1])
        with zenoh.open(client_config(routed)) as session:
            samples = session.declare_subscriber(
                "acsard/acsar/odom", zenoh.handlers.FifoChannel(100)
            )
            until(samples.try_recv, 10.0, "odometry behind the new router")
            took = time.monotonic() - back - lost(back)
        lines = peer.since(steady)
    assert {e.line[:7] for e in lines} == {b"ap04.00"} or broken(states, steady), "it drove on"
    assert longest_gap(lines) <= 0.06
    assert took <= 2.0
