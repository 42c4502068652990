"""The page refuses and counts each forbidden request, and the robot does not move."""

from __future__ import annotations

import asyncio
import math
import socket
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import aiohttp
import pytest
from yarl import URL

from acsard.web.access import REQUEST_RATE
from tests.system.browser import NAME, Hands, Page, hands
from tests.system.bystander import lost
from tests.system.harness import PATIENCE_S, Bus, resident_kb

pytestmark = pytest.mark.network

MOVED_M = 0.005
"""Movement below which the robot counts as standing, m or rad."""


class Target:
    """The page that is attacked, and the robot behind it."""

    def __init__(self, page: Page, bus: Bus, tokens: dict[str, str]) -> None:
        self.page, self.bus, self.tokens = page, bus, tokens
        self.port = int(page.here.rpartition(":")[2])

    @contextmanager
    def refuses(self, reason: str, times: int = 1) -> Iterator[None]:
        """Run the attack in the body of the `with`.

        The page counts `reason` at least `times` times, the robot is ready and has not moved, and
        the page goes on.
        """
        before, counted = self.bus.comes_to("ready"), self.page.refused().get(reason, 0)
        yield
        after, more = self.bus.comes_to("ready"), self.page.refused().get(reason, 0) - counted
        assert more >= times, (reason, more)
        assert math.hypot(after["x"] - before["x"], after["y"] - before["y"]) < MOVED_M
        assert abs(math.remainder(after["yaw"] - before["yaw"], math.tau)) < MOVED_M
        assert self.page.process.poll() is None
        assert "Traceback" not in self.page.stderr

    def opened(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), 30.0)


@pytest.fixture(scope="module")
def tokens(page: Page) -> dict[str, str]:
    """Return tokens of five kinds: empty, wrong, expired, revoked, and a viewer's."""
    revoked = page.invite("maintainer", "revoked")
    page.tokens("revoke", "revoked")
    return {
        "": "",
        "wrong": "x" * 43,
        "expired": page.vault.invite("maintainer", "expired", 0)[0],
        "revoked": revoked,
        "viewer": page.invite("viewer", "tv"),
    }


@pytest.fixture
def target(page: Page, standing: Bus, tokens: dict[str, str]) -> Target:
    return Target(page, standing, tokens)


EVIL = {"Origin": "https://evil.example"}
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip
FORM = {"Content-Type": "application/x-www-form-urlencoded"}
CLEAR, SET = "POST /api/srv/clear", "POST /api/srv/set"

ASKS: list[tuple[str, str, dict[str, Any], int, str]] = [
    # without a token, or with an invalid one
    ("away", "GET /api/state", {}, 401, "no_token"),
    ("away", "GET /api/camera", {}, 401, "no_token"),
    ("away", "GET /ws", {"headers": UPGRADE}, 401, "no_token"),
    ("away", "GET /api/state", {"token": "wrong"}, 401, "bad_token"),
    ("away", "GET /api/state", {"token": "expired"}, 401, "bad_token"),
    ("away", "GET /ws", {"token": "expired", "headers": UPGRADE}, 401, "bad_token"),
    ("away", CLEAR, {"token": "revoked"}, 401, "bad_token"),
    # a viewer
    ("away", CLEAR, {"token": "viewer"}, 403, "role"),
    ("away", "GET /api/config", {"token": "viewer"}, 403, "role"),
    ("away", "GET /api/recordings/1-x.rec.zst", {"token": "viewer"}, 403, "role"),
    # another page, a name pointed at this machine, a proxy that says so
    ("here", "GET /ws", {"headers": UPGRADE | EVIL}, 403, "origin"),
    ("away", "GET /ws", {"token": "viewer", "headers": UPGRADE | EVIL}, 403, "origin"),
    ("here", "POST /api/srv/stop", {"headers": EVIL}, 403, "origin"),
    ("here", "GET /api/state", {"headers": {"Sec-Fetch-Site": "cross-site"}}, 403, "origin"),
    ("here", "GET /", {"headers": {"Host": "evil.example:8080"}}, 403, "host"),
    ("away", "GET /", {"headers": {"Host": "evil.example"}}, 403, "host"),
    ("away", "GET /api/state", {"headers": {"Host": NAME}}, 401, "no_token"),
    ("here", "GET /api/state", {"headers": {"X-Forwarded-For": "203.0.113.5"}}, 403, "proxy"),
    ("here", "GET /", {"headers": {"Forwarded": "for=203.0.113.5"}}, 403, "proxy"),
    ("here", "GET /ws", {"headers": UPGRADE | {"Via": "1.1 proxy"}}, 403, "proxy"),
    # paths
    ("here", "GET /page/../app.py", {}, 404, "path"),
    ("here", "GET /page/%2e%2e%2fapp.py", {}, 404, "path"),
    ("here", "GET /api/recordings/..%2f..%2fetc%2fpasswd", {}, 404, "path"),
    ("here", "GET /api/**", {}, 404, "path"),
    ("here", "POST /api/srv/**", {}, 404, "path"),
    # bodies
    ("away", "POST /token", {"data": b"token=x", "headers": FORM}, 400, "malformed"),
    ("away", "POST /token", {"data": b"{\xff"}, 400, "malformed"),
    ("here", SET, {"data": b"\xff{"}, 400, "malformed"),
    ("here", SET, {"data": bytes(10_000_000)}, 413, "too_big"),
]  # fmt: skip
"""A forbidden request: endpoint, method and path, arguments, and the expected status and reason."""


async def test_each_request_for_a_forbidden_resource_is_refused(target: Target) -> None:
    for where, what, how, status, reason in ASKS:
        method, path = what.split()
        headers, data = how.get("headers", {}), how.get("data")
        with target.refuses(reason):
            async with target.page.client(target.tokens[how.get("token", "")]) as session:
                url = URL(f"{getattr(target.page, where)}{path}", encoded=True)
                async with session.request(method, url, headers=headers, data=data) as answer:
                    assert answer.status == status, (what, how)


STOP = "POST /api/srv/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n"

RAW = [
    "GET /api/state HTTP/1.1\r\n\r\n",  # no Host
    "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n",
    f"{STOP}Content-Length: 2\r\nContent-Length: 50\r\n\r\n{{}}",
    f"{STOP}Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n{STOP}\r\n",
    f"{STOP}Transfer-Encoding : chunked\r\n\r\n0\r\n\r\n",
    f"{STOP}X-A: b\r\n Content-Length: 4\r\n\r\n",
    f"{STOP}X: {'x' * 100_000}\r\n\r\n",
    "\x16\x03\x01\x02\r\n\r\n",
    f"{CLEAR} HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    "Content-Encoding: gzip\r\nContent-Length: 4\r\n\r\nabcd",
]
"""Bytes on a connection that are not a request, or that another server would read as two."""


def test_a_malformed_request_is_refused_as_a_whole(target: Target) -> None:
    # The robot is ready at the end: no second request, for a stop, was found in the first.
    for sent in RAW:
        with target.refuses("host" if sent is RAW[0] else "malformed"):
            with target.opened() as opened:
                opened.sendall(sent.encode("latin-1"))
                answer = opened.recv(4096)
            assert answer.split()[1] == b"400", (sent, answer)
            assert b"application/json" in answer
            assert b"nosniff" in answer


def test_a_browser_with_many_cookies_of_other_ports_gets_the_page(page: Page) -> None:
    asked = urllib.request.Request(page.here, headers={"Cookie": "other=" + "x" * 7000})
    with urllib.request.urlopen(asked, timeout=PATIENCE_S) as answer:
        assert answer.status == 200


async def longest(stop: Any, count: int = 12) -> float:
    """Return the longest of some stops, without the time that the machine lost meanwhile, s."""
    took = list[float]()
    for _ in range(count):
        begun = time.monotonic()
        await stop()
        ended = time.monotonic()
        took.append(ended - begun - 4 * lost(begun, ended))
        await asyncio.sleep(0.1)
    print(f"\na stop of another token takes {1000 * max(took):.0f} ms")
    return max(took)


async def test_a_flood_of_a_viewer_ends_its_connections_and_delays_no_stop_of_another(
    target: Target,
) -> None:
    page, url, statuses = target.page, target.page.away, set[int]()
    with target.refuses("too_fast", 8):
        phone = page.client(page.invite("operator", f"phone-{time.time_ns()}"))
        flooding = page.client(target.tokens["viewer"])
        async with phone, flooding, hands(page, target.tokens["viewer"]) as theirs:

            async def asks() -> None:
                while True:
                    with suppress(aiohttp.ClientError):
                        async with flooding.get(f"{url}/api/state") as answer:
                            statuses.add(answer.status)

            async def stop(session: aiohttp.ClientSession = phone) -> None:
                async with session.post(f"{url}/api/srv/stop") as answer:
                    assert answer.status == 200

            await stop()  # the server knows the token
            ending = asyncio.create_task(drained(theirs))
            floods = [asyncio.create_task(asks()) for _ in range(7)]
            assert await longest(stop) < 0.5
            for flood in floods:
                flood.cancel()
            # The one that floods may stop the robot too, and learns why its pages are closed.
            await stop(flooding)
            await asyncio.wait_for(ending, PATIENCE_S)
            assert theirs.socket.close_code == 1008
        assert target.bus.get("srv/clear")["success"]
    assert {200, 429} <= statuses


async def drained(ours: Hands) -> list[str]:
    """Return the texts that come until the connection ends."""
    async with asyncio.timeout(PATIENCE_S):
        return [
            message.data async for message in ours.socket if message.type == aiohttp.WSMsgType.TEXT
        ]


async def test_a_socket_that_floods_with_any_message_ends_and_no_other_does(
    target: Target,
) -> None:
    most = int(REQUEST_RATE.burst)
    async with hands(target.page) as ours:
        with target.refuses("too_big"):
            async with hands(target.page) as theirs:
                before = resident_kb(target.page.pid)
                with suppress(ConnectionError):  # closed while it is still being sent
                    await theirs.socket.send_str("x" * 10_000_000)
                await drained(theirs)
                assert resident_kb(target.page.pid) < before + 5_000
        with target.refuses("malformed", most):
            async with hands(target.page) as theirs:
                for _ in range(4 * most):
                    await theirs.socket.send_str("{}")
                texts = await drained(theirs)
                assert theirs.socket.close_code == 1008
                # The answers are limited by the rate, too.
                assert 0 < sum("refused" in text for text in texts) < most // 2
        with target.refuses("too_fast"):
            async with hands(target.page, target.tokens["viewer"]) as theirs:
                with suppress(ConnectionError):
                    for _ in range(30_000):
                        await theirs.socket.ping()
                await drained(theirs)
                assert theirs.socket.closed
        await ours.say(ping=1)
        await ours.find(lambda frame: "pong" in frame)
