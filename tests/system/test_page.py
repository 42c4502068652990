"""The robot's page in a real browser shows, stops and drives the robot."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from acsard.machine.authority import Authority
from acsard.web.viewer import PING_INTERVAL_S
from tests.system.browser import NAME, TRUSTING, Page, answer, hands
from tests.system.chromium import (
    CHROMIUM,
    DESKTOP,
    HAS_WINDOWS,
    PHONE,
    SIDEWAYS,
    Browser,
    browsing,
)
from tests.system.harness import Bus, Daemon, Peer, until
from tests.tools import pictures
from tests.tools.pictures import VIEWS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


class Phone:
    """A daemon, its page in a phone's browser, and another client on the bus."""

    def __init__(self, daemon: Daemon, bus: Bus, server: Page, browser: Browser) -> None:
        self.daemon, self.bus, self.server, self.browser = daemon, bus, server, browser

    def shows(self, name: str, words: str) -> None:
        """Wait until the element with this id contains the words."""
        said = ""

        def look() -> bool:
            nonlocal said
            said = self.browser.text(name)
            return words in said

        try:
            until(look, 5.0, f"{name} says {words!r}")
        except AssertionError as error:
            raise AssertionError(f"{error}; it says {said!r}") from None

    def hold(self) -> None:
        """Drive forwards with a finger on the stick."""
        self.browser.hold(lambda: (self.bus.state()["linear"] or 0.0) > 0.15)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing() as browser:
        yield browser


class Robot(NamedTuple):
    """A daemon with its link up, a client on its bus, and its page."""

    daemon: Daemon
    bus: Bus
    server: Page


@contextmanager
def running(where: Path) -> Iterator[Robot]:
    """Run a robot and its page."""
    with Daemon(where) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        with Page(daemon, where) as server:
            yield Robot(daemon, bus, server)


@pytest.fixture(scope="module")
def common_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """The robot for all tests that change only its latch. Starting it takes 1 s."""
    with running(tmp_path_factory.mktemp("common")) as robot:
        yield robot


@pytest.fixture
def own_robot(tmp_path: Path) -> Iterator[Robot]:
    with running(tmp_path) as robot:
        yield robot


alone = pytest.mark.usefixtures("own_robot")
"""Gives a test a new robot.

The test ends or suspends a process, changes a setting, counts, or looks at a history.
"""


@pytest.fixture
def page(request: pytest.FixtureRequest, browser: Browser) -> Iterator[Phone]:
    """The newly opened page of a robot that is at rest and may be driven."""
    own = "own_robot" in request.fixturenames
    robot: Robot = request.getfixturevalue("own_robot" if own else "common_robot")
    page = Phone(*robot, browser)
    robot.bus.ask("srv/clear")
    robot.bus.ask("srv/activate")
    robot.bus.at_rest()
    browser.size(*PHONE)
    browser.said.clear()
    browser.open(robot.server.here)
    page.shows("mode", "READY")
    page.shows("age", "live")
    yield page
    browser.lift()
    browser.open("about:blank")


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


@alone
@pytest.mark.nightly
def test_without_a_connection_stop_and_settings_are_grey_and_the_page_says_why(page: Phone) -> None:
    browser = page.browser
    browser.tap("tab-set")
    browser.js("document.getElementById('reset').click()")
    page.shows("set-answer", "pose is x 0")
    until(lambda: browser.js(SETTINGS), 5.0, "the settings can be changed")
    assert browser.js(RED)
    page.server.process.kill()
    page.shows("age", "no connection")
    page.shows("barred", "nothing can be changed now")
    assert not browser.js(SETTINGS)
    assert browser.js("document.getElementById('reset').disabled")
    page.shows("doubt", "STOP may not reach the robot from here")
    assert not browser.js(RED)


def test_keys_drive_while_they_are_held(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    browser.key("Down", "KeyW", "w")
    until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "forwards")
    browser.key("Down", "ArrowLeft", "ArrowLeft")
    until(lambda: (bus.state()["angular"] or 0.0) > 0.15, 10.0, "and left")
    browser.key("Up", "KeyW", "w")
    until(lambda: (speed := bus.state()["linear"]) is not None and abs(speed) < 0.02, 10.0, "left")
    browser.key("Up", "ArrowLeft", "ArrowLeft")
    bus.at_rest()


def pressed(browser: Browser, code: str, number: int) -> None:
    """Press a key, with its effect on the focused element."""
    for kind in ("rawKeyDown", "keyUp"):
        browser.ask(
            "Input.dispatchKeyEvent", type=kind, code=code, key=code, windowsVirtualKeyCode=number
        )


LIMIT = "document.getElementById('limit').value"


def test_keys_drive_after_the_slider_was_set_and_leave_it_where_it_is(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    before = browser.js(LIMIT)
    x, y = browser.middle("limit")
    for kind in ("mousePressed", "mouseReleased"):
        browser.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    until(lambda: browser.js(LIMIT) != before, 5.0, "it is set")
    chosen = browser.js(LIMIT)
    try:
        browser.ask(
            "Input.dispatchKeyEvent", type="rawKeyDown", code="ArrowUp", key="ArrowUp",
            windowsVirtualKeyCode=38,
        )  # fmt: skip
        fast = float(chosen) - 0.05
        until(lambda: (bus.state()["linear"] or 0.0) > fast, 10.0, "forwards, as fast")
    finally:
        browser.key("Up", "ArrowUp", "ArrowUp")
    bus.at_rest()
    assert browser.js(LIMIT) == chosen
    assert browser.text("most") == f"{float(chosen):.2f} m/s"


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


PAD = """navigator.getGamepads = () => [{index: 0, connected: true, axes: AXES,
    mapping: 'standard',
    buttons: Array.from({length: 16}, (_, n) => ({pressed: n === 5 && HELD}))}]"""


def test_a_key_released_while_another_element_has_the_focus_stops_the_robot(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    for leave in ("document.getElementById('limit').focus()", "0"):
        browser.js("document.activeElement.blur()")
        browser.key("Down", "KeyW", "w")
        until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "forwards")
        browser.js(leave)
        browser.ask("Input.dispatchKeyEvent", type="keyUp", code="KeyW", key="w", modifiers=2)
        bus.at_rest()
        assert browser.js("document.getElementById('stick').matches('.held')") is False


@pytest.mark.variations(3)
@pytest.mark.parametrize("other", ["MetaLeft", "menu", "drag"])
def test_a_key_is_released_if_the_system_may_swallow_its_key_up_event(
    page: Phone, other: str
) -> None:
    browser, bus = page.browser, page.bus
    browser.key("Down", "KeyW", "w")
    until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "forwards")
    if other == "menu":
        browser.js("window.dispatchEvent(new MouseEvent('contextmenu'))")
    elif other == "drag":
        browser.js("document.querySelector('.help').dispatchEvent(new DragEvent('dragstart'))")
    else:
        browser.ask(
            "Input.dispatchKeyEvent", type="rawKeyDown", code=other, key="Meta", modifiers=4
        )
    bus.at_rest()
    assert browser.js("document.getElementById('stick').matches('.held')") is False
    browser.key("Up", "KeyW", "w")


def test_a_key_that_was_pressed_while_driving_was_impossible_does_not_drive_later(
    page: Phone,
) -> None:
    """The browser may never report the release of that key, for example while Meta is down."""
    browser, bus = page.browser, page.bus
    bus.ask("srv/stop")
    page.shows("mode", "STOPPED")
    browser.key("Down", "KeyW", "w")
    bus.ask("srv/clear")
    page.shows("mode", "READY")
    browser.key("Down", "KeyA", "a")
    until(lambda: (bus.state()["angular"] or 0.0) > 0.15, 10.0, "it turns")
    assert abs(bus.state()["linear"]) < 0.02
    browser.key("Up", "KeyA", "a")
    bus.at_rest()
    assert browser.js("document.getElementById('stick').matches('.held')") is False


@alone
def test_a_stop_that_fails_raises_the_alarm_in_every_view(page: Phone) -> None:
    page.browser.tap("tab-events")
    page.server.process.kill()
    page.shows("age", "no connection")
    page.browser.tap("stop")
    page.shows("alarm", "STOP is not confirmed. This page sends it again")


def test_a_gamepad_drives_while_a_shoulder_button_is_held(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    pad = PAD.replace("AXES", "[0, -1, 0, 0]")
    browser.js(pad.replace("HELD", "false") + ";1")
    browser.js("new Promise(done => setTimeout(done, 200))")
    assert bus.state()["source"] == ""
    browser.js(pad.replace("HELD", "true") + ";1")
    until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "it drives")
    browser.js(pad.replace("HELD", "false") + ";1")
    bus.at_rest()


PADS = """(async () => {
    const seen = [];
    for (const pads of [PADS]) {
        navigator.getGamepads = () => pads.map(([index, held]) => ({
            index, connected: true, mapping: 'standard', axes: [0, -1, 0, 0],
            buttons: Array.from({length: 16}, (_, n) => ({pressed: n === 5 && held}))}));
        await new Promise((done) => setTimeout(done, 300));
        seen.push(HELD);
    }
    return seen;
})()"""
"""Connects lists of gamepads, one after the other, each as its index and whether its shoulder
button is down. Reports for each list whether a gamepad holds the stick."""


@pytest.mark.parametrize(
    ("pads", "holds"),
    [
        ("[[0, false]], [[0, true]], [], [[0, true]]", [False, True, False, False]),
        ("[[0, true]], [[0, false]], [[0, true]]", [False, False, True]),
        ("[[0, false], [1, true]], [[1, true]]", [False, False]),
        (
            "[[0, false], [1, false]], [[0, true], [1, true]], [[1, true]], [[1, false]], "
            "[[1, true]]",
            [False, True, False, False, True],
        ),
    ],
    ids=["lost and back", "connected while held", "another is lost", "another took its place"],
)
def test_a_gamepad_drives_only_after_a_press_that_begins_while_it_is_connected(
    page: Phone, pads: str, holds: list[bool]
) -> None:
    assert page.browser.js(PADS.replace("PADS", pads).replace("HELD", HELD)) == holds


def test_a_gamepad_that_disconnects_releases_the_stick(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    pad = PAD.replace("AXES", "[0, -1, 0, 0]")
    browser.js(pad.replace("HELD", "false") + ";1")
    browser.js("new Promise(done => setTimeout(done, 200))")
    browser.js(pad.replace("HELD", "true") + ";1")
    until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "it drives")
    # The gamepad's last values stay pressed, as when its battery is empty.
    browser.js("dispatchEvent(new Event('gamepaddisconnected'))")
    page.shows("hint", "the gamepad is disconnected")
    bus.at_rest()


def test_a_gamepad_that_the_browser_does_not_know_drives_nothing_and_says_so(page: Phone) -> None:
    pad = PAD.replace("AXES", "[0, -1, 0, 0]").replace("HELD", "true").replace("standard", "")
    commands = page.bus.count("commands")
    page.browser.js(pad + ";1")
    page.shows("hint", "This gamepad does not drive")
    assert page.bus.count("commands") == commands
    assert page.browser.js("document.getElementById('stick').matches('.held')") is False


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


@alone
def test_stale_values_are_grey_until_messages_return(page: Phone) -> None:
    page.hold()
    page.shows("mode", "DRIVING")
    page.daemon.signal(signal.SIGSTOP)
    try:
        page.shows("mode", "NO DATA")  # the page cannot know whether it still drives
        assert page.browser.js("document.body.classList.contains('stale')")
    finally:
        page.daemon.signal(signal.SIGCONT)
    page.browser.lift()
    page.shows("age", "live")
    page.shows("mode", "READY")
    assert page.browser.text("doubt") == ""
    assert not page.browser.js("document.body.classList.contains('stale')")


@alone
def test_a_page_opened_while_the_daemon_is_silent_waits_and_shows_no_measurements(
    page: Phone,
) -> None:
    """The page's server still has the last `state`, but the page must not show its old values."""
    browser = page.browser
    page.daemon.signal(signal.SIGSTOP)
    try:
        page.shows("reason", "nothing is received from the daemon")
        browser.open(page.server.here)
        page.shows("reason", "nothing is received from the daemon")
        browser.js("new Promise(done => setTimeout(done, 500))")  # more than one poll
        texts = [browser.text(name) for name in ("mode", "age", "speed", "turn", "who")]
        assert texts == ["NO DATA", "waiting", "–", "–", "–"]
        assert not browser.js("document.body.classList.contains('stale')")
    finally:
        page.daemon.signal(signal.SIGCONT)
    page.shows("age", "live")
    page.shows("mode", "READY")
    page.shows("speed", "0.00 m/s")
    page.shows("speed-command", "command 0.00")


HELD = "document.getElementById('stick').matches('.held')"


def colour(browser: Browser, name: str) -> str:
    """Return the colour of an element's text."""
    return str(browser.js(f"getComputedStyle(document.getElementById({name!r})).color"))


def greyed(browser: Browser) -> bool:
    """Return whether the stick is drawn as inactive."""
    return bool(browser.js("document.getElementById('stick').ariaDisabled === 'true'"))


def test_a_pulled_cable_greys_the_pose_until_it_is_back(
    tmp_path: Path, peer: Peer, browser: Browser
) -> None:
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        Page(daemon, tmp_path) as server,
    ):
        bus.linked()
        page = Phone(daemon, bus, server, browser)
        browser.size(*PHONE)
        browser.open(server.here)
        page.shows("mode", "READY")
        before, pose = drawing(browser), colour(browser, "where")
        peer.unplug()
        page.shows("mode", "NO BOARD")
        grey = "getComputedStyle(document.getElementById('where')).fontStyle"
        assert browser.js(grey) == "italic"
        until(lambda: browser.js(DRAWN) != before, 5.0, "the robot on the map is grey")
        peer.plug()
        page.shows("mode", "READY")
        page.shows("age", "live")
        assert browser.js(grey) == "normal"
        assert colour(browser, "where") == pose
        until(lambda: browser.js(DRAWN) == before, 5.0, "the robot on the map is back")
        browser.open("about:blank")


def row(page: Phone, source: str) -> str:
    """Return the row of a source in the table."""
    rows = "[...document.querySelectorAll('#sources tr')].map(row => row.textContent)"
    return next((str(text) for text in page.browser.js(rows) if text.startswith(source)), "")


RED = "getComputedStyle(document.getElementById('stop')).backgroundColor === 'rgb(196, 18, 10)'"

SETTINGS = "[...document.querySelectorAll('#settings input')].some(one => one.matches(':enabled'))"

SET = """(() => {
    const button = document.querySelector('[aria-label="Set limits.linear_speed"]');
    if (!button) return false;
    button.parentElement.querySelector('input').value = '0,31';
    button.click();
    return true;
})()"""
"""Decimal comma, as people in many countries type it."""


@alone
def test_settings_and_activation_on_the_page_reach_the_robot(page: Phone) -> None:
    browser, bus = page.browser, page.bus
    browser.tap("tab-set")
    until(lambda: browser.js(SET), 5.0, "the setting is there")
    until(lambda: bus.get("config")["limits"]["linear_speed"] == 0.31, 5.0, "it is set")
    page.shows("set-answer", "0.31")
    browser.js("document.getElementById('deactivate').click()")
    page.shows("mode", "INACTIVE")
    browser.js("document.getElementById('activate').click()")
    page.shows("mode", "READY")


DRAWN = (
    "new Promise(done => setTimeout(() => done(document.getElementById('map').toDataURL()), 100))"
)
STEADY = 5
"""Number of looks, one every 100 ms, at which nothing has changed any more."""


def drawing(browser: Browser) -> str:
    """Wait until the map no longer changes, and return it.

    After the page opens, the robot's position and a disappearing banner still change it.
    """
    looks = [str(n) for n in range(STEADY)]

    def stands() -> bool:
        looks.append(browser.js(DRAWN))
        return len({*looks[-STEADY:]}) == 1

    until(stands, 5.0, "it stands")
    return looks[-1]


@pytest.mark.nightly
@alone
def test_the_map_zooms_in_and_out_and_can_follow_the_robot_again(page: Phone) -> None:
    """Each button changes the drawing, and the reverse button restores it."""
    browser = page.browser
    begun = drawing(browser)

    def drawn(changed: bool, what: str) -> None:
        until(lambda: (browser.js(DRAWN) != begun) is changed, 5.0, what)

    browser.tap("nearer")
    drawn(True, "nearer")
    browser.tap("farther")
    drawn(False, "as before")
    x, y = browser.middle("map")
    browser.touch("Start", (x, y))
    browser.touch("Move", (x + 50, y + 30))
    browser.touch("End")
    drawn(True, "moved")
    browser.js("document.getElementById('recentre').click()")
    drawn(False, "as before again")


@pytest.mark.nightly
@alone
def test_the_map_turns_with_the_robot_and_back(page: Phone) -> None:
    browser = page.browser
    page.bus.get("srv/set_pose", {"x": 0.0, "y": 0.0, "yaw": 1.0})
    page.shows("where", "57°")
    before = drawing(browser)
    browser.js("document.getElementById('turns').click()")
    until(lambda: browser.js(DRAWN) != before, 5.0, "it is turned")
    assert browser.js("document.getElementById('turns').ariaPressed") == "true"
    browser.js("document.getElementById('turns').click()")
    until(lambda: browser.js(DRAWN) == before, 5.0, "as before")


def test_the_dials_show_command_and_measurement_in_one_line_and_offer_degrees(page: Phone) -> None:
    browser = page.browser
    page.browser.push(0, 0, "Start")
    page.browser.push(-80, 0)
    page.shows("turn-command", "command 0.")
    high = "[...document.querySelectorAll('#speed, #turn')].map(one => one.offsetHeight)"
    wide = (
        "[...document.querySelectorAll('.dials > *')].map(one => one.scrollWidth - one.clientWidth)"
    )
    for size in ((320, 568), (360, 640), (568, 320), (667, 375), DESKTOP, SIDEWAYS, PHONE):
        browser.size(*size)
        assert max(browser.js(high)) < 40, size  # a second line would be 20 px more
        assert max(browser.js(wide)) <= 0, size
    browser.touch("End")
    page.shows("turn", "0.00 rad/s")
    browser.js("document.getElementById('unit').click()")
    assert browser.text("turn") == "0 °/s"
    browser.js("document.getElementById('unit').click()")
    assert browser.text("turn") == "0.00 rad/s"


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


SMALL, SMALL_SIDEWAYS = (375, 667), (667, 375)
SCREENS = [PHONE, SMALL, SIDEWAYS, SMALL_SIDEWAYS, DESKTOP]

BOXES = """['stick', 'stop', 'limit', 'hint', 'speed', 'mode', 'map'].map(name => {
    const box = document.getElementById(name).getBoundingClientRect();
    return [name, box.left, box.top, box.right, box.bottom];
})"""

PIECE_PX = 90
"""The least width and height of the path and of the stick, px."""


@pytest.mark.nightly
@pytest.mark.parametrize("size", SCREENS)
def test_stick_stop_speed_mode_and_path_fit_on_the_screen_beside_each_other(
    page: Phone, size: tuple[int, int]
) -> None:
    page.browser.size(*size, touch=size != DESKTOP)
    boxes = {name: tuple(box) for name, *box in page.browser.js(BOXES)}
    for name, (left, top, right, bottom) in boxes.items():
        assert left >= 0, name
        assert top >= 0, name
        assert right <= size[0], name
        assert bottom <= size[1], name
    for first, other in itertools.combinations(boxes, 2):
        a, b = boxes[first], boxes[other]
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (first, a, other, b)
    for name in ("map", "stick"):
        left, top, right, bottom = boxes[name]
        assert min(right - left, bottom - top) >= PIECE_PX, name
    # Nothing is hidden behind an edge that would need scrolling.
    more = "(one => one.scrollHeight - one.clientHeight)(document.querySelector('main'))"
    assert page.browser.js(more) <= 0
    page.bus.get("srv/deactivate")  # more words above and below the stick
    page.shows("hint", "Switched off")
    assert page.browser.js(more) <= 0
    page.bus.get("srv/stop")
    page.shows("hint", "Stopped")
    assert page.browser.js(more) <= 0
    for view in VIEWS:
        page.browser.js(f"document.getElementById('tab-{view}').click()")
        assert page.browser.js("document.documentElement.scrollWidth") <= size[0], view


@pytest.mark.nightly
def test_every_control_is_large_enough_for_a_finger_and_every_text_to_read(page: Phone) -> None:
    page.bus.get("srv/stop")
    page.shows("mode", "STOPPED")  # together with Release
    for size, view in itertools.product((PHONE, SIDEWAYS, SMALL_SIDEWAYS), VIEWS):
        page.browser.size(*size)
        pictures.show(page.browser, view)
        assert page.browser.too_small() == [], (size, view)
        assert page.browser.too_tiny() == [], (size, view)


@pytest.mark.nightly
def test_no_view_has_obstacles_for_a_screen_reader(page: Phone) -> None:
    looked = itertools.product((PHONE, SIDEWAYS, DESKTOP), (False, True), (False, True), VIEWS)
    for size, dark, stopped, view in looked:
        page.browser.size(*size, touch=size != DESKTOP, dark=dark)
        page.bus.get("srv/stop" if stopped else "srv/clear")
        page.shows("mode", "STOPPED" if stopped else "READY")
        page.browser.js(f"document.getElementById('tab-{view}').click()")
        assert page.browser.obstacles() == [], (size, dark, stopped, view)


OFF_THE_MAP = """[...document.querySelectorAll('.tools button')]
    .filter(one => one.checkVisibility())
    .map(one => [one.id, one.getBoundingClientRect()])
    .filter(([, box]) => box.bottom > document.getElementById('map').getBoundingClientRect().bottom)
    .map(([name]) => name)"""
"""The buttons of the map that cover something below it."""


@pytest.mark.nightly
def test_every_state_is_fit_for_a_screen_reader_and_the_map_keeps_its_buttons() -> None:
    states: list[str] = []

    def look(browser: Browser, state: str) -> None:
        for size, dark in itertools.product((PHONE, SIDEWAYS, DESKTOP), (False, True)):
            browser.size(*size, touch=size != DESKTOP, dark=dark)
            # The two styles differ in their colours alone, so the second one needs that rule alone.
            obstacles = browser.obstacles("color-contrast" if dark else "")
            assert obstacles == [], (state, size, dark)
            assert browser.js(OFF_THE_MAP) == [], (state, size, dark)
        states.append(state)

    pictures.states(look)
    assert len(states) == len(set(states)) > 20


SHOWN = """new MutationObserver(() => {
    const says = (id) => document.getElementById(id)?.textContent;
    if (says("mode") === "READY" && says("where"))
        requestAnimationFrame(() => setTimeout(() => window.shown ??= performance.now()));
}).observe(document, {subtree: true, childList: true, characterData: true})"""
"""Notes when mode and place of the robot are readable, ms after the address was opened."""


class PageLoad(NamedTuple):
    """The cost of opening a page once."""

    ms: float
    received: int

    @classmethod
    def at(cls, url: str, browser: Browser) -> PageLoad:
        browser.open("about:blank")
        before = browser.received
        browser.open(url)
        ms = until(lambda: browser.js("window.shown"), 10.0, f"something to see at {url}")
        return cls(ms, browser.received - before)


@alone
def test_the_first_visit_loads_little_and_the_second_one_less(page: Phone) -> None:
    with browsing() as browser:
        browser.size(*PHONE)
        browser.ask("Network.enable")
        browser.ask("Page.addScriptToEvaluateOnNewDocument", source=SHOWN)
        first, second = [PageLoad.at(page.server.here, browser) for _ in range(2)]
    print(
        f"\nfirst look {first.ms:4.0f} ms, {first.received / 1000:5.1f} kB; "
        f"second {second.ms:4.0f} ms, {second.received / 1000:5.1f} kB"
    )
    assert second.received < first.received <= 1_500_000


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


@alone
def test_untrusted_text_is_shown_without_being_rendered_as_html(page: Phone) -> None:
    evil = "<img src=x onerror=document.title='owned'>"
    page.bus.put(f"cmd/{'app'}", {"linear": {"x": evil}, "angular": {"z": 0}})
    page.browser.tap("tab-events")
    page.shows("happened", "refused")
    assert page.browser.js("document.querySelectorAll('#happened img').length") == 0
    assert page.browser.js("document.title") == "READY · acsar"


WORDS = """one => one.getAttribute('aria-describedby')?.split(' ')
    .map(name => document.getElementById(name).textContent).join(' ') ?? ''"""
"""The description of an element for a screen reader."""


def test_controls_that_a_viewer_may_not_use_are_disabled_and_say_why(tmp_path: Path) -> None:
    Authority.make(tmp_path / "tls", "test", 1, [NAME]).issue(tmp_path / "tls", "robot", [NAME], 1)
    settings = {"record": {"directory": str(tmp_path / "record")}}
    with Daemon(tmp_path, config=settings) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        with Page(daemon, tmp_path) as server, browsing(options=TRUSTING) as browser:
            page = Phone(daemon, bus, server, browser)
            browser.size(*PHONE)
            browser.open(f"{server.away}/#token={server.invite('viewer', 'tv')}")
            page.shows("role", "viewer")
            page.shows("mode", "READY")
            off = "one => [one.disabled || one.getAttribute('aria-disabled') === 'true', one.title]"
            controls = browser.js(f"[...document.querySelectorAll('[data-does]')].map({off})")
            assert len(controls) >= 6
            assert all(off and "your role is viewer" in why for off, why in controls), controls
            described = browser.js(f"[...document.querySelectorAll('[data-does]')].map({WORDS})")
            assert all("for operators; your role is viewer" in control for control in described)
            page.shows("barred", "for operators; your role is viewer")
            page.shows("hint", "You may watch and stop, but not drive")
            assert browser.js("document.getElementById('tab-set').checkVisibility()") is False
            browser.tap("tab-events")
            page.shows("recordings", "the download is for operators")
            assert browser.js("document.querySelectorAll('#recordings a').length") == 0
            browser.tap("stop")
            until(lambda: bus.state()["mode"] == "stopped", 5.0, "a viewer stops")
            page.shows("reason", "an operator releases it")


@alone
@pytest.mark.nightly
def test_curves_that_overlap_are_distinguishable_and_show_their_values(page: Phone) -> None:
    browser = page.browser
    browser.size(*DESKTOP, touch=False)
    browser.tap("tab-status")
    rows = "[...document.querySelectorAll('#plot-wheels + .legend > span')]"
    legend = f"{rows}.map(one => one.textContent)"
    values = r"^(front right|front left|rear left|rear right) .?\d+\.\d\d$"
    until(lambda: all(re.match(values, label) for label in browser.js(legend)), 10.0, "values")
    assert len(browser.js(legend)) == 4
    # At rest all four are zero: each has its colour somewhere on the line.
    until(lambda: browser.js(SEEN) == 4, 20.0, "four colours")


SEEN = """(() => {
    const canvas = document.getElementById('plot-wheels'), paper = canvas.getContext('2d');
    const {width, height} = canvas, style = getComputedStyle(document.documentElement);
    const {data} = paper.getImageData(0, 0, width, height), found = new Set();
    for (let n = 0; n < data.length; n += 4)
        if (data[n + 3] === 255) found.add([data[n], data[n + 1], data[n + 2]].join());
    const wanted = [0, 1, 2, 3].map(n => {
        paper.fillStyle = style.getPropertyValue(`--w${n}`).trim();
        const [, r, g, b] = /#(..)(..)(..)/.exec(paper.fillStyle);
        return [r, g, b].map(one => parseInt(one, 16)).join();
    });
    return new Set(wanted.filter(one => found.has(one))).size;
})()"""
