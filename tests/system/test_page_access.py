"""Clients from other hosts are invited to the robot's page, admitted, listed, and removed."""

from __future__ import annotations

import asyncio
import re
import time
from contextlib import suppress

import aiohttp
import pytest

from acsard.bus.tls_files import peer_ends_ns
from acsard.machine.authority import Authority
from acsard.web.page_server import TICK_S
from tests.system.browser import NAME, Page, hands
from tests.system.bystander import lost
from tests.system.harness import PATIENCE_S, Bus, until

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
        Authority.load(page.tls).issue(page.tls, "robot", names, 0.5)
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
    until(lambda: re.search(r"\d bad token.* from 127\.0\.0\.1", page.stderr), 10.0, "a log line")
    assert token not in page.stdout + page.stderr


async def test_a_driver_whose_token_is_revoked_learns_why_within_a_second_and_the_robot_stops(
    page: Page, bus: Bus
) -> None:
    """A connection that ended without a reason would look like a lost radio link."""
    name, why = "trusted", "your token has expired or was revoked"
    async with hands(page, page.invite("operator", name)) as ours:
        await ours.say(subscribe="state", rate=10)
        sender = (await ours.find(lambda frame: "hello" in frame))["hello"]["sender"]
        assert sender.startswith(f"{name}/")
        await ours.until_driving(0.3)
        assert (bus.state()["source"], bus.state()["sender"]) == ("teleop", sender)
        holding = asyncio.create_task(ours.hold(0.3, PATIENCE_S))
        page.vault.revoke(name)
        begun = time.monotonic()
        async with asyncio.timeout(PATIENCE_S):
            while (message := await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
        ended = time.monotonic()
        assert (ours.socket.close_code, message.extra) == (1008, f"{why}: ask for a new one")
        # The server looks it up that often, and may wait for a core as this process does.
        assert ended - begun < TICK_S + PASSES_S + 4 * lost(begun, ended)
        with suppress(ConnectionError):
            await holding
