"""The page as an installed service, opened to phones by the commands on the manual's web page."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress

import aiohttp
import pytest

from tests.pages import Block, blocks
from tests.system.browser import Hands, run
from tests.system.harness import PATIENCE_S, until
from tests.system.hosts import inside
from tests.systemd.container import (
    CONFIG,
    GATEWAY,
    PAGE,
    UNIT,
    Container,
)
from tests.systemd.phone import ROBOT_AT, STRANGE, Phone

pytestmark = pytest.mark.systemd

AWAY = f"https://{ROBOT_AT}:8443"
"""The address that the phone opens."""

LINK = re.compile(rf"{AWAY}/#token=(\S+)")

SERVED_S = 20.0


def of_the_page(language: str, words: str) -> Block:
    """Return the only code block of the manual's page that contains these words."""
    (match,) = (
        block
        for block in blocks(language)
        if block.page == "deploy/manual/pages/howto/phone.md" and words in block.text
    )
    return match


OPENING = of_the_page("console", "acsard-web.service.d").commands()
"""The commands that open it. The last of them invites."""

REVOKING, RENEWING = of_the_page("console", "tls renew").commands()

SETTINGS = 'mcu.port = "sim"\n' + of_the_page("toml", "https://0.0.0.0:8443").text


def clean(container: Container) -> None:
    """Remove certificates and tokens, so that the container is as it was after the installation."""
    container.reset()
    container.run("systemctl", "clean", "--what=state", PAGE)
    container.run("rm", "-rf", "/etc/acsard/tls")


@pytest.fixture(scope="module")
def robot(booted: Container) -> Iterator[Container]:
    """Run the service on the simulator. Only programs in the container can reach its page."""
    clean(booted)
    booted.write(CONFIG, 'mcu.port = "sim"\n')
    for unit in (UNIT, PAGE):
        started = booted.start(unit)
        assert started.code == 0, started.err + booted.messages(unit)
    yield booted
    clean(booted)


@pytest.fixture(scope="module")
def phone(robot: Container) -> Iterator[Phone]:
    """Provide a phone, after the robot's page was opened to the network."""
    with Phone(robot) as phone:
        robot.write(CONFIG, SETTINGS)
        for command in OPENING[:-1]:
            robot.types(command)
        is_served(robot, phone)
        yield phone


def is_served(robot: Container, phone: Phone) -> None:
    """Check that both the page and the daemon behind it answer the phone."""
    until(lambda: phone.presented_certificate(8443), SERVED_S, "the page is served")
    until(lambda: '"mode"' in robot.fetch("/api/state"), SERVED_S, "it hears the robot")


def invited(robot: Container, *more: str) -> str:
    """Invite a client with the page's command, and return its token."""
    output = robot.types(" ".join([OPENING[-1], *more])).out
    match = LINK.search(output)
    assert match, output
    return match[1]


def on(phone: Phone, story: Callable[[], Awaitable[None]]) -> None:
    """Run this coroutine function in the phone's network namespace."""
    with inside(phone.name):
        run(story)


async def let_in(browser: aiohttp.ClientSession, token: str) -> str:
    """Post a token as the page does, and return the cookie that the server sets."""
    posted = browser.post(f"{AWAY}/token", json={"token": token}, headers={"Origin": AWAY})
    async with posted as answer:
        assert answer.status == 200, await answer.text()
        assert "<html" in await answer.text()
        (redirect,) = answer.history
        return redirect.headers["Set-Cookie"]


def test_an_invited_phone_drives_and_stops_the_installed_robot_until_it_is_revoked(
    robot: Container, phone: Phone
) -> None:
    token = invited(robot)

    async def story() -> None:
        async with phone.browser() as browser:
            async with browser.get(AWAY) as answer:
                assert (answer.status, "<html" in await answer.text()) == (200, True)
            cookie = await let_in(browser, token)
            assert {"HttpOnly", "Secure", "SameSite=Strict"} <= set(cookie.split("; "))
            async with browser.ws_connect(f"{AWAY}/ws", origin=AWAY) as opened:
                await drives_until_revoked(Hands(opened))
            async with browser.get(f"{AWAY}/api/state") as answer:
                assert answer.status == 401

    async def drives_until_revoked(ours: Hands) -> None:
        hello = (await ours.find(lambda message: "hello" in message))["hello"]
        assert hello["role"] == "operator"
        assert hello["sender"].startswith("phone/")
        await ours.say(subscribe="state", rate=50)
        await ours.until_driving(0.2)
        assert (await ours.call("stop"))["ok"]
        status = await ours.state(lambda state: state["mode"] == "stopped" and state["linear"] == 0)
        numbers = [cause["number"] for cause in status["causes"]]
        assert (await ours.call("clear", numbers=numbers))["ok"]
        await ours.until_driving(0.2)
        holding = asyncio.create_task(ours.hold(0.2, 3 * PATIENCE_S))
        await asyncio.to_thread(robot.types, REVOKING)
        while (await ours.socket.receive()).type == aiohttp.WSMsgType.TEXT:
            pass
        assert ours.socket.close_code is not None
        holding.cancel()
        with suppress(asyncio.CancelledError, ConnectionError):
            await holding

    on(phone, story)
    stands = until(
        lambda: (state := json.loads(robot.fetch("/api/state")))["linear"] == 0 and state,
        SERVED_S,
        "the robot stands",
    )
    assert stands["mode"] != "stopped", "no client has stopped it: the driver is gone"


def test_a_page_for_phones_leaves_no_failed_unit_and_no_warning(
    robot: Container, phone: Phone
) -> None:
    """The certificates are for the page alone: the bus listens nowhere with TLS."""
    robot.run("systemctl", "restart", UNIT, GATEWAY)
    ended = "inactive", "failed"
    until(lambda: robot.show("ActiveState", GATEWAY) in ended, SERVED_S, "it has ended")
    assert (robot.show("ActiveState", GATEWAY), robot.show("Result", GATEWAY)) == (
        "inactive", "success",
    )  # fmt: skip
    assert "has no tls/ endpoint" in robot.messages(GATEWAY)
    is_served(robot, phone)
    state = until(
        lambda: (state := json.loads(robot.fetch("/api/state")))["certificate"] and state,
        SERVED_S,
        "the daemon reads the certificates",
    )
    assert state["certificate"] == "valid"


def test_a_client_without_a_token_gets_only_the_empty_page(robot: Container, phone: Phone) -> None:
    async def story() -> None:
        for token in ("", "x" * 43):
            async with phone.browser(token) as stranger:
                for path in ("/api/state", "/api/recordings", "/metrics", "/ws"):
                    async with stranger.get(f"{AWAY}{path}") as answer:
                        assert answer.status == 401, path
                async with stranger.post(f"{AWAY}/api/srv/stop") as answer:
                    assert answer.status == 401

    on(phone, story)


def test_the_networks_of_lan_conf_reach_the_page_and_no_other_port(
    robot: Container, phone: Phone
) -> None:
    assert phone.reaches(8443)
    assert not phone.reaches(8080), "without TLS for this computer alone"
    assert not phone.reaches(7448), "the bus"
    assert not phone.reaches(8443, STRANGE), "of a network that is not in it"
    # Check that the unit refused it, and that a route existed:
    robot.drop_in("wider.conf", "[Service]\nIPAddressAllow=203.0.113.0/24\n", PAGE)
    robot.types("systemctl restart acsard-web")
    is_served(robot, phone)
    assert phone.reaches(8443, STRANGE)


def test_a_renewed_certificate_is_shown_after_the_reload_and_tokens_still_count(
    robot: Container, phone: Phone
) -> None:
    token = invited(robot, "--name guest")
    before = phone.presented_certificate(8443)
    robot.types(RENEWING)
    until(
        lambda: phone.presented_certificate(8443) not in ("", before),
        SERVED_S,
        "the new one is shown",
    )

    async def story() -> None:
        async with phone.browser(token) as guest, guest.get(f"{AWAY}/api/whoami") as answer:
            assert (await answer.json())["name"] == "guest"

    on(phone, story)


def test_the_page_unit_without_its_drop_in_stays_down_and_names_lan_conf(
    robot: Container, phone: Phone
) -> None:
    robot.types("rm -r /etc/systemd/system/acsard-web.service.d && systemctl daemon-reload")
    robot.types("systemctl restart acsard-web")
    until(lambda: robot.show("ActiveState", PAGE) == "failed", SERVED_S, "it gives up")
    assert robot.show("ExecMainStatus", PAGE) == "77"
    assert "lan.conf" in robot.messages(PAGE)
