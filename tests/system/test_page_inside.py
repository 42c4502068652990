"""Tests of the page's server in this process, for cases that a real client cannot cause."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import aiohttp
import pytest
from aiohttp import web
from yarl import URL

from acsard.bus.address import Address
from acsard.bus.zenoh_sessions import client_session
from acsard.client.connection import Connection
from acsard.core.config.settings import WebConfig
from acsard.core.messages.signature import MAX_INT64
from acsard.host.errors import UnreachableError
from acsard.web.access import REQUEST_RATE
from acsard.web.answers import unsent_bytes
from acsard.web.app import Page
from acsard.web.connections import Connections
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.server import first_ended
from acsard.web.socket_sender import MAX_UNREAD_BYTES
from acsard.web.tokens import ReadTokens, Vault
from acsard.web.viewer import Parts
from tests.system.browser import Hands
from tests.system.harness import PATIENCE_S, Daemon, seconds

pytestmark = pytest.mark.network

MISSED = 20
"""Messages at 50 a second that one client does not read."""

ABOUT = About("1", True, 1.0, 4.0, 10.0, "", {"teleop": 0.25, "app": 0.25})

DEFAULT_CONFIG = WebConfig()


class Inside:
    """The whole server of the page in this process, without a connection to a robot."""

    def __init__(self, where: Path, rules: WebConfig = DEFAULT_CONFIG) -> None:
        self.counts = Counts()

        def connect() -> Connection:
            raise UnreachableError("nobody is there")

        self.robot = FollowedRobot(
            Address("tcp/127.0.0.1:1", "acsar", ""), connect, ABOUT, self.counts
        )
        self.parts, self.connections = Parts(self.robot, self.counts), Connections(self.counts)
        tokens = ReadTokens(Vault(where, "acsar"))
        self.page = Page(self.parts, tokens, frozenset(), self.connections, rules)

    @asynccontextmanager
    async def served(self) -> AsyncIterator[URL]:
        """Serve the page on loopback, and yield its URL."""
        runner = web.AppRunner(self.page.app, handle_signals=False, shutdown_timeout=0.1)
        await runner.setup()
        assert runner.server is not None
        with socket.create_server(("127.0.0.1", 0)) as listening:
            listening.setblocking(False)
            accepting = asyncio.create_task(self.connections.accept(runner.server, listening, None))
            updating = asyncio.create_task(self._update())
            yield URL(f"http://127.0.0.1:{listening.getsockname()[1]}")
            accepting.cancel()
            updating.cancel()
        await runner.cleanup()

    async def _update(self) -> None:
        """Do the part of the robot's thread."""
        while True:
            if self.robot.client is not None:
                self.robot.streams.update(self.robot.client)
            await asyncio.sleep(0.01)

    @asynccontextmanager
    async def hands(self) -> AsyncIterator[Hands]:
        """Serve the page and open its WebSocket as a client."""
        async with (
            self.served() as url,
            aiohttp.ClientSession() as session,
            session.ws_connect(url / "ws") as opened,
        ):
            yield Hands(opened)


@pytest.fixture
def inside(tmp_path: Path) -> Inside:
    return Inside(tmp_path)


async def eventually(look: Callable[[], Any]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not look():
            await asyncio.sleep(0.01)


async def test_a_client_that_must_disconnect_drives_no_more_even_if_it_does_not_read(
    inside: Inside,
) -> None:
    async with inside.hands() as ours:
        await ours.find(lambda frame: "hello" in frame)
        await ours.drive(0.0)
        await eventually(lambda: inside.counts.all().get("commands_dropped"))
        (viewer,) = inside.page._viewers
        wire = cast(Any, ours.socket)._response.connection.transport
        wire.pause_reading()
        viewer._out.enqueue({"more than a kernel holds": "x" * 20_000_000})
        inside.page.end_all("your token has expired")
        before = inside.counts.all()
        for _ in range(20):
            await ours.drive(0.5)
            await asyncio.sleep(0.01)
        await ours.say(ping=1)
        await asyncio.sleep(0.2)
        inside.parts.outbox.flush(PATIENCE_S)
        assert inside.counts.all() == before
        wire.abort()


async def test_a_client_that_stops_reading_later_gets_only_the_newest_message(
    inside: Inside, tmp_path: Path
) -> None:
    def left_out() -> int:
        return inside.counts.all().get("frames_left_out", 0)

    with Daemon(tmp_path) as daemon, client_session(daemon.endpoint, "") as session:
        inside.robot.client = Connection(session, "acsar", "teleop")
        async with inside.hands() as ours:
            await ours.say(subscribe="odom", rate=50)
            await ours.find(lambda frame: "key" in frame)
            assert left_out() == 0
            wire = cast(Any, ours.socket)._response.connection.transport
            wire.pause_reading()
            (viewer,) = inside.page._viewers
            # More than the kernels hold:
            while unsent_bytes(viewer._out._transport) <= MAX_UNREAD_BYTES:
                if not viewer._out._out:  # more would let the server wait for the client
                    viewer._out.enqueue("x" * 16384)
                await asyncio.sleep(0)
            await eventually(lambda: left_out() >= MISSED)
            wire.resume_reading()
            stamps = [0.0]

            def leaps(frame: Any) -> bool:
                """Return whether a message skips over most of those that were not read."""
                if "key" not in frame:
                    return False
                stamps.append(seconds(frame["value"]["header"]["stamp"]))
                return 0 < stamps[-2] < stamps[-1] - 0.5 * MISSED / 50

            news = await ours.find(leaps)
            assert news["age"] < 1000 * (stamps[-1] - stamps[-2]) / 2  # it is the newest one


async def test_a_stamp_too_large_to_sign_is_refused_and_the_next_command_is_accepted(
    inside: Inside,
) -> None:
    async with inside.hands() as ours:
        wish = {"linear_x": 0.2, "angular_z": 0.0}
        await ours.say(cmd=wish, stamp=MAX_INT64 / 1e6)
        refused = await ours.find(lambda frame: frame.get("refused") == "cmd")
        assert "stamp" in refused["reason"]
        await ours.drive(0.0)
        await eventually(lambda: inside.counts.all().get("commands_dropped"))


async def test_a_flood_of_stops_ends_its_connection(inside: Inside) -> None:
    async with inside.hands() as ours:
        for n in range(3 * int(REQUEST_RATE.burst)):
            await ours.say(call="stop", id=n)
        async with asyncio.timeout(PATIENCE_S):
            while (await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
        assert ours.socket.close_code == 1008


async def test_a_client_that_unsubscribes_and_disconnects_leaves_no_subscription(
    inside: Inside, tmp_path: Path
) -> None:
    with Daemon(tmp_path) as daemon, client_session(daemon.endpoint, "") as session:
        inside.robot.client = Connection(session, "acsar", "teleop")
        async with inside.hands() as ours:
            await ours.say(subscribe="odom", rate=50)
            await ours.find(lambda frame: "key" in frame)
            assert "odom" in inside.robot.streams._streams
            # The server reads both messages at once.
            await ours.say(unsubscribe="odom")
            await ours.socket.close()
            await eventually(lambda: not inside.page._viewers)
            await eventually(lambda: "odom" not in inside.robot.streams._streams)


async def test_a_key_comes_when_a_bus_that_was_gone_is_back(inside: Inside, tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon:
        closed = client_session(daemon.endpoint, "")
        closed.close()
        inside.robot.client = Connection(closed, "acsar", "teleop")
        async with inside.hands() as ours:
            await ours.say(subscribe="state", rate=10)
            await asyncio.sleep(0.2)
            with client_session(daemon.endpoint, "") as session:
                inside.robot.client = Connection(session, "acsar", "teleop")
                await ours.state(lambda state: state["mode"])


async def test_a_failed_command_outbox_ends_the_server(inside: Inside) -> None:
    outbox = inside.parts.outbox
    outbox.dead.set_exception(MemoryError("no room"))
    with pytest.raises(MemoryError):
        await first_ended([asyncio.sleep(60)], outbox)


async def test_a_client_on_the_robot_has_the_role_of_the_configuration(tmp_path: Path) -> None:
    inside = Inside(tmp_path, WebConfig(local="operator"))
    async with inside.hands() as ours:
        hello = (await ours.find(lambda frame: "hello" in frame))["hello"]
        assert hello["role"] == "operator"
        assert "set" in hello["barred"]
        assert not (await ours.call("set", settings={}))["ok"]
    assert inside.counts.refused() == {"role": 1}


DASHBOARD = "http://127.0.0.1:5173"


@pytest.fixture
def shared(tmp_path: Path) -> Inside:
    return Inside(tmp_path, WebConfig(origins=(DASHBOARD,)))


async def test_only_a_page_of_a_listed_origin_may_send_requests_and_read_answers(
    shared: Inside,
) -> None:
    """The test also tries another page of this machine, and the robot's own page."""
    async with shared.served() as url, aiohttp.ClientSession() as session:
        place, own = url / "api/srv/stop", str(url.origin())
        for origin, status, readable in [
            (DASHBOARD, 409, DASHBOARD),  # there is no robot to stop
            ("http://127.0.0.1:5174", 403, None),
            ("http://localhost:5173", 403, None),
            ("https://127.0.0.1:5173", 403, None),
            ("null", 403, None),
            (own, 409, None),
        ]:
            headers = {"Origin": origin, "Sec-Fetch-Site": "same-site"}
            if origin == own:
                headers["Sec-Fetch-Site"] = "same-origin"
            async with session.post(place, headers=headers) as answer:
                assert answer.status == status, origin
                assert answer.headers.get("Access-Control-Allow-Origin") == readable
                assert "Access-Control-Allow-Credentials" not in answer.headers
                assert answer.headers["Vary"] == "Origin"


async def test_a_browser_learns_what_a_page_of_a_listed_origin_may_send(shared: Inside) -> None:
    async with shared.served() as url, aiohttp.ClientSession() as session:
        place = url / "api/srv/clear"
        asked = {"Access-Control-Request-Method": "POST"}
        async with session.options(place, headers=asked | {"Origin": DASHBOARD}) as answer:
            assert answer.status == 204
            assert answer.headers["Access-Control-Allow-Origin"] == DASHBOARD
            assert "Authorization" in answer.headers["Access-Control-Allow-Headers"]
        for strange in ({"Origin": "http://evil.example"}, {}):
            async with session.options(place, headers=asked | strange) as answer:
                assert answer.status in (403, 405)
                assert "Access-Control-Allow-Origin" not in answer.headers
        evil = asked | {"Origin": DASHBOARD, "Host": "evil.example"}
        async with session.options(place, headers=evil) as answer:
            assert answer.status == 403


async def test_a_page_of_a_listed_origin_opens_the_socket_and_exchanges_no_link(
    shared: Inside,
) -> None:
    async with shared.served() as url, aiohttp.ClientSession() as session:
        place, site_headers = url / "ws", {"Origin": DASHBOARD}
        async with session.ws_connect(place, headers=site_headers) as opened:
            assert "hello" in (await opened.receive()).data
        with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
            await session.ws_connect(place, headers={"Origin": "http://127.0.0.1:5174"})
        assert caught.value.status == 403
        async with session.post(url / "token", json={"token": "x"}, headers=site_headers) as answer:
            assert answer.status == 403
            assert "another site" in (await answer.json())["error"]
