"""What drives the robot from the page, and what releases the stick."""

from __future__ import annotations

import asyncio
import json
import re
import time

import pytest

from acsard.web.viewer import PING_INTERVAL_S
from tests.system.browser import answer, hands
from tests.system.chromium import (
    CHROMIUM,
    DESKTOP,
    HAS_WINDOWS,
)
from tests.system.harness import until
from tests.system.phone_page import HELD, Phone, alone, greyed
from tests.tools.pictures import VIEWS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


@pytest.fixture
def page(phone: Phone) -> Phone:
    return phone


@alone
def test_a_finger_drives_a_metre_turns_stops_and_clears(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    assert browser.js("document.getElementById('simulated').hidden") is False
    page.hold()
    until(lambda: bus.state()["x"] > 1.0, 20.0, "a metre")
    assert bus.state()["source"] == "teleop"
    page.shows("who", "you")
    assert (bus.state()["linear"] or 0.0) <= 0.2 + 0.03  # slow at the beginning
    page.browser.push(-80, 0)
    until(lambda: bus.state()["yaw"] > 0.3, 10.0, "it turns left")
    browser.touch("End")
    bus.at_rest()
    page.hold()
    browser.tap("stop")
    until(lambda: bus.state()["mode"] == "stopped", 5.0, "it stops")
    page.shows("mode", "STOPPED")
    page.shows("reason", "stopped by here@page")
    # A person who still holds the stick does not drive when another person clears.
    browser.touch("End")
    browser.release()
    page.shows("mode", "READY")
    bus.at_rest()
    page.hold()
    browser.touch("End")
    bus.at_rest()
    assert browser.said == []


def test_space_stops_from_every_view_and_a_stick_that_is_held_drives_no_more(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    for view in VIEWS:
        browser.tap(f"tab-{view}")
        browser.key("Down", "Space", " ")
        browser.key("Up", "Space", " ")
        until(lambda: bus.state()["mode"] == "stopped", 5.0, f"stopped from {view}")
        page.shows("mode", "STOPPED")
        browser.release()
        until(lambda: bus.state()["mode"] == "ready", 5.0, "cleared")
        page.shows("mode", "READY")
    browser.tap("tab-drive")
    page.hold()
    bus.get("srv/stop")  # by another client
    page.shows("hint", "Stopped. Press Release STOP first.")
    assert "srv/clear" not in browser.js("document.body.innerText")
    bus.get("srv/clear")
    page.shows("mode", "READY")
    # The finger is still down.
    sent = bus.count("commands")
    page.browser.push(0, 80)
    until(lambda: page.browser.js("performance.now()") > 0, 1.0, "a round")
    page.shows("mode", "READY")
    assert bus.count("commands") == sent
    browser.touch("End")


def test_a_stick_that_is_pushed_while_the_robot_is_stopped_sends_nothing(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    bus.get("srv/stop")
    page.shows("mode", "STOPPED")
    assert greyed(browser)
    commands = bus.count("commands")
    browser.push(0, 0, "Start")
    browser.push(0, 90)
    browser.touch("End")
    assert browser.js(HELD) is False
    assert bus.count("commands") == commands


async def test_a_second_page_names_the_driver_and_its_stick_is_grey(
    page: Phone,
) -> None:
    def look() -> None:
        browser = page.browser
        page.shows("who", "another page on the robot itself")
        assert greyed(browser)
        browser.push(0, 0, "Start")
        browser.push(0, 90)
        active = browser.js(HELD)
        browser.touch("End")
        assert active is False

    async with hands(page.server) as other:
        await other.say(subscribe="state", rate=10)
        await other.until_driving(0.1)
        driving = asyncio.create_task(other.hold(0.1, 30.0))
        await asyncio.to_thread(look)
        driving.cancel()


@pytest.mark.variations(3)
@pytest.mark.parametrize("where", ["map", "limit", "tab-drive"])
def test_a_second_finger_anywhere_releases_the_stick(page: Phone, where: str) -> None:
    page.hold()
    page.browser.tap(where)
    page.shows("hint", "use one finger to drive")
    page.bus.at_rest()


def test_releasing_the_left_mouse_button_while_another_is_held_releases_the_stick(
    page: Phone,
) -> None:
    """While another mouse button is down, the browser sends no `pointerup` for the left one."""
    browser, bus = page.browser, page.bus
    browser.size(*DESKTOP, touch=False)
    x, y = browser.middle("stick")

    def mouse(kind: str, dy: float = 0.0, button: str = "none", buttons: int = 1) -> None:
        event = {"type": f"mouse{kind}", "button": button, "buttons": buttons, "clickCount": 1}
        browser.ask("Input.dispatchMouseEvent", x=x, y=y - dy, **event)

    def drives() -> bool:
        """Return whether the robot drives. Press the stick again if the page has released it."""
        if not browser.js("document.getElementById('stick').matches('.held')"):
            mouse("Released", button="left", buttons=0)
            mouse("Pressed", button="left")
            mouse("Moved", 90)
        return bool((bus.state()["linear"] or 0.0) > 0.15)

    until(drives, 10.0, "it drives")
    mouse("Pressed", 90, "right", 3)
    mouse("Released", 90, "left", 2)
    try:
        bus.at_rest()
    finally:
        mouse("Released", 90, "right", 0)
    page.shows("hint", "another button is down")


JAM = """(() => {
    const send = WebSocket.prototype.send;
    window.sent = [];
    WebSocket.prototype.send = function (text) {
        window.sent.push([performance.now(), text]);
        send.call(this, text);
    };
    Object.defineProperty(WebSocket.prototype, 'bufferedAmount', {get: () => 1e6});
})();1"""
"""A network that accepts nothing for now. The page's writes to it are logged."""


def test_the_zero_of_a_released_stick_is_sent_twice_also_over_a_congested_socket(
    page: Phone,
) -> None:
    """The page repeats the zero after 50 ms.

    A daemon that reads late may drop a zero that closely follows another command.
    """
    page.hold()
    page.browser.js(JAM)
    page.browser.touch("End")
    page.bus.at_rest()
    sent = [(at, json.loads(message)) for at, message in page.browser.js("window.sent")]
    commands = [(at, message["cmd"]["linear_x"]) for at, message in sent if "cmd" in message]
    assert [speed for _, speed in commands] == [0, 0]
    assert commands[1][0] - commands[0][0] >= 49.0


def test_a_page_that_is_hidden_sends_its_zero_once(page: Phone) -> None:
    """A hidden page does not repeat the zero, because its timers run late.

    Another client may drive by then.
    """
    page.hold()
    page.browser.js(JAM)
    page.browser.js(
        "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    page.bus.at_rest()
    sent = [json.loads(message) for _, message in page.browser.js("window.sent")]
    assert [message["cmd"]["linear_x"] for message in sent if "cmd" in message] == [0]


LOCKS = """
(() => {
  const ask = navigator.wakeLock.request.bind(navigator.wakeLock);
  window.locks = [];
  navigator.wakeLock.request = async (kind) => {
    const lock = await ask(kind);
    window.locks.push(lock);
    return lock;
  };
})();1
"""


@pytest.mark.skipif(not HAS_WINDOWS, reason="needs the whole chromium")
@pytest.mark.nightly
def test_the_screen_stays_on_while_the_stick_is_held_and_no_longer(page: Phone) -> None:
    browser = page.browser
    browser.js(LOCKS)
    page.hold()
    until(lambda: browser.js("locks.map(one => one.released)") == [False], 5.0, "it is kept on")
    browser.touch("End")
    until(lambda: browser.js("locks.map(one => one.released)") == [True], 5.0, "and no longer")
    page.bus.at_rest()


def viewers(page: Phone) -> int:
    """Return the number of open pages that the page's server counts."""
    _, text = asyncio.run(answer(f"{page.server.here}/metrics"))
    return int(re.findall(r"^acsard_page_viewers\{.*\} (\d+)(?:\.0)?$", text, re.MULTILINE)[0])


@pytest.mark.nightly
@alone
def test_a_page_disconnects_when_it_is_left_and_reconnects_after_going_back(
    page: Phone,
) -> None:
    """The browser keeps a page that a person has left, so the page itself must disconnect."""
    browser = page.browser
    assert viewers(page) == 1
    left = time.monotonic()
    browser.open("about:blank")
    until(lambda: viewers(page) == 0, 5.0, "no page is open")
    assert time.monotonic() - left < PING_INTERVAL_S, "the server had to find out"
    browser.js("history.back()")
    page.shows("age", "live")
    page.shows("mode", "READY")
    assert viewers(page) == 1
    page.hold()
    browser.touch("End")
    page.bus.at_rest()
