"""Who comes to the robot's page and may not: each is refused and counted, and nothing moves."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, suppress
from typing import Any

import aiohttp
import pytest
from yarl import URL

from acsard.lan.authority import Authority
from acsard.web.limits import CONNECTIONS_OF_TOKEN
from acsard.web.requests import BODY_S
from tests.system.browser import NAME, Page, hands, run
from tests.system.harness import PATIENCE_S, Bus, Daemon, resident_kb, until

pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    where = tmp_path_factory.mktemp("daemon")
    with Daemon(where, config={"record": {"directory": str(where / "record")}}) as daemon:
        yield daemon


@pytest.fixture(scope="module")
def page(daemon: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    where = tmp_path_factory.mktemp("page")
    Authority.make(where / "tls", "test", 1).issue(where / "tls", "robot", [NAME], 1)
    with Page(daemon, where) as page:
        yield page


@pytest.fixture(scope="module")
def viewer(page: Page) -> str:
    return page.invite("viewer", "tv")


@pytest.fixture(scope="module")
def operator(page: Page) -> str:
    return page.invite("operator", "phone")


@pytest.fixture
def bus(daemon: Daemon) -> Iterator[Bus]:
    """The robot stands and may be driven."""
    with Bus(daemon.endpoint) as bus:
        bus.ask("srv/clear")
        bus.at_rest()
        yield bus


def test_a_phone_drives_and_is_named_and_a_stop_of_a_viewer_s_latches(
    page: Page, bus: Bus, operator: str, viewer: str
) -> None:
    async def story() -> None:
        async with hands(page, operator) as ours, hands(page, viewer) as theirs:
            await ours.say(subscribe="state", rate=50)
            sender = (await ours.find(lambda said: "hello" in said))["hello"]["sender"]
            assert sender.startswith("phone/")
            await ours.until_driving(0.3)
            state = bus.state()
            assert (state["source"], state["sender"]) == ("teleop", sender)
            holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
            answer = await theirs.call("stop")
            assert answer["ok"], answer
            await ours.state(lambda s: s["mode"] == "stopped" and s["linear"] == 0)
            holding.cancel()
            refused = await theirs.call("clear")
            assert not refused["ok"]
            assert "operator" in refused["text"]
            assert (await ours.call("clear"))["ok"]

    run(story)


def test_who_only_looks_drives_nothing_whatever_he_sends(page: Page, bus: Bus, viewer: str) -> None:
    before = bus.state()

    async def story() -> None:
        async with hands(page, viewer) as theirs:
            for _ in range(20):
                await theirs.drive(0.5)
                await asyncio.sleep(0.02)
            refused = await theirs.find(lambda said: said.get("refused") == "cmd")
            assert "viewer" in refused["reason"]
            assert not (await theirs.call("set", settings={"limits.linear_speed": 9.0}))["ok"]

    run(story)
    after = bus.state()
    assert abs(after["x"] - before["x"]) < 0.005
    assert after["counters"].get("commands", 0) == before["counters"].get("commands", 0)


async def _status(page: Page, path: str, where: str, how: dict[str, Any]) -> int:
    method, token, headers = how.get("method", "GET"), how.get("token", ""), how.get("headers", {})
    async with page.client(token) as session:
        url = URL(f"{where}{path}", encoded=True)
        async with session.request(method, url, headers=headers, data=how.get("data")) as answer:
            return answer.status


EVIL = {"Origin": "https://evil.example"}
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip

TABLE: dict[str, tuple[str, str, dict[str, Any], int, str]] = {
    "no token": ("away", "/api/state", {}, 401, "no_token"),
    "no token on the socket": ("away", "/ws", {"headers": UPGRADE}, 401, "no_token"),
    "a wrong token": ("away", "/api/state", {"token": "x" * 43}, 401, "bad_token"),
    "a viewer who clears": (
        "away", "/api/srv/clear", {"token": "viewer", "method": "POST"}, 403, "role"),
    "a viewer at the settings": ("away", "/api/config", {"token": "viewer"}, 403, "role"),
    "a viewer at a recording": (
        "away", "/api/recordings/x.mcap", {"token": "viewer"}, 403, "role"),
    "another page's socket": ("here", "/ws", {"headers": UPGRADE | EVIL}, 403, "origin"),
    "another page's post": (
        "here", "/api/srv/stop", {"method": "POST", "headers": EVIL}, 403, "origin"),
    "another page's look": (
        "here", "/api/state", {"headers": {"Sec-Fetch-Site": "cross-site"}}, 403, "origin"),
    "a name pointed at 127.0.0.1": (
        "here", "/", {"headers": {"Host": "evil.example:8080"}}, 403, "host"),
    "a name that is none of the robot's": (
        "away", "/", {"headers": {"Host": "evil.example"}}, 403, "host"),
    "localhost from elsewhere, without a token": (
        "away", "/api/state", {"headers": {"Host": NAME}}, 401, "no_token"),
    "through a proxy that says so": (
        "here", "/api/state", {"headers": {"X-Forwarded-For": "203.0.113.5"}}, 403, "proxy"),
    "through a proxy that says so otherwise": (
        "here", "/", {"headers": {"Forwarded": "for=203.0.113.5"}}, 403, "proxy"),
    "through a proxy, to the socket": (
        "here", "/ws", {"headers": UPGRADE | {"Via": "1.1 proxy"}}, 403, "proxy"),
    "a token in parts without a boundary": (
        "away", "/token", {"method": "POST", "data": b"token=x",
        "headers": {"Content-Type": "multipart/form-data"}}, 400, "malformed"),
    "a token in letters that are none": (
        "away", "/token", {"method": "POST", "data": b"token=x",
        "headers": {"Content-Type": "application/x-www-form-urlencoded; charset=foo"}},
        400, "malformed"),
    "a token that is no text": (
        "away", "/token", {"method": "POST", "data": b"token=\xff",
        "headers": {"Content-Type": "application/x-www-form-urlencoded"}}, 400, "malformed"),
    "a token in JSON that is none": (
        "away", "/token", {"method": "POST", "data": b"{\xff",
        "headers": {"Content-Type": "application/json"}}, 400, "malformed"),
    "a viewer who has a recording drawn": (
        "away", "/api/recordings/x.mcap/report", {"token": "viewer", "method": "POST"}, 403,
        "role"),
    "a viewer at a report": ("away", "/report/x.mcap", {"token": "viewer"}, 403, "role"),
    "another page's link to a report": (
        "here", "/report/x.mcap", {"headers": {"Sec-Fetch-Site": "cross-site"}}, 403, "origin"),
    "a report that nobody drew": ("here", "/report/x.mcap", {}, 404, "path"),
    "a report of a file upwards": (
        "here", "/api/recordings/..%2f..%2fetc%2fpasswd/report", {"method": "POST"}, 404, "path"),
    "a path upwards": ("here", "/page/../app.py", {}, 404, "path"),
    "a path upwards, encoded": ("here", "/page/%2e%2e%2fapp.py", {}, 404, "path"),
    "a recording upwards": ("here", "/api/recordings/..%2f..%2fetc%2fpasswd", {}, 404, "path"),
    "a key with a wildcard": ("here", "/api/**", {}, 404, "path"),
    "a service that is none": ("here", "/api/srv/**", {"method": "POST"}, 404, "path"),
    "a body that is no JSON": (
        "here", "/api/srv/set", {"method": "POST", "data": b"\xff{"}, 400, "malformed"),
    "a body of 10 MB": (
        "here", "/api/srv/set", {"method": "POST", "data": bytes(10_000_000)}, 413, "too_big"),
}  # fmt: skip
"""What somebody tries: where, what, and the status and reason it is refused with."""


@pytest.mark.parametrize("what", TABLE)
def test_an_attacker_is_refused_and_counted_and_nothing_moves(
    page: Page, bus: Bus, viewer: str, what: str
) -> None:
    where, path, how, status, reason = TABLE[what]
    if how.get("token") == "viewer":
        how = how | {"token": viewer}
    before, counted = bus.state(), page.refused().get(reason, 0)
    assert asyncio.run(_status(page, path, getattr(page, where), how)) == status
    assert page.refused()[reason] == counted + 1
    after = bus.state()
    assert after["mode"] == before["mode"]
    assert abs(after["x"] - before["x"]) < 0.005


@pytest.mark.parametrize("size", [100_000, 10_000_000])
def test_a_message_that_is_too_big_ends_its_connection_and_no_other(
    page: Page, bus: Bus, size: int
) -> None:
    counted = page.refused().get("too_big", 0)

    async def story() -> None:
        async with hands(page) as ours, hands(page) as theirs:
            before = resident_kb(page.pid)
            with suppress(ConnectionError):  # closed while it is still being sent
                await theirs.socket.send_str("x" * size)
            async with asyncio.timeout(PATIENCE_S):
                while (await theirs.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                    pass
            await ours.say(ping=1)
            await ours.find(lambda said: "pong" in said)
            assert resident_kb(page.pid) < before + 5_000

    run(story)
    assert page.refused()["too_big"] == counted + 1


def test_what_is_no_message_is_told_once_a_second_and_a_flood_ends(page: Page, bus: Bus) -> None:
    async def story() -> None:
        async with hands(page) as ours:
            for _ in range(1200):
                await ours.socket.send_str("{}")
            async with asyncio.timeout(PATIENCE_S):
                told = []
                while (message := await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                    told.append(message.data)
            assert ours.socket.close_code == 1008
            assert sum("refused" in one for one in told) < 50  # by what goes out a second

    run(story)


def test_an_invitation_is_a_link_and_a_code_and_lets_in(page: Page) -> None:
    told = page.tokens("--invite", "operator", "--name", "guest", "--days", "30")
    assert "guest is operator until" in told
    assert any(char in told for char in "▀▄█")  # the code
    (link,) = re.findall(r"https://\S+:\d+/#token=(\S+)", told)

    async def story() -> None:
        async with hands(page, link) as ours:
            hello = (await ours.find(lambda said: "hello" in said))["hello"]
            assert hello["role"] == "operator"

    run(story)
    assert re.search(r"^guest +operator ", page.tokens("--tokens"), re.M)


def test_a_token_becomes_a_cookie_that_no_script_reads_and_ends_when_revoked(page: Page) -> None:
    token = page.invite("operator", "lent")

    async def story() -> None:
        async with page.client() as session:
            form = {"token": token}
            async with session.post(
                f"{page.away}/token", data=form, allow_redirects=False
            ) as answer:
                assert answer.status == 303
                cookie = answer.headers["Set-Cookie"]
            for word in ("__Host-acsard=", "HttpOnly", "Secure", "SameSite=Strict", "Path=/"):
                assert word in cookie
            async with session.get(f"{page.away}/api/whoami") as answer:
                assert await answer.json() == {"role": "operator", "name": "lent"}
            async with session.ws_connect(f"{page.away}/ws") as ours:
                page.tokens("--revoke", "lent")
                async with asyncio.timeout(PATIENCE_S):
                    while (await ours.receive()).type == aiohttp.WSMsgType.TEXT:
                        pass
            async with session.get(f"{page.away}/api/state") as answer:
                assert answer.status == 401

    run(story)
    assert "lent" not in page.tokens("--tokens")
    assert token not in page.stdout + page.stderr


def test_a_thousand_connections_leave_the_one_who_drives_his_page(page: Page, bus: Bus) -> None:
    place = page.here.removeprefix("http://").split(":")

    async def story() -> None:
        async with hands(page) as ours:
            await ours.say(subscribe="state", rate=50)
            await ours.until_driving(0.3)
            holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
            idle: list[socket.socket] = []
            for _ in range(1000):
                one = socket.socket()
                one.setblocking(False)
                one.connect_ex((place[0], int(place[1])))
                idle.append(one)
                await asyncio.sleep(0)
            await ours.say(ping=7)
            await ours.find(lambda said: said.get("pong") == 7)
            await ours.state(lambda s: s["mode"] == "driving")
            holding.cancel()
            for one in idle:
                one.close()

    run(story)
    assert page.refused()["crowded"] > 0


def test_an_address_has_room_for_twenty_pages(page: Page, bus: Bus) -> None:
    async def story() -> None:
        async with aiohttp.ClientSession() as session, AsyncExitStack() as stack:
            for _ in range(20):
                await stack.enter_async_context(session.ws_connect(f"{page.here}/ws"))
            with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
                await session.ws_connect(f"{page.here}/ws")
            assert caught.value.status == 503

    run(story)


def test_a_token_has_a_share_of_the_pages_from_however_many_addresses(
    page: Page, bus: Bus, operator: str
) -> None:
    shared = page.invite("viewer", "class")

    async def story() -> None:
        async with AsyncExitStack() as stack:
            opened = 0
            for n in range(CONNECTIONS_OF_TOKEN + 5):
                session = page.client(shared, f"127.0.0.{2 + n % 5}")
                await stack.enter_async_context(session)
                with suppress(aiohttp.WSServerHandshakeError):
                    await stack.enter_async_context(session.ws_connect(f"{page.away}/ws"))
                    opened += 1
            assert opened == CONNECTIONS_OF_TOKEN
            async with hands(page, operator) as ours:
                assert (await ours.call("stop"))["ok"]

    run(story)


def test_one_who_follows_all_that_he_can_leaves_others_theirs(
    page: Page, bus: Bus, viewer: str, operator: str
) -> None:
    async def story() -> None:
        async with AsyncExitStack() as stack:
            refused = 0
            for n in range(8):
                greedy = await stack.enter_async_context(hands(page, viewer))
                for k in range(30):
                    await greedy.say(subscribe="state", robot=f"r{n}_{k}", rate=1)
                await greedy.say(subscribe="state")
                await greedy.say(ping=n)
                await greedy.find(lambda said: "pong" in said)
                refused += any(one.get("refused") == "subscribe" for one in greedy.heard)
            assert refused == 7  # of 50 the second connection had the last 20
            ours = await stack.enter_async_context(hands(page, operator))
            await ours.say(subscribe="state", robot="r9")
            await ours.say(subscribe="state")
            await ours.state(lambda state: state["mode"])
            await ours.say(ping=1)
            await ours.find(lambda said: "pong" in said)
            assert not [one for one in ours.heard if "refused" in one]

    run(story)


def test_what_is_no_request_is_refused_in_words_like_the_rest(page: Page, bus: Bus) -> None:
    counted = page.refused()
    port = int(page.here.rpartition(":")[2])
    for said, reason, words in [
        (b"GET /api/state HTTP/1.1\r\n\r\n", "host", "no `Host`"),
        (b"\x16\x03\x01\x00\x00 hello\r\n\r\n", "malformed", "no HTTP request"),
    ]:
        with socket.create_connection(("127.0.0.1", port), 30.0) as held:
            held.sendall(said)
            head, _, body = held.makefile("rb").read().partition(b"\r\n\r\n")
        assert head.split()[1] == b"400", head
        assert b"application/json" in head
        assert b"nosniff" in head
        assert words in json.loads(body)["error"]
        assert page.refused()[reason] == counted.get(reason, 0) + 1
    assert "Traceback" not in page.stderr


def test_what_is_refused_is_a_line_a_second_in_the_log_by_reason_and_never_with_a_token(
    page: Page, bus: Bus
) -> None:
    def lines() -> list[dict[str, Any]]:
        told = [json.loads(line) for line in list(page.err) if line.startswith("{")]
        return [one for one in told if one["event"] == "page_refused"]

    def counted(reason: str) -> int:
        texts = " ".join(one["text"] for one in lines())
        return sum(int(count) for count in re.findall(rf"(\d+) {reason}", texts))

    before, told, begun = counted("bad token"), len(lines()), time.monotonic()
    guessed = "guessed-" + "x" * 35

    async def story() -> None:
        async with page.client(guessed) as session:
            for _ in range(5):
                async with session.get(f"{page.away}/api/state") as answer:
                    assert answer.status in (401, 429)

    run(story)
    until(lambda: counted("bad token") + counted("too fast") >= before + 5, 10.0, "all are told")
    assert len(lines()) - told <= time.monotonic() - begun + 1.0
    assert "guessed" not in page.stderr


def test_who_announces_a_body_and_keeps_it_is_sent_away(page: Page, daemon: Daemon) -> None:
    port = int(page.here.rpartition(":")[2])
    begun = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), 30.0) as held:
        held.sendall(b"POST /api/srv/clear HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n" % port)
        held.sendall(b"Content-Length: 100\r\n\r\n")
        answer = held.recv(4096)
    assert answer.startswith(b"HTTP/1.1 408"), answer
    assert time.monotonic() - begun < BODY_S + PATIENCE_S
