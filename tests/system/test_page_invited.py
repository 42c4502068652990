"""An invitation link in a real browser admits the client on any network, or shows the reason."""

from __future__ import annotations

import asyncio
import json
import ssl
import urllib.request
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from typing import Any

import pytest

from acsard.machine.authority import Authority
from acsard.web.access import FLOOD_TEXT
from acsard.web.connections import MAX_OF_TOKEN
from tests.system.browser import NAME, TRUSTING, Page, hands
from tests.system.chromium import CHROMIUM, PHONE, Browser, browsing
from tests.system.harness import PATIENCE_S, running, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

NEXT_MS = 1200
"""Time after which the page would have tried again, twice."""


class Stranger:
    """A phone, and the page of a robot that does not know it."""

    def __init__(self, server: Page, browser: Browser) -> None:
        self.server, self.browser = server, browser

    def opens(self, token: str) -> None:
        """Open the link of an invitation with this token."""
        self.browser.open(f"{self.server.away}/#token={token}")

    def shows(self, name: str, words: str) -> None:
        until(lambda: words in self.browser.text(name), 15.0, f"{name} says {words!r}")

    @property
    def tries(self) -> float:
        """The number of requests that the page has refused because they had no valid token."""
        counted = self.server.refused()
        return sum(counted.get(reason, 0) for reason in ("no_token", "bad_token"))

    def knocks_no_more(self, since: float, times: int) -> None:
        """Wait for `times` refusals since `since`, and check that the page then stops trying."""
        until(lambda: self.tries >= since + times, 15.0, "it is refused")
        before = self.tries
        self.browser.js(f"new Promise(done => setTimeout(done, {NEXT_MS}))")
        assert self.tries == before


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    where = tmp_path_factory.mktemp("invited")
    Authority.make(where / "tls", "test", 1, [NAME]).issue(where / "tls", "robot", [NAME], 1)
    with running(where) as (daemon, _), Page(daemon, where) as server:
        yield server


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing(options=TRUSTING) as browser:
        browser.size(*PHONE)
        browser.ask("Network.enable")
        yield browser


@pytest.fixture
def stranger(server: Page, browser: Browser) -> Stranger:
    browser.open("about:blank")
    browser.ask("Network.clearBrowserCookies")
    return Stranger(server, browser)


@contextmanager
def silent(browser: Browser, path: str) -> Iterator[None]:
    """Block the page's requests for this path while the body runs."""
    browser.ask("Network.setBlockedURLs", urls=[f"*/{path}"])
    try:
        yield
    finally:
        browser.ask("Network.setBlockedURLs", urls=[])


def ask(server: Page, key: str, payload: object = None) -> Any:
    """Return the robot's answer to a client on the robot itself."""
    body = None if payload is None else json.dumps(payload).encode()
    request = urllib.request.Request(f"{server.here}/api/{key}", body)
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        return json.load(answer)


def test_an_invitation_outlives_a_network_that_fails(stranger: Stranger) -> None:
    browser = stranger.browser
    token = stranger.server.invite("operator", "flaky")
    with silent(browser, "token"):
        stranger.opens(token)
        stranger.shows("reason", "Your invitation has no answer yet")
        assert token in browser.js("location.hash")  # a reload shows it again
    stranger.shows("role", "operator")
    stranger.shows("mode", "READY")
    assert browser.js("location.hash") == ""


def test_an_invalid_invitation_is_reported_and_the_page_stops_connecting(
    stranger: Stranger,
) -> None:
    before = stranger.tries
    stranger.opens("x" * 43)
    stranger.knocks_no_more(before, 3)  # the invitation, the socket, and the reason
    assert "This invitation is not valid" in stranger.browser.text("reason")
    assert stranger.browser.js("location.hash") == ""


def test_a_revoked_token_is_reported_and_a_new_link_in_its_tab_gives_access(
    stranger: Stranger,
) -> None:
    stranger.opens(stranger.server.invite("viewer", "lent"))
    stranger.shows("role", "viewer")
    stranger.server.vault.revoke("lent")
    before = stranger.tries
    stranger.knocks_no_more(before, 2)  # the socket, and the reason
    assert "this token is not valid" in stranger.browser.text("reason")
    assert "ask for a new one" in stranger.browser.text("reason")
    token = stranger.server.invite("operator", "anew")
    stranger.browser.js(f"location.hash = 'token={token}'")
    stranger.shows("role", "operator")


def test_a_page_without_a_token_says_so_and_retries_only_after_a_press(stranger: Stranger) -> None:
    browser = stranger.browser
    before = stranger.tries
    browser.open(stranger.server.away)
    stranger.knocks_no_more(before, 2)
    assert "a token is missing" in browser.text("reason")
    # The phone was meanwhile invited in another tab.
    token = stranger.server.invite("viewer", "tab")
    posted = "fetch('token', {method: 'POST', body: JSON.stringify({token: 'TOKEN'})})"
    browser.js(posted.replace("TOKEN", token) + ".then(told => told.ok)")
    browser.tap("again")
    stranger.shows("role", "viewer")
    assert browser.too_small() == []


async def test_a_page_beyond_the_connections_of_its_token_says_why_and_can_still_stop(
    stranger: Stranger, server: Page
) -> None:
    token = server.invite("operator", "shared")

    def look() -> None:
        stranger.opens(token)
        stranger.shows("reason", f"{MAX_OF_TOKEN} connections with this token are open already")
        stranger.browser.tap("stop")
        until(lambda: ask(server, "state")["mode"] == "stopped", 5.0, "it stops all the same")

    async with AsyncExitStack() as stack:
        for _ in range(MAX_OF_TOKEN):
            await stack.enter_async_context(hands(server, token))
        await asyncio.to_thread(look)
    await asyncio.to_thread(stranger.shows, "mode", "STOPPED")  # it connects by itself
    numbers = [cause["number"] for cause in ask(server, "state")["causes"]]
    assert ask(server, "srv/clear", {"numbers": numbers})["success"]


async def test_a_page_whose_token_floods_says_why_and_connects_by_itself_afterwards(
    stranger: Stranger, server: Page
) -> None:
    token = server.invite("operator", "flooded")
    stranger.opens(token)
    stranger.shows("mode", "READY")

    port = int(server.away.rpartition(":")[2])
    trusted = ssl.create_default_context(cafile=str(server.tls / "ca.pem"))
    asked = f"GET /api/whoami HTTP/1.1\r\nHost: {NAME}\r\nAuthorization: Bearer {token}\r\n\r\n"

    async def floods() -> None:
        while True:
            with suppress(OSError, TimeoutError):
                reader, writer = await asyncio.open_connection(
                    "127.0.0.1", port, ssl=trusted, server_hostname=NAME
                )
                writer.write(600 * asked.encode())
                async with asyncio.timeout(5.0):
                    await reader.read()
                writer.transport.abort()

    flood = asyncio.create_task(floods())
    await asyncio.to_thread(stranger.shows, "reason", FLOOD_TEXT)
    await asyncio.sleep(2.0)  # the page tries again and is refused
    flood.cancel()
    await asyncio.to_thread(stranger.shows, "mode", "READY")


@pytest.mark.parametrize(("agrees", "role"), [(False, "operator"), (True, "viewer")])
def test_a_link_with_fewer_permissions_is_used_only_after_a_question(
    stranger: Stranger, agrees: bool, role: str
) -> None:
    browser, server = stranger.browser, stranger.server
    stranger.opens(server.invite("operator", f"mine{agrees}"))
    stranger.shows("role", "operator")
    browser.open("about:blank")
    question = "window.confirm = (text) => { window.asked = text; return AGREES; }"
    added = browser.ask(
        "Page.addScriptToEvaluateOnNewDocument",
        source=question.replace("AGREES", str(agrees).lower()),
    )
    try:
        stranger.opens(server.invite("viewer", f"lesser{agrees}"))
        until(lambda: browser.js("window.asked"), 15.0, "it asks")
        asked = browser.js("window.asked")
        makes = f"mine{agrees} (operator); the link would sign it in as lesser{agrees} (viewer)"
        assert makes in asked
        stranger.shows("role", role)
        assert browser.js("location.hash") == ""
    finally:
        browser.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
