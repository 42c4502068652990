"""Who comes to the robot's page from elsewhere: invited, let in, named, and sent away again."""

from __future__ import annotations

import asyncio
import re

import aiohttp
import pytest

from tests.system.browser import Page, hands, run
from tests.system.harness import PATIENCE_S, Bus

pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def viewer(page: Page) -> str:
    return page.invite("viewer", "tv")


@pytest.fixture(scope="module")
def operator(page: Page) -> str:
    return page.invite("operator", "phone")


@pytest.fixture
def bus(standing: Bus) -> Bus:
    return standing


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
