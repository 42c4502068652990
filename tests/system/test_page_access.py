"""Clients from other hosts are invited to the robot's page, admitted, listed, and removed."""

from __future__ import annotations

import asyncio
import gzip
import itertools
import json
import re
import shutil
import socket
import ssl
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import websockets

from acsard.bus.tls import peer_ends_ns
from acsard.core.values import ROLES, Role
from acsard.machine.authority import Authority
from acsard.web.connections import MAX_OF_TOKEN
from acsard.web.server import TICK_S
from tests.system.browser import NAME, Page, hands, run
from tests.system.bystander import lost
from tests.system.harness import PATIENCE_S, Bus, Daemon, until

pytestmark = pytest.mark.network

PASSES_S = 0.5
"""Time for reading the tokens, and for the transfer of a few bytes."""


@pytest.fixture(scope="module")
def viewer(page: Page) -> str:
    return page.invite("viewer", "tv")


@pytest.fixture(scope="module")
def operator(page: Page) -> str:
    return page.invite("operator", "phone")


@pytest.fixture
def bus(standing: Bus) -> Bus:
    return standing


async def test_a_phone_drives_and_is_named_and_a_stop_of_a_viewer_s_latches(
    page: Page, bus: Bus, operator: str, viewer: str
) -> None:
    async with hands(page, operator) as ours, hands(page, viewer) as theirs:
        await ours.say(subscribe="state", rate=50)
        sender = (await ours.find(lambda frame: "hello" in frame))["hello"]["sender"]
        assert sender.startswith("phone/")
        await ours.until_driving(0.3)
        state = bus.state()
        assert (state["source"], state["sender"]) == ("teleop", sender)
        holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
        answer = await theirs.call("stop")
        assert answer["ok"], answer
        state = await ours.state(lambda s: s["mode"] == "stopped" and s["linear"] == 0)
        holding.cancel()
        refused = await theirs.call("clear")
        assert not refused["ok"]
        assert "operator" in refused["text"]
        plain = await ours.call("clear")
        assert not plain["ok"]
        assert "look at the robot" in plain["text"]
        numbers = [cause["number"] for cause in state["causes"]]
        assert (await ours.call("clear", numbers=numbers))["ok"]


async def test_an_invitation_prints_a_link_and_a_qr_code_that_give_access(page: Page) -> None:
    output = page.tokens("invite", "operator", "--name", "guest", "--days", "30")
    assert "guest is operator until" in output
    assert any(char in output for char in "▀▄█")  # the code
    (link,) = re.findall(r"https://\S+:\d+/#token=(\S+)", output)
    async with hands(page, link) as ours:
        hello = (await ours.find(lambda frame: "hello" in frame))["hello"]
        assert hello["role"] == "operator"
    assert re.search(r"^guest +operator ", page.tokens("tokens"), re.M)


async def test_a_new_certificate_is_used_and_open_connections_stay(
    page: Page, operator: str
) -> None:
    endpoint = page.away.replace("https://", "tls/").replace(NAME, "127.0.0.1")
    before_ns = peer_ends_ns(endpoint, str(page.tls))
    assert before_ns is not None
    async with hands(page, operator) as ours:
        await ours.find(lambda frame: "hello" in frame)
        names = [NAME, "renamed.local"]
        Authority.load(page.tls, str).issue(page.tls, "robot", names, 0.5)
        while (peer_ends_ns(endpoint, str(page.tls)) or 0) >= before_ns:
            await asyncio.sleep(0.2)
        await ours.say(subscribe="state", rate=50)
        await ours.state(lambda state: True)
    async with page.client() as session:
        for host, status in (("renamed.local", 401), ("another.local", 403)):
            header = {"Host": host}
            async with session.get(f"{page.away}/api/whoami", headers=header) as answer:
                # The page knows the new name, and asks only there for a token.
                assert answer.status == status


async def test_a_token_becomes_a_cookie_that_no_script_reads_and_ends_when_revoked(
    page: Page,
) -> None:
    token = page.invite("operator", "lent")
    async with page.client() as session:
        form = {"token": token}
        async with session.post(f"{page.away}/token", json=form, allow_redirects=False) as answer:
            assert answer.status == 303
            cookie = answer.headers["Set-Cookie"]
        for word in ("__Host-acsard-", "HttpOnly", "Secure", "SameSite=Strict", "Path=/"):
            assert word in cookie
        async with session.get(f"{page.away}/api/whoami") as answer:
            assert await answer.json() == {"role": "operator", "name": "lent"}
        async with session.ws_connect(f"{page.away}/ws") as ours:
            page.tokens("revoke", "lent")
            async with asyncio.timeout(PATIENCE_S):
                while (await ours.receive()).type == aiohttp.WSMsgType.TEXT:
                    pass
        async with session.get(f"{page.away}/api/state") as answer:
            assert answer.status == 401
    assert "lent" not in page.tokens("tokens")
    assert token not in page.stdout + page.stderr


async def test_a_link_with_fewer_permissions_replaces_a_cookie_only_if_asked_to(page: Page) -> None:
    token = {role: page.invite(role, f"my-{role}") for role in ROLES}
    async with page.client() as phone:

        async def opens(role: Role, replace: bool = False) -> tuple[int, str]:
            """Return the status and whose cookie the browser has then."""
            form = {"token": token[role], "replace": replace}
            url = f"{page.away}/token"
            async with phone.post(url, json=form, allow_redirects=False) as answer:
                status, body = answer.status, await answer.text()
            assert status == 303 or "already signed in as my-operator (operator)" in body
            async with phone.get(f"{page.away}/api/whoami") as answer:
                return status, (await answer.json())["role"]

        assert await opens("operator") == (303, "operator")
        assert await opens("viewer") == (409, "operator")
        assert await opens("operator") == (303, "operator")
        assert await opens("maintainer") == (303, "maintainer")
        assert await opens("operator", replace=True) == (303, "operator")
        assert await opens("viewer", replace=True) == (303, "viewer")
        page.vault.revoke("my-viewer")
        assert await opens("operator") == (303, "operator")


async def test_a_phone_can_use_two_pages_on_one_host_with_its_two_tokens(
    page: Page, daemon: Daemon, tmp_path: Path
) -> None:
    """The browser sends each page the cookies of both, because cookies do not depend on ports."""
    shutil.copytree(page.tls, tmp_path / "tls")
    with Page(daemon, tmp_path) as other:
        rooms = [(page, "first"), (other, "second")]
        invited = [(server, server.invite("operator", name)) for server, name in rooms]
        async with page.client() as phone:
            for server, token in invited:
                form = {"token": token}
                async with phone.post(
                    f"{server.away}/token", json=form, allow_redirects=False
                ) as answer:
                    assert answer.status == 303
            for server, name in rooms:
                async with phone.get(f"{server.away}/api/whoami") as answer:
                    assert (await answer.json()).get("name") == name


async def test_a_driver_whose_token_is_revoked_is_disconnected_within_a_second_and_stops(
    page: Page, bus: Bus
) -> None:
    token = page.invite("operator", "trusted")
    async with hands(page, token) as ours:
        await ours.say(subscribe="state", rate=10)
        await ours.until_driving(0.3)
        holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
        page.vault.revoke("trusted")
        begun = time.monotonic()
        async with asyncio.timeout(PATIENCE_S):
            while (message := await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
        ended = time.monotonic()
        assert (message.type, message.extra) == (
            aiohttp.WSMsgType.CLOSE,
            "your token has expired or was revoked: ask for a new one",
        )
        # The server looks it up that often, and may wait for a core as this process does.
        assert ended - begun < TICK_S + PASSES_S + 4 * lost(begun, ended)
        bus.at_rest()
        with suppress(ConnectionError):
            await holding


async def test_a_connection_whose_token_was_revoked_is_cut_and_others_are_not(page: Page) -> None:
    names = [f"{name}-{time.time_ns()}" for name in ("borrowed", "owned")]
    tokens = [page.invite("viewer", name) for name in names]
    port = int(page.away.rpartition(":")[2])
    trusted = ssl.create_default_context(cafile=str(page.tls / "ca.pem"))

    async def opened(token: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Open a connection that has shown its token and has sent a part of its next request."""
        reader, writer = await asyncio.open_connection(
            "127.0.0.1", port, ssl=trusted, server_hostname=NAME
        )
        head = f"Host: {NAME}:{port}\r\nAuthorization: Bearer {token}\r\n"
        writer.write(f"GET /api/whoami HTTP/1.1\r\n{head}\r\nGET /api/whoami".encode())
        assert b" 200 " in await reader.readline()
        await reader.readuntil(b"}")
        return reader, writer

    (borrowed, first), (owned, second) = [await opened(secret) for secret in tokens]
    page.vault.revoke(names[0])
    with suppress(ConnectionError):
        assert await asyncio.wait_for(borrowed.read(), 3 * TICK_S + PATIENCE_S) == b""
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(owned.read(1), 2 * TICK_S)
    for writer in (first, second):
        writer.transport.abort()


async def test_a_token_has_few_connections_and_still_stops_beyond_them(
    page: Page, bus: Bus
) -> None:
    names = [f"{name}-{time.time_ns()}" for name in ("broken", "phone")]
    broken, phone = [page.invite("viewer", name) for name in names]
    counted = page.refused().get("too_many", 0)
    async with AsyncExitStack() as stack:
        session = await stack.enter_async_context(page.client(broken))
        for _ in range(MAX_OF_TOKEN):
            await stack.enter_async_context(session.ws_connect(f"{page.away}/ws"))
        with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
            await session.ws_connect(f"{page.away}/ws")
        assert caught.value.status == 503
        async with session.get(f"{page.away}/api/whoami") as answer:
            assert "close some" in (await answer.json())["error"]
        async with session.post(f"{page.away}/api/srv/stop") as answer:
            assert (await answer.json())["success"]
        theirs = await stack.enter_async_context(hands(page, phone))
        assert (await theirs.call("stop"))["ok"]
    assert page.refused()["too_many"] == counted + 2


PACKED = gzip.compress(b"{}")
BODIES = {
    "junk as gzip": ("Content-Encoding: gzip\r\nContent-Length: 4", b"abcd"),
    "junk as deflate": ("Content-Encoding: deflate\r\nContent-Length: 4", b"abcd"),
    "gzip data": (f"Content-Encoding: gzip\r\nContent-Length: {len(PACKED)}", PACKED),
    "junk": ("Content-Length: 4", b"abcd"),
}
"""A header and a body that is not a JSON object."""


@pytest.mark.parametrize("what", BODIES)
def test_a_malformed_body_gets_a_json_error_but_a_stop_with_it_succeeds(
    page: Page, bus: Bus, what: str
) -> None:
    port = int(page.here.rpartition(":")[2])
    header, sent = BODIES[what]

    def answered(line: str, *more: str) -> tuple[int, dict[str, Any], float]:
        """Return the status and the JSON body of the answer, and how often the page refused."""
        before = page.refused().get("malformed", 0)
        lines = (f"{line} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Connection: close", header, *more)
        with socket.create_connection(("127.0.0.1", port), 30.0) as connection:
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            time.sleep(0.1)  # the page begins to serve the request before its body arrives
            connection.sendall(sent)
            head, _, body = connection.makefile("rb").read().partition(b"\r\n\r\n")
        value = json.loads(body) if b"application/json" in head else {}
        return int(head.split()[1]), value, page.refused().get("malformed", 0) - before

    assert answered("GET /api/whoami")[0] == 200  # the server ignores the body
    for line in ("POST /token", "POST /api/srv/clear"):
        status, value, refused = answered(line, "Content-Type: application/json")
        assert (status, list(value), refused) == (400, ["error"], 1), line
    assert bus.state()["mode"] == "ready"
    status, value, refused = answered("POST /api/srv/stop")  # the server does not read the body
    assert (status, value["success"], refused) == (200, True, 0)
    assert bus.state()["mode"] == "stopped"
    assert "Traceback" not in page.stderr


def test_a_client_that_leaves_before_the_end_of_its_body_leaves_no_traceback(
    page: Page, bus: Bus
) -> None:
    port = int(page.here.rpartition(":")[2])
    head = f"POST /api/srv/stop HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 9\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port), 30.0) as connection:
        connection.sendall(head.encode())
        time.sleep(0.1)
    until(lambda: bus.state()["mode"] == "stopped", 10.0, "the robot stops")
    assert "Traceback" not in page.stderr


def test_refusals_are_logged_once_a_second_by_reason_and_without_tokens(
    page: Page, bus: Bus
) -> None:
    def lines() -> list[dict[str, Any]]:
        records = [json.loads(line) for line in list(page.err) if line.startswith("{")]
        return [record for record in records if record["event"] == "page_refused"]

    def counted(reason: str) -> int:
        texts = " ".join(record["text"] for record in lines())
        return sum(int(count) for count in re.findall(rf"(\d+) {reason}", texts))

    before, line_count, begun = counted("bad token"), len(lines()), time.monotonic()
    guessed = "guessed-" + "x" * 35

    async def story() -> None:
        async with page.client(guessed) as session:
            for _ in range(5):
                async with session.get(f"{page.away}/api/state") as answer:
                    assert answer.status == 401

    run(story)
    until(lambda: counted("bad token") >= before + 5, 10.0, "all refusals are logged")
    assert " from 127.0.0.1" in lines()[-1]["text"]
    assert len(lines()) - line_count <= time.monotonic() - begun + 1.0
    assert "guessed" not in page.stderr


async def test_a_driving_program_that_is_disconnected_gets_a_close_code_and_a_reason(
    page: Page, bus: Bus
) -> None:
    """The page waits for the client's answer to the close before it ends the connection.

    Otherwise the program could not tell a close from a lost radio link.
    """
    vault = page.vault
    trusted = ssl.create_default_context(cafile=str(page.tls / "ca.pem"))
    wishes = (json.dumps({"cmd": {"linear_x": 0}, "stamp": 1.8e12 + n}) for n in itertools.count())

    async def plain(name: str) -> tuple[int | None, str | None]:
        """Drive by aiohttp in one task and read in another. Return close code and reason."""
        async with (
            page.client(page.invite("operator", name)) as session,
            session.ws_connect(f"{page.away}/ws") as ours,
        ):
            driving = asyncio.create_task(drive(ours.send_str))
            vault.revoke(name)
            while (message := await ours.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
            await driving
            return ours.close_code, message.extra

    async def other(name: str) -> tuple[int | None, str | None]:
        """Drive by the library websockets, which answers pings. Return close code and reason."""
        headers = {"Authorization": f"Bearer {page.invite('operator', name)}"}
        url = page.away.replace("https", "wss") + "/ws"
        async with websockets.connect(
            url, ssl=trusted, host="127.0.0.1", additional_headers=headers
        ) as ours:
            driving = asyncio.create_task(drive(ours.send))
            vault.revoke(name)
            await ours.wait_closed()
            await driving
            return ours.close_code, ours.close_reason

    async def drive(send: Callable[[str], Awaitable[None]]) -> None:
        with suppress(ConnectionError, websockets.ConnectionClosed):
            while True:
                await send(next(wishes))
                await asyncio.sleep(0.01)

    results = await asyncio.gather(plain("trusted2"), other("trusted3"))
    assert set(results) == {(1008, "your token has expired or was revoked: ask for a new one")}
