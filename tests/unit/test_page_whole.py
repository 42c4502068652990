"""The whole server of the page in this process, without a robot, for what no real client causes."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from functools import partial
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import aiohttp
import pytest
from aiohttp import web
from msgspec.structs import replace
from yarl import URL

from acsard.bus.address import Address
from acsard.bus.zenoh_sessions import MAX_MESSAGE_BYTES
from acsard.core.config.settings import WebConfig
from acsard.core.messages.encodings import DecodeError
from acsard.host import clock
from acsard.host.errors import NoAnswerError, UsageError
from acsard.web import socket_sender
from acsard.web.answers import unsent_bytes
from acsard.web.app import Page
from acsard.web.camera import Picture
from acsard.web.connections import MAX_WAITING_BYTES, Connections, HasContext
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.socket_sender import MAX_UNREAD_BYTES
from acsard.web.tokens import ReadTokens, Vault
from acsard.web.viewer import Parts
from tests.system.browser import Hands
from tests.system.camera_stream import Stream
from tests.system.harness import PATIENCE_S
from tests.unit.screens import STATE, sample_of

ABOUT = About("1", True, 1.0, 4.0, 10.0, "", {"teleop": 0.25, "app": 0.25})

DEFAULT_CONFIG = WebConfig()

DASHBOARD = "http://127.0.0.1:5173"


class Whole:
    """The server of the page, whose robot does not answer."""

    def __init__(self, where: Path, rules: WebConfig = DEFAULT_CONFIG) -> None:
        self.counts = Counts()
        self.robot = FollowedRobot(
            Address("tcp/127.0.0.1:1", "acsar", ""), Mock(), ABOUT, self.counts
        )
        self.parts, self.connections = Parts(self.robot, self.counts), Connections(self.counts)
        self.vault = Vault(where, "acsar")
        self.tokens = ReadTokens(self.vault)
        names = frozenset({"robot.local"})
        self.page = Page(self.parts, self.tokens, names, self.connections, rules)

    @asynccontextmanager
    async def served(
        self, certificate: HasContext | None = None
    ) -> AsyncIterator[tuple[URL, aiohttp.ClientSession]]:
        """Serve the page on loopback, and yield its URL and a client.

        With a certificate, the client uses HTTPS and the robot's name, like another machine.
        """
        scheme, headers = ("https", {"Host": "robot.local"}) if certificate else ("http", {})
        runner = web.AppRunner(self.page.app, handle_signals=False, shutdown_timeout=0.1)
        await runner.setup()
        assert runner.server is not None
        with socket.create_server(("127.0.0.1", 0)) as listening:
            listening.setblocking(False)
            accepting = asyncio.create_task(
                self.connections.accept(runner.server, listening, certificate)
            )
            connector = aiohttp.TCPConnector(ssl=False)
            async with aiohttp.ClientSession(connector=connector, headers=headers) as session:
                yield URL(f"{scheme}://127.0.0.1:{listening.getsockname()[1]}"), session
            accepting.cancel()
        await runner.cleanup()

    @asynccontextmanager
    async def hands(self) -> AsyncIterator[Hands]:
        """Serve the page and open its WebSocket as a client."""
        async with self.served() as (url, session), session.ws_connect(url / "ws") as opened:
            yield Hands(opened)


@pytest.fixture
def whole(tmp_path: Path) -> Whole:
    return Whole(tmp_path)


async def eventually(look: Callable[[], Any]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not look():
            await asyncio.sleep(0.01)


async def test_a_client_that_must_disconnect_drives_no_more_even_if_it_does_not_read(
    whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a busy machine, the second until the connection is cut could end before the last command.
    monkeypatch.setattr(socket_sender, "cut", lambda transport: None)
    async with whole.hands() as ours:
        await ours.find(lambda frame: "hello" in frame)
        await ours.drive(0.0)
        await eventually(lambda: whole.counts.all().get("commands_dropped"))
        (viewer,) = whole.page._viewers
        wire = cast(Any, ours.socket)._response.connection.transport
        wire.pause_reading()
        viewer._out.enqueue({"more than a kernel holds": "x" * 20_000_000})
        whole.page.end_all("your token has expired")
        before = whole.counts.all()
        for _ in range(20):
            await ours.drive(0.5)
            await asyncio.sleep(0.01)
        await ours.say(ping=1)
        await asyncio.sleep(0.2)
        whole.parts.outbox.flush(PATIENCE_S)
        assert whole.counts.all() == before
        wire.abort()


async def test_a_client_that_stops_reading_later_gets_only_the_newest_message(
    whole: Whole,
) -> None:
    def publish(x: int) -> None:
        whole.robot.streams._streams["state"].take(sample_of(replace(STATE, x=float(x))))

    async with whole.hands() as ours:
        await ours.say(subscribe="state", rate=50)
        await eventually(lambda: whole.robot.streams._streams)
        publish(0)
        await ours.state(lambda state: state["x"] == 0.0)
        wire = cast(Any, ours.socket)._response.connection.transport
        wire.pause_reading()
        (viewer,) = whole.page._viewers
        number = 0
        # A late computer leaves out more frames than were published meanwhile.
        while number < 12 or whole.counts.all().get("frames_left_out", 0) < 10:
            # More than the kernels hold, which enlarge their buffers meanwhile:
            while unsent_bytes(viewer._out._transport) <= MAX_UNREAD_BYTES:
                if not viewer._out._out:  # more would let the server wait for the client
                    viewer._out.enqueue("x" * 16384)
                await asyncio.sleep(0)
            publish(number := number + 1)
            await asyncio.sleep(0.02)
        wire.resume_reading()
        await ours.find(lambda frame: "value" in frame and frame["value"]["x"] == number)
        assert sum("value" in frame for frame in ours.heard) < number - 5


async def test_a_client_on_the_robot_has_the_role_of_the_configuration(tmp_path: Path) -> None:
    whole = Whole(tmp_path, WebConfig(local="operator"))
    async with whole.hands() as ours:
        hello = (await ours.find(lambda frame: "hello" in frame))["hello"]
        assert (hello["robot"], hello["version"], hello["role"]) == ("acsar", "1", "operator")
        assert (hello["limits"], hello["simulated"]) == ({"linear": 1.0, "angular": 4.0}, True)
        assert (hello["state_rate"], hello["camera"]) == (10.0, False)
        assert "set" in hello["barred"]
        assert not (await ours.call("set", settings={}))["ok"]
    assert whole.counts.refused() == {"role": 1}


async def test_only_a_page_of_a_listed_origin_may_send_requests_and_read_answers(
    tmp_path: Path,
) -> None:
    """The test also tries another page of this machine, and the robot's own page."""
    whole = Whole(tmp_path, WebConfig(origins=(DASHBOARD,)))
    async with whole.served() as (url, session):
        stop, own = url / "api/srv/stop", str(url.origin())
        for origin, status, readable in [
            (DASHBOARD, 409, DASHBOARD),  # there is no robot to stop
            ("http://127.0.0.1:5174", 403, None),
            ("null", 403, None),
            (own, 409, None),
        ]:
            site = "same-origin" if origin == own else "same-site"
            headers = {"Origin": origin, "Sec-Fetch-Site": site}
            async with session.post(stop, headers=headers) as answer:
                assert answer.status == status, origin
                assert answer.headers.get("Access-Control-Allow-Origin") == readable
                assert "Access-Control-Allow-Credentials" not in answer.headers
                assert answer.headers["Vary"] == "Origin"
        # A browser asks before it sends a token.
        asked = {"Access-Control-Request-Method": "POST"}
        async with session.options(stop, headers=asked | {"Origin": DASHBOARD}) as answer:
            assert answer.status == 204
            assert answer.headers["Access-Control-Allow-Origin"] == DASHBOARD
            assert "Authorization" in answer.headers["Access-Control-Allow-Headers"]
        for more in ({"Origin": "http://evil.example"}, {"Origin": DASHBOARD, "Host": "evil"}, {}):
            async with session.options(stop, headers=asked | more) as answer:
                assert answer.status in (403, 405)
        async with session.ws_connect(url / "ws", headers={"Origin": DASHBOARD}) as opened:
            assert "hello" in (await opened.receive()).data
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(url / "ws", headers={"Origin": "http://127.0.0.1:5174"})
        at, from_there = url / "token", {"Origin": DASHBOARD}
        async with session.post(at, json={"token": "x"}, headers=from_there) as answer:
            assert answer.status == 403
            assert "another site" in (await answer.json())["error"]


async def test_each_picture_of_the_camera_is_sent_once(tmp_path: Path) -> None:
    with closing(Stream()) as stream:
        whole = Whole(tmp_path, WebConfig(camera=f"http://127.0.0.1:{stream.port}/stream"))
        async with whole.served() as (url, session):

            async def picture(tag: str = "") -> aiohttp.ClientResponse:
                headers = {"If-None-Match": tag} if tag else {}
                async with session.get(url / "api/camera", headers=headers) as answer:
                    await answer.read()
                    return answer

            first = await picture()
            assert (first.status, first.content_type) == (200, "image/jpeg")
            assert int(first.headers["Age-Ms"]) < 1000 * PATIENCE_S
            second = await picture(first.headers["ETag"])
            assert second.headers["ETag"] != first.headers["ETag"]
            stream.silent = True
            await asyncio.sleep(0.3)
            last = await picture()
            assert (await picture(last.headers["ETag"])).status == 304
        whole.page.end_all("")


@pytest.mark.parametrize(
    ("camera", "status", "error", "detail"),
    [
        ("", 404, "no camera is configured", "set web.camera to the address of its stream"),
        ("http://127.0.0.1:1/x", 503, "the camera's stream cannot be read", "127.0.0.1:1"),
    ],
)
async def test_a_camera_that_cannot_be_shown_is_explained(
    tmp_path: Path, camera: str, status: int, error: str, detail: str
) -> None:
    whole = Whole(tmp_path, WebConfig(camera=camera))
    async with whole.served() as (url, session), session.get(url / "api/camera") as answer:
        problem = await answer.json()
        assert (answer.status, problem["error"]) == (status, error)
        assert detail in problem["detail"]
    whole.page.end_all("")


async def test_a_camera_at_another_address_is_explained(tmp_path: Path) -> None:
    with closing(Stream()) as stream:
        whole = Whole(tmp_path, WebConfig(camera=f"http://127.0.0.1:{stream.port}/other"))
        async with whole.served() as (url, session), session.get(url / "api/camera") as answer:
            problem = await answer.json()
        assert problem["detail"] == "the camera answered 404: correct web.camera"
        whole.page.end_all("")


async def test_no_other_page_can_frame_the_page_or_add_scripts_to_it(whole: Whole) -> None:
    async with whole.served() as (url, session):
        for path in ("", "page/main.js", "api/whoami", "nothing"):
            async with session.get(url / path) as answer:
                policy = answer.headers["Content-Security-Policy"].split("; ")
                assert {"default-src 'self'", "frame-ancestors 'none'"} <= set(policy)
                assert answer.headers["X-Frame-Options"] == "DENY"
                assert answer.headers["X-Content-Type-Options"] == "nosniff"


async def test_a_path_called_with_another_method_names_the_method_it_accepts(whole: Whole) -> None:
    async with whole.served() as (url, session):
        async with session.get(url / "api/srv/stop") as answer:
            assert (answer.status, answer.headers["Allow"]) == (405, "POST")
            assert (await answer.json())["error"] == "this path accepts only POST"
        async with session.post(url / "api/nothing") as answer:
            assert answer.status == 404
        async with session.post(url / "api/srv/set", data=bytes(MAX_MESSAGE_BYTES + 1)) as answer:
            assert answer.status == 413
        assert whole.counts.refused() == {"path": 2, "too_big": 1}


@pytest.mark.parametrize(
    ("sent", "reason", "words"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "host", b"which must name the robot"),
        (b"\x16\x03\x01\x02\r\n\r\n", "malformed", b"bytes that are not an HTTP request"),
    ],
)
async def test_bytes_that_are_not_a_request_are_answered_counted_and_end_the_connection(
    whole: Whole, sent: bytes, reason: str, words: bytes
) -> None:
    async with whole.served() as (url, _), asyncio.timeout(PATIENCE_S):
        reader, writer = await asyncio.open_connection(url.host, url.port)
        writer.write(sent)
        answer = await reader.read()
        assert answer.split()[1] == b"400"
        assert words in answer
        assert b"X-Content-Type-Options: nosniff" in answer
        assert whole.counts.refused() == {reason: 1}
        writer.close()


async def test_an_ordinary_request_for_the_websocket_is_told_what_the_address_is(
    whole: Whole,
) -> None:
    async with whole.served() as (url, session), session.get(url / "ws") as answer:
        assert answer.status == 400
        assert "connect to it with ws://" in (await answer.json())["error"]


async def test_a_body_that_never_arrives_is_answered_and_named(
    whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.web.app.BODY_TIMEOUT_S", 0.1)
    async with whole.served() as (url, _):
        reader, writer = await asyncio.open_connection(url.host, url.port)
        head = "POST /api/srv/clear HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"
        writer.write(head.encode())
        async with asyncio.timeout(PATIENCE_S):
            assert (await reader.readline()).split()[1] == b"408"
            assert b'"no body arrived within 0.1 s"' in await reader.readuntil(b"}")
        writer.close()


async def test_a_message_beyond_the_limit_ends_its_websocket_and_is_counted_as_too_big(
    whole: Whole,
) -> None:
    async with whole.hands() as ours:
        await ours.say(call="x" * MAX_MESSAGE_BYTES)
        await eventually(whole.counts.refused)
        assert whole.counts.refused() == {"too_big": 1}
        async with asyncio.timeout(PATIENCE_S):
            while not ours.socket.closed:
                await ours.socket.receive()


async def test_a_websocket_may_send_more_than_waits_behind_a_request(whole: Whole) -> None:
    async with whole.hands() as ours:
        for _ in range(1 + 2 * MAX_WAITING_BYTES // 50_000):
            await ours.say(subscribe="x" * 50_000)
        await ours.say(ping=7)
        await ours.find(lambda frame: frame.get("pong") == 7)


async def test_a_bug_of_the_server_is_not_counted_against_the_client(whole: Whole) -> None:
    whole.robot.about = cast(Any, None)
    async with whole.served() as (url, session), session.get(url / "metrics") as answer:
        assert answer.status == 500
        assert whole.counts.refused() == {}


async def test_a_token_that_is_not_json_is_refused_with_the_reason(whole: Whole) -> None:
    async with whole.served() as (url, session):
        own = {"Origin": str(url.origin())}
        async with session.post(url / "token", data=b"{", headers=own) as answer:
            assert (answer.status, (await answer.json())["error"]) == (
                400,
                "send the token as JSON",
            )
        assert whole.counts.refused() == {"malformed": 1}


async def test_a_message_that_is_not_obeyed_is_answered_with_the_reason(tmp_path: Path) -> None:
    whole = Whole(tmp_path, WebConfig(local="operator"))
    wish = {"linear_x": 0.1, "angular_z": 0.0}
    async with whole.hands() as ours:

        async def answer(key: str) -> Any:
            return await ours.find(lambda frame: key in frame)

        messages: list[tuple[dict[str, Any], str, str]] = [
            ({"subscribe": "odometry"}, "subscribe", "is not a key to follow; choose one of"),
            ({"cmd": wish, "source": "nav"}, "cmd", "is not one of the robot's sources: teleop, "),
            ({"ping": 1, "call": "stop"}, "message", "exactly one of the fields"),
        ]
        for message, kind, words in messages:
            await ours.say(**message)
            refused = await answer("refused")
            assert refused["refused"] == kind
            assert words in refused["reason"]
        await ours.find(lambda frame: "answer" in frame)  # the stop
        await ours.socket.send_bytes(b"{}")
        await eventually(lambda: whole.counts.refused() == {"malformed": 4})
        for key in ("odom", "state", "tf", "wheel_states", "battery", "cmd_vel_out"):
            await ours.say(subscribe=key, rate=50.0)
        await ours.say(subscribe="events", rate=1.0)
        assert "300 messages a second: lower some" in (await answer("refused"))["reason"]
        await ours.say(subscribe="state", rate=10.0)  # another rate of a known key
        await ours.say(unsubscribe="odom")
        await ours.say(subscribe="events", rate=1.0)
        await ours.say(ping=7)
        assert (await answer("pong"))["pong"] == 7
        (viewer,) = whole.page._viewers
        rates = {key: 1.0 / one.period for key, one in viewer._out.following.items()}
        assert (rates["state"], rates["events"], "odom" in rates) == (10.0, 1.0, False)
        assert not (await ours.call("set"))["ok"]
        assert "is not the name of a service" in (await ours.call("no such"))["text"]
    assert whole.counts.refused() == {"malformed": 5, "role": 1, "too_many": 1}


class Driven:
    """The connection to a daemon, which takes commands."""

    session: Any = None

    def __init__(self) -> None:
        self.speeds: list[float] = []

    def put(self, twist: Any, *_: object) -> None:
        self.speeds.append(twist.linear.x)


@pytest.mark.parametrize("abrupt", [True, False])
async def test_a_viewer_that_drives_and_goes_away_leaves_a_zero(whole: Whole, abrupt: bool) -> None:
    driven = whole.robot.client = cast(Any, Driven())
    async with whole.hands() as ours:
        await ours.find(lambda frame: "hello" in frame)
        for speed in (0.0, 0.5):
            await ours.drive(speed)
            await eventually(partial(driven.speeds.__contains__, speed))
        if abrupt:
            cast(Any, ours.socket)._response.connection.transport.abort()
        else:
            await ours.socket.close()
        await eventually(lambda: driven.speeds[-1] == 0.0)
    assert driven.speeds == [0.0, 0.5, 0.0]


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (None, 503, "no daemon answers at tcp/127.0.0.1:1 yet"),
        (NoAnswerError("nobody answers"), 504, "no daemon answers at tcp/127.0.0.1:1 yet"),
        (UsageError("there is no such key"), 503, "there is no such key"),
        (DecodeError("malformed", "it is not JSON"), 503, "it is not JSON"),
        (TimeoutError(), 503, "the robot did not answer in time: try again"),
    ],
)
async def test_a_value_that_the_robot_does_not_give_is_answered_with_the_reason(
    whole: Whole, error: Exception | None, status: int, words: str
) -> None:
    whole.robot.client = cast(Any, error and Mock(reply=Mock(side_effect=error)))
    async with whole.served() as (url, session), session.get(url / "api/state") as answer:
        assert (answer.status, (await answer.json())["error"]) == (status, words)


async def test_the_age_of_a_picture_and_the_wait_for_it_are_in_milliseconds(
    whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = 5_000_000_000

    async def after(number: int) -> Picture:
        nonlocal now_ns
        now_ns += 300_000_000
        return Picture(b"", number + 1, 1_000_000_000)

    monkeypatch.setattr(clock, "steady_ns", lambda: now_ns)
    whole.page._camera.after = after  # type: ignore[method-assign]
    for tag, number in (("", "1"), ("7", "8"), ("seven", "1"), (16 * "7", "1")):
        async with whole.served() as (url, session):
            known = {"If-None-Match": f'"{tag}"'}
            now_ns = 5_000_000_000
            async with session.get(url / "api/camera", headers=known) as answer:
                assert answer.headers["ETag"].strip('"') == number
                times = answer.headers["Age-Ms"], answer.headers["Waited-Ms"]
                assert times == ("4300", "300")


async def test_a_viewer_that_goes_away_ends_its_subscriptions(whole: Whole) -> None:
    async with whole.hands() as ours:
        await ours.say(subscribe="odom", rate=10)
        await eventually(lambda: whole.robot.streams._streams)
    (stream,) = whole.robot.streams._streams.values()
    await eventually(lambda: stream.users == 0)
