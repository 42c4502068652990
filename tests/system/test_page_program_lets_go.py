"""Each way to leave the robot's page ends the drive, and the robot obeys no later command of it."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tests.system.browser import Hands, Page, hands, run
from tests.system.harness import Bus, Daemon

Way = Callable[[Hands, Page], Awaitable[None]]


async def closes(ours: Hands, page: Page) -> None:
    """The user closes the tab."""
    await ours.socket.close()


async def vanishes(ours: Hands, page: Page) -> None:
    """The browser is killed: the kernel resets its connection."""
    ours.socket._writer.transport.abort()


async def freezes(ours: Hands, page: Page) -> None:
    """The browser is suspended or its network is gone: it sends nothing and does not disconnect."""


async def releases(ours: Hands, page: Page) -> None:
    """The user lifts the finger: the page sends one zero and then nothing."""
    await ours.drive(0.0)


async def is_asked_to_end(ours: Hands, page: Page) -> None:
    """The page's server gets SIGTERM."""
    page.signal(signal.SIGTERM)


async def is_killed(ours: Hands, page: Page) -> None:
    """The page's server dies."""
    page.signal(signal.SIGKILL)


async def freezes_for_a_while(ours: Hands, page: Page) -> None:
    """The page's server is suspended while commands come in, and continues later."""
    page.signal(signal.SIGSTOP)
    try:
        await ours.hold(0.3, 0.5)
        await asyncio.sleep(0.5)  # longer than any command counts
    finally:
        page.signal(signal.SIGCONT)


OF_THE_BROWSER: tuple[Way, ...] = (closes, vanishes, freezes, releases, freezes_for_a_while)
OF_THE_SERVER: tuple[Way, ...] = (is_asked_to_end, is_killed)


def let_go(daemon: Daemon, page: Page, way: Way) -> None:
    """Drive and leave in this way. Check that no later command moves the robot again."""
    with Bus(daemon.endpoint) as bus:
        bus.at_rest()

        async def story() -> None:
            async with hands(page) as ours:
                await ours.say(subscribe="state", rate=50)
                await ours.until_driving(0.3)
                before = bus.count("commands")
                await way(ours, page)
                at_rest = bus.at_rest()
                await asyncio.sleep(0.3)
                after = bus.state()
                # One command may be on its way at that moment, and one more may wait; then follows
                # at most a zero.
                assert after["counters"]["commands"] <= before + 3
                assert abs(after["x"] - at_rest["x"]) < 0.005

        run(story)


TIMES = pytest.mark.parametrize(
    "times",
    [
        pytest.param(1, marks=pytest.mark.network),
        pytest.param(100, marks=[pytest.mark.soak, pytest.mark.timeout(3600)]),
    ],
)


@TIMES
@pytest.mark.parametrize("way", OF_THE_BROWSER, ids=lambda way: way.__name__)
def test_a_client_that_releases_the_stick_drives_no_more(
    daemon: Daemon, page: Page, way: Way, times: int
) -> None:
    for _ in range(times):
        let_go(daemon, page, way)


@TIMES
@pytest.mark.parametrize("way", OF_THE_SERVER, ids=lambda way: way.__name__)
def test_a_client_whose_page_server_ends_drives_no_more(
    daemon: Daemon, tmp_path: Path, way: Way, times: int
) -> None:
    for n in range(times):
        where = tmp_path / str(n)
        where.mkdir()
        with Page(daemon, where) as page:
            let_go(daemon, page, way)
