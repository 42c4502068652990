"""What the robot's page costs, and how long a command takes through it: figures, and ratios."""

from __future__ import annotations

import asyncio
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from acsard.client import connect
from tests.system.browser import Hands, Page, hands, run
from tests.system.harness import (
    Bus,
    Daemon,
    Peer,
    Periods,
    Program,
    cpu_seconds,
    resident_kb,
    until,
)

pytestmark = [pytest.mark.bench, pytest.mark.timeout(240)]

VIEWERS = """\
import asyncio, sys, aiohttp

KEYS = ("odom", "state", "wheel_states", "cmd_vel_out")


async def view(session, url):
    async with session.ws_connect(url) as socket:
        for key in KEYS:
            await socket.send_json({"subscribe": key, "rate": 10})
        frames = 0
        async for message in socket:
            frames += 1
            if frames == 20:
                print("sees", flush=True)


async def main():
    async with aiohttp.ClientSession() as session:
        await asyncio.gather(*(view(session, sys.argv[1]) for _ in range(int(sys.argv[2]))))


asyncio.run(main())
"""
"""Headless pages that look at four keys at 10 Hz each."""

SECONDS = 10.0

COMMANDS = 300


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[Peer]:
    """A serial peer that is not ours."""
    with Peer(tmp_path / "mcu") as peer:
        yield peer


def watched(page: Page, daemon: Daemon, bus: Bus) -> tuple[float, int, Periods, float]:
    """Share of a core and kB of the page, periods and lateness (us, p99) of the daemon."""
    first, cpu, at = bus.state(), cpu_seconds(page.pid), time.monotonic()
    time.sleep(SECONDS)
    share = (cpu_seconds(page.pid) - cpu) / (time.monotonic() - at)
    last = bus.state()
    late = last["figures"]["period_lateness"]["last_minute"]["p99"]
    return share, resident_kb(page.pid), Periods.between(first, last), late


def test_twenty_viewers_cost_the_page_and_not_the_robot(tmp_path: Path) -> None:
    missed = {}
    for count in (0, 1, 20):  # a daemon each, since lateness is of the last minute
        with Daemon(tmp_path) as daemon, Page(daemon, tmp_path) as page, Bus(daemon.endpoint) as b:
            b.linked()
            viewers = Program(
                [sys.executable, "-c", VIEWERS, f"{page.here}/ws", str(count)], tmp_path
            )
            with viewers:
                if count:
                    until(lambda v=viewers, c=count: len(v.out) == c, 10.0, "all see")  # type: ignore[misc]
                share, kb, periods, late = watched(page, daemon, b)
            missed[count] = periods.missed
            print(
                f"\n{count:2} viewers: page {100 * share:.1f} % of a core, {kb / 1000:.0f} MB; "
                f"daemon {periods.missed} of {periods.elapsed:.0f} periods missed, "
                f"late p99 {late:.0f} us"
            )
            assert kb < 120_000


def lines_with(peer: Peer, speed: float, after: float) -> float | None:
    """When the first line with this wheel speed came."""
    want = f"ap{speed:05.2f},".encode()
    return next((h.at for h in peer.lines[-50:] if h.at >= after and h.line.startswith(want)), None)


async def measured(peer: Peer, send: Callable[[float], object]) -> list[float]:
    """ms from a command to its first byte's line on the port, commands at 20 Hz."""
    found = []
    for n in range(COMMANDS):
        linear = 0.2 if n % 2 else 0.25
        sent = time.monotonic()
        told = send(linear)
        if asyncio.iscoroutine(told):
            await told
        await asyncio.sleep(0.05)
        at = lines_with(peer, linear / 0.05, sent)
        if at is not None:
            found.append(1000 * (at - sent))
    return found


def told(what: str, times: list[float]) -> float:
    """Prints the spread; the median."""
    times.sort()
    p50, p99 = statistics.median(times), times[int(len(times) * 0.99)]
    print(f"\n{what}: {len(times)} commands, p50 {p50:.2f} ms, p99 {p99:.2f} ms")
    return p50


def test_a_command_by_the_page_is_soon_on_the_port(tmp_path: Path, peer: Peer) -> None:
    fast = {"linear_acceleration": 100.0, "linear_deceleration": 100.0}
    fast["linear_stop_deceleration"] = 100.0
    with Daemon(tmp_path, peer.path, {"limits": fast}) as daemon, Page(daemon, tmp_path) as page:
        medians = {}

        async def by_page() -> None:
            async with hands(page) as ours:
                reading = asyncio.create_task(_read(ours))
                await ours.hold(0.0, 0.8)
                medians["page"] = told("page", await measured(peer, ours.drive))
                reading.cancel()

        run(by_page, 120.0)
        with connect(daemon.endpoint, source="teleop") as robot:
            for _ in range(80):
                robot.send(0.0)
                time.sleep(0.02)
            medians["client"] = told("client", asyncio.run(measured(peer, robot.send)))
    assert medians["page"] < 10 * max(medians["client"], 0.5)


async def _read(ours: Hands) -> None:
    while True:
        json.loads((await ours.socket.receive()).data)
