"""The page in a real browser drives, stops and sets a robot, for a phone that was invited.

`unit/page_stories.js` has what the page decides and says. Here is what only a browser can break:
its touches, keys and clicks, its cookies, and its rules for scripts.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.cli import command_line
from acsard.machine.authority import Authority
from acsard.web.viewer import PING_INTERVAL_S
from tests.system.browser import NAME, TRUSTING, Page, text
from tests.system.chromium import CHROMIUM, DESKTOP, PHONE, RED, SETTLED_S, browsing
from tests.system.harness import running as running_daemon
from tests.system.harness import until
from tests.system.phone_page import HELD, Phone, alone

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


def moves(page: Phone, field: str = "linear") -> bool:
    return (page.bus.state()[field] or 0.0) > 0.15


def test_a_finger_drives_turns_and_stops_and_releases_the_stop(phone: Phone) -> None:
    browser, bus = phone.browser, phone.bus
    assert browser.js("document.getElementById('simulated').hidden") is False
    phone.hold()
    until(lambda: bus.state()["x"] > 0.3, 20.0, "it drives on")
    assert bus.state()["source"] == "teleop"
    phone.shows("who", "you")
    assert (bus.state()["linear"] or 0.0) <= 0.2 + 0.03  # slow at the beginning
    browser.push(-80, 0)
    until(lambda: bus.state()["yaw"] > 0.3, 10.0, "it turns left")
    browser.touch("End")
    bus.at_rest()
    phone.hold()
    browser.tap("stop")
    until(lambda: bus.state()["mode"] == "stopped", 5.0, "it stops")
    phone.shows("reason", "stopped by your page")
    browser.touch("End")
    browser.release()
    phone.shows("mode", "READY")
    browser.key("Down", "Space", " ")
    browser.key("Up", "Space", " ")
    phone.shows("mode", "STOPPED")
    assert browser.said == []


LIMIT = "document.getElementById('limit').value"


def test_keys_drive_while_they_are_held_also_after_the_slider_was_set(phone: Phone) -> None:
    browser, bus, before = phone.browser, phone.bus, phone.browser.js(LIMIT)
    browser.mouse("Pressed", browser.middle("limit"))
    browser.mouse("Released", browser.middle("limit"))
    until(lambda: browser.js(LIMIT) != before, 5.0, "it is set")
    chosen = browser.js(LIMIT)
    browser.key("Down", "ArrowUp", "ArrowUp", windowsVirtualKeyCode=38)
    fast = float(chosen) - 0.05
    until(lambda: (bus.state()["linear"] or 0.0) > fast, 10.0, "forwards, as fast")
    assert browser.js(LIMIT) == chosen
    browser.key("Down", "KeyA", "a")
    until(lambda: moves(phone, "angular"), 10.0, "and left")
    browser.key("Up", "ArrowUp", "ArrowUp")
    until(lambda: not moves(phone), 10.0, "left only")
    browser.key("Up", "KeyA", "a")
    bus.at_rest()
    assert browser.js(HELD) is False


def test_releasing_the_left_mouse_button_while_another_is_held_releases_the_stick(
    phone: Phone,
) -> None:
    """While another mouse button is down, the browser sends no `pointerup` for the left one."""
    browser = phone.browser
    browser.size(*DESKTOP, touch=False)
    x, y = browser.middle("stick")

    def drives() -> bool:
        if not browser.js(HELD):  # a busy machine may make the page release it
            browser.mouse("Released", (x, y), buttons=0)
            browser.mouse("Pressed", (x, y))
            browser.mouse("Moved", (x, y - 90), "none")
        return moves(phone)

    until(drives, 10.0, "it drives")
    browser.mouse("Pressed", (x, y - 90), "right", buttons=3)
    browser.mouse("Released", (x, y - 90), "left", buttons=2)
    phone.shows("hint", "another button is down")
    phone.bus.at_rest()
    browser.mouse("Released", (x, y - 90), "right", buttons=0)


CORNER = """(b => [b.x + 40, b.y + b.height / 2])(
    document.getElementById('stop').getBoundingClientRect())"""
"""The part of STOP at whose place the button that releases STOP appears."""


def test_taps_clicks_and_a_held_key_release_only_what_the_button_said_a_second_before(
    phone: Phone,
) -> None:
    browser, bus = phone.browser, phone.bus
    corner = browser.js(CORNER)
    for _ in range(3):
        browser.touch("Start", corner)
        browser.touch("End")
        time.sleep(0.3)
    assert bus.state()["mode"] == "stopped"
    phone.shows("complaint", "This button has just appeared or changed, or was pressed")
    browser.release()
    phone.shows("mode", "READY")
    bus.get("srv/deactivate")
    bus.get("srv/stop")
    phone.shows("clear", "Release STOP")
    browser.settle()
    for count in (1, 2):  # a double click
        browser.mouse("Pressed", browser.middle("clear"), clicks=count)
        browser.mouse("Released", browser.middle("clear"), buttons=0, clicks=count)
        time.sleep(0.25)
    phone.shows("clear", "Switch on")
    assert bus.state()["mode"] == "inactive"
    bus.get("srv/stop")
    phone.shows("clear", "Release STOP")
    browser.settle()
    browser.js("document.getElementById('clear').focus()")
    enter = {"text": "\r", "windowsVirtualKeyCode": 13}
    for n in range(8):
        browser.key("Down", "Enter", "Enter", autoRepeat=n > 0, **enter)
        time.sleep(0.2)
    browser.key("Up", "Enter", "Enter")
    phone.shows("clear", "Switch on")
    assert bus.state()["mode"] == "inactive"
    time.sleep(SETTLED_S)
    browser.key("Down", "Enter", "Enter", **enter)
    browser.key("Up", "Enter", "Enter")
    phone.shows("mode", "READY")


SET = """(() => {
    const button = document.querySelector('[aria-label="Set limits.linear_speed"]');
    if (!button) return false;
    button.parentElement.querySelector('input').value = '0,31';
    button.focus();
    button.click();
    return true;
})()"""
"""Decimal comma, as people in many countries type it."""

KEPT = """[...document.querySelectorAll('#settings code')].filter(
    code => getComputedStyle(code).display !== 'none').map(code => code.textContent)"""
"""The commands that keep a value: of the row with the focus."""

ADDED = """document.head.append(Object.assign(document.createElement('script'),
    {textContent: 'window.added = true'})), window.added ?? false"""


@alone
def test_settings_reach_the_robot_and_text_of_strangers_is_only_shown(phone: Phone) -> None:
    browser, bus = phone.browser, phone.bus
    browser.tap("tab-set")
    until(lambda: browser.js(SET), 5.0, "the setting is there")
    until(lambda: bus.get("config")["limits"]["linear_speed"] == 0.31, 5.0, "it is set")
    phone.shows("set-answer", "0.31")
    kept = "acsard set limits.linear_speed 0.31 --keep"
    until(lambda: browser.js(KEPT) == [kept], 5.0, "the row shows how to keep it")
    assert command_line.parser().parse_args(kept.split()[1:]).keep
    for button, mode in (("deactivate", "INACTIVE"), ("activate", "READY")):
        browser.js(f"document.getElementById({button!r}).click()")
        phone.shows("mode", mode)
    evil = "<img src=x onerror=document.title='owned'>"
    bus.put("cmd/app", {"linear": {"x": evil}, "angular": {"z": 0}})
    browser.tap("tab-events")
    phone.shows("happened", "refused")
    assert browser.js("document.querySelectorAll('#happened img').length") == 0
    assert browser.js("document.title") == "READY · acsar"
    assert browser.js(ADDED) is False


def viewers(page: Page) -> int:
    """Return the number of open pages that the page's server counts."""
    metrics = asyncio.run(text(f"{page.here}/metrics"))
    return int(re.findall(r"^acsard_page_viewers\{.*\} (\d+)(?:\.0)?$", metrics, re.MULTILINE)[0])


@pytest.mark.nightly
@alone
def test_a_page_disconnects_when_it_is_left_and_reconnects_after_going_back(phone: Phone) -> None:
    """The browser keeps a page that a person has left, so the page itself must disconnect."""
    browser, left = phone.browser, time.monotonic()
    browser.open("about:blank")
    until(lambda: viewers(phone.server) == 0, 5.0, "no page is open")
    assert time.monotonic() - left < PING_INTERVAL_S, "the server had to find out"
    browser.js("history.back()")
    phone.shows("age", "live")
    phone.shows("mode", "READY")
    phone.hold()
    browser.touch("End")


@pytest.fixture
def stranger(tmp_path: Path) -> Iterator[Phone]:
    """A phone that the robot does not know."""
    Authority.make(tmp_path / "tls", "test", 1, [NAME]).issue(tmp_path / "tls", "robot", [NAME], 1)
    with (
        running_daemon(tmp_path) as (daemon, bus), Page(daemon, tmp_path) as server,
        browsing(options=TRUSTING) as browser,
    ):  # fmt: skip
        browser.size(*PHONE)
        yield Phone(daemon, bus, server, browser)


def test_an_invited_phone_stops_learns_that_its_token_was_revoked_and_is_invited_again(
    stranger: Phone,
) -> None:
    browser, server = stranger.browser, stranger.server
    browser.open(f"{server.away}/#token={server.invite('viewer', 'tv')}")
    stranger.shows("role", "viewer")
    stranger.shows("mode", "READY")
    assert browser.js("location.hash") == ""
    browser.tap("stop")
    stranger.shows("reason", "an operator releases it")
    assert stranger.bus.state()["mode"] == "stopped"
    server.vault.revoke("tv")
    stranger.shows("reason", "this token is not valid")
    assert browser.js(RED) is False
    assert browser.too_small() == []
    refused = sum(server.refused().values())
    time.sleep(1.5)  # the page would have tried again twice
    assert sum(server.refused().values()) == refused
    browser.js(f"location.hash = 'token={server.invite('operator', 'phone')}'")
    stranger.shows("role", "operator")
    assert browser.js(RED) is True
