"""A client that answers the questions of a check or a calibration over the page's WebSocket."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.system.browser import Hands, Page, hands
from tests.system.harness import Daemon, Tables, children, free_endpoint, until, write_config

PING_S = 0.1

WHEELS = ("fr", "fl", "rl", "rr")


class NoDaemon(Daemon):
    """A configuration file without a running daemon."""

    def __init__(self, where: Path, port: str = "sim") -> None:
        self.endpoint = free_endpoint()
        tables: Tables = {"mcu": {"port": port}, "bus": {"listen": [self.endpoint]}}
        self.config = write_config(where / "alone.toml", tables)


class Guided:
    """The client of a check or calibration. It pings the page's server as a browser does."""

    def __init__(self, ours: Hands, pinging: asyncio.Task[None] | None = None) -> None:
        self.ours, self._pinging = ours, pinging

    def falls_silent(self) -> None:
        """Stop the pings from now on, without closing anything."""
        if self._pinging is not None:
            self._pinging.cancel()

    async def begin(self, what: str, **more: object) -> None:
        await self.ours.say(begin=what, **more)

    async def says(self, look: Callable[[Any], Any]) -> Any:
        """Return the first message that `look` accepts. Fails if the procedure has ended before."""

        def found(frame: Any) -> Any:
            found = "guide" in frame and look(frame["guide"])
            assert found or "ended" not in frame.get("guide", {}), frame
            return found

        return (await self.ours.find(found))["guide"]

    async def asks(self, words: str = "") -> Any:
        """Return the next question, which must contain these words."""
        question = await self.says(lambda message: "question" in message)
        assert words in question["words"], question
        return question

    async def answer(self, question: Any, value: object) -> None:
        await self.ours.say(reply=question["question"], value=value)

    async def ended(self) -> Any:
        return await self.says(lambda message: "ended" in message)

    async def starts(self, words: str = "") -> None:
        """Start the next leg."""
        await self.answer(await self.asks(words), "start")

    async def lifted(self) -> None:
        """Confirm that the robot's wheels are off the ground."""
        await self.answer(await self.asks("lifted"), "lifted")

    async def sees(self, wheels: tuple[str, ...] = WHEELS) -> None:
        """Answer for each motor which wheel it turns, and that the wheel turns forward."""
        for wheel in wheels:
            await self.answer(await self.asks("which wheel"), wheel)
            await self.answer(await self.asks("which way did the wheel turn"), "forward")


@asynccontextmanager
async def guiding(page: Page, *, pings: bool = True, token: str = "") -> AsyncIterator[Guided]:
    """Connect as a visible page does, with pings unless `pings` is False."""
    async with hands(page, token) as ours:
        guided = Guided(ours, asyncio.create_task(_ping(ours)) if pings else None)
        try:
            yield guided
        finally:
            guided.falls_silent()


async def _ping(ours: Hands) -> None:
    while True:
        await ours.say(ping=1.0)
        await asyncio.sleep(PING_S)


def commands(page: Page) -> list[int]:
    """Return the pids of the checks and calibrations that the page's server runs."""
    return children(page.pid, "--json-lines")


def none_left(page: Page) -> None:
    """Wait until the page's server runs no check or calibration."""
    until(lambda: not commands(page), 8.0, "no command runs any more")
