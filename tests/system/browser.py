"""Run the robot's page (`acsard web`), and clients that use it as browsers and programs do."""

from __future__ import annotations

import asyncio
import json
import socket
import ssl
import time
import urllib.request
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

from acsard.core.config.parsing import parse
from acsard.core.values import Role
from acsard.web.tokens import Vault
from tests.system.harness import (
    PATIENCE_S,
    Daemon,
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
)

NAME = socket.gethostname()

TRUSTING = ("--ignore-certificate-errors", f"--host-resolver-rules=MAP {NAME} 127.0.0.1")
"""Options of a browser that opens the page over HTTPS, like one on another host."""


class Page(Program):
    """`acsard web` for one daemon, over HTTP on the robot and over HTTPS for other hosts."""

    def __init__(self, daemon: Daemon, where: Path, *words: str, at: str = "", **more: str) -> None:
        """Prepare the server, which starts when the object is entered.

        `at` is the address of this host for other hosts. `more` are variables of its environment.
        """
        plain, secure = (free_endpoint().rpartition(":")[2] for _ in range(2))
        self.here, self.away = f"http://127.0.0.1:{plain}", f"https://{at or NAME}:{secure}"
        self.state, self.tls = where / "state", where / "tls"
        # For root, another variable would lead to the tokens of a service of this machine.
        self.env = environment(STATE_DIRECTORY=str(self.state / "acsard-web"), **more)
        self._config = daemon.config
        self.told = ["--config", str(daemon.config), "--address", self.here]
        if self.tls.is_dir():
            self.told += ["--address", f"https://{at or '127.0.0.1'}:{secure}"]
            self.told += ["--tls", str(self.tls)]
        super().__init__(acsard("web", *self.told, *words), where, self.env)

    def __enter__(self) -> Page:
        super().__enter__()
        self.says("page ")
        return self

    def tokens(self, *words: str) -> str:
        """Run `acsard web` with a command about tokens, and return its output."""
        done = finish(acsard("web", *self.told, *words), self.state.parent, env=self.env)
        assert done.code == 0, done
        return done.out

    @property
    def vault(self) -> Vault:
        """The tokens of this page."""
        return Vault(self.state / "acsard-web", parse(self._config.read_bytes()).robot.id)

    def invite(self, role: Role, name: str) -> str:
        """Invite a client and return its token."""
        return self.vault.invite(role, name, 1)[0]

    def client(self, token: str = "", address: str = "") -> aiohttp.ClientSession:
        """Return an HTTP session like that of another host's program, with or without a token."""
        trusted = ssl.create_default_context(cafile=str(self.tls / "ca.pem"))
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        local = (address, 0) if address else None
        connector = aiohttp.TCPConnector(
            resolver=_LocalResolver(), ssl=trusted, limit=0, local_addr=local
        )
        return aiohttp.ClientSession(connector=connector, headers=headers)

    def refused(self) -> dict[str, float]:
        """Return how many requests the page has refused so far, by reason."""
        with urllib.request.urlopen(f"{self.here}/metrics") as answer:
            metrics = answer.read().decode()
        counts = {}
        for line in metrics.splitlines():
            if line.startswith("acsard_page_refused_total{"):
                counts[line.partition('reason="')[2].partition('"')[0]] = float(line.split()[-1])
        return counts


class _LocalResolver(aiohttp.abc.AbstractResolver):
    """A resolver for which every name is this machine."""

    async def resolve(self, host: str, port: int = 0, family: int = 0) -> list[Any]:
        return [
            {"hostname": host, "host": "127.0.0.1", "port": port, "family": socket.AF_INET,
             "proto": 0, "flags": 0}
        ]  # fmt: skip

    async def close(self) -> None:
        """Do nothing: the resolver holds no resources."""


async def answer(url: str) -> tuple[int, str]:
    """Return the status and the body of the answer to a GET request."""
    async with aiohttp.ClientSession() as session, session.get(url) as response:
        return response.status, await response.text()


async def text(url: str) -> str:
    """Return the body of a successful answer."""
    status, body = await answer(url)
    assert status == 200, body
    return body


class Hands:
    """A WebSocket to the page's server, used as a browser uses it."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.source = "teleop"
        """The source that each command names, as a page does; "" for none."""
        self.heard: list[Any] = []

    async def say(self, **message: object) -> None:
        await self.socket.send_str(json.dumps(message))

    async def drive(self, linear: float, angular: float = 0.0, late_ms: float = 0.0) -> None:
        wish = {"linear_x": linear, "angular_z": angular}
        source = {"source": self.source} if self.source else {}
        await self.say(cmd=wish, stamp=time.time() * 1e3 - late_ms, **source)

    async def hold(self, linear: float, seconds: float, angular: float = 0.0) -> None:
        """Send this speed at 20 Hz for `seconds`, like a finger that holds the stick."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            await self.drive(linear, angular)
            await asyncio.sleep(0.05)

    async def find(self, look: Callable[[Any], Any]) -> Any:
        """Return the first message that `look` accepts."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                message = await self.socket.receive()
                assert message.type == aiohttp.WSMsgType.TEXT, message
                frame = json.loads(message.data)
                self.heard.append(frame)
                if look(frame):
                    return frame

    async def call(self, name: str, **payload: object) -> Any:
        await self.say(call=name, id=name, payload=payload)
        return await self.find(lambda frame: frame.get("answer") == name)

    async def state(self, look: Callable[[Any], Any]) -> Any:
        """Return the first state that `look` accepts."""
        message = await self.find(
            lambda frame: frame.get("key") == "state" and look(frame["value"])
        )
        return message["value"]

    async def until_driving(self, linear: float) -> None:
        """Send zeros for 0.6 s, then this speed until the robot reaches it."""
        holding = asyncio.create_task(self.hold(0.0, 0.6))
        await holding
        holding = asyncio.create_task(self.hold(linear, PATIENCE_S))
        try:
            await self.state(lambda s: abs((s["linear"] or 0.0) - linear) < 0.25 * abs(linear))
        finally:
            holding.cancel()


@asynccontextmanager
async def hands(page: Page, token: str = "", **how: Any) -> AsyncIterator[Hands]:
    """Connect to the page, on the robot itself or, with a token, like another host."""
    session = page.client(token) if token else aiohttp.ClientSession()
    place = page.away if token else page.here
    async with session, session.ws_connect(f"{place}/ws", **how) as opened:
        yield Hands(opened)


def run(story: Callable[[], Awaitable[None]], within: float = 3 * PATIENCE_S) -> None:
    """Run the coroutine `story` with a time limit."""
    asyncio.run(_within(story, within))


async def _within(story: Callable[[], Awaitable[None]], within: float) -> None:
    async with asyncio.timeout(within):
        await story()
