"""The page shows the right words and buttons in each state, and hides buttons without a state."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.machine.authority import Authority
from tests.system.browser import NAME, TRUSTING, Page
from tests.system.camera_stream import Stream
from tests.system.chromium import CHROMIUM, PHONE, SETTLED_S, SIDEWAYS, Browser, browsing
from tests.system.harness import PLAIN, Bus, Daemon, Peer, Tables, running, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

HIDDEN = "document.getElementById('clear').hidden"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing(options=TRUSTING) as browser:
        browser.size(*PHONE)
        yield browser
        browser.open("about:blank")


def shows(browser: Browser, name: str, words: str) -> None:
    """Wait until the element with this id contains the words."""
    until(lambda: words in browser.text(name), 8.0, f"{name} says {words!r}")


def forgets(browser: Browser, within_s: float) -> None:
    """Wait until the page no longer shows a message about a button press."""
    until(lambda: browser.text("complaint") == "", within_s, "the complaint is outdated")


def test_a_page_that_has_not_shown_a_stop_does_not_release_it(
    tmp_path: Path, browser: Browser
) -> None:
    """Stop the robot while the page has no connection. The page then offers no release at first.

    Another person may have had a reason for that stop.
    """
    with running(tmp_path) as (daemon, bus):
        with Page(daemon, tmp_path) as page:
            browser.open(page.here)
            shows(browser, "mode", "READY")
            bus.get("srv/stop")
            shows(browser, "mode", "STOPPED")
            assert browser.js(HIDDEN) is False
        shows(browser, "mode", "NO CONNECTION")
        assert browser.js(HIDDEN) is True
        bus.get("srv/stop")
        time.sleep(2.1)  # from then on, the daemon takes a clear that names no stop
        daemon.signal(signal.SIGSTOP)
        try:
            with Page(daemon, tmp_path, "--address", page.here):
                shows(browser, "mode", "NO DATA")
                assert browser.js(HIDDEN) is True
                for button in ("clear", "activate"):
                    browser.js(f"document.getElementById({button!r}).click()")
                daemon.signal(signal.SIGCONT)
                shows(browser, "mode", "STOPPED")
                assert browser.js(HIDDEN) is False
                until(lambda: not browser.js(GREYED), 5.0, "the state is fresh")
                assert browser.text("complaint") == ""
                time.sleep(SETTLED_S)
                browser.js("document.getElementById('clear').click()")
                shows(browser, "mode", "READY")
        finally:
            daemon.signal(signal.SIGCONT)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Daemon, Bus, Peer, Page]]:
    where = tmp_path_factory.mktemp("words")
    with (
        Peer(where / "mcu") as board,
        Daemon(where, board.path) as daemon,
        Bus(daemon.endpoint) as bus,
        Page(daemon, where) as page,
    ):
        bus.linked()
        yield daemon, bus, board, page


@pytest.fixture
def page(robot: tuple[Daemon, Bus, Peer, Page], browser: Browser) -> Page:
    """Clear all latches and open the page of the ready robot."""
    for service in ("srv/clear", "srv/activate"):
        robot[1].ask(service)
    browser.size(*PHONE)
    browser.open(robot[3].here)
    shows(browser, "mode", "READY")
    return robot[3]


@pytest.mark.parametrize("first", ["the other stop", "this stop"])
def test_a_stop_without_an_answer_is_sent_again_although_another_client_stopped_the_robot(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page], first: str
) -> None:
    """The page repeats its own STOP until the robot answers.

    Otherwise a person who releases the other client's stop would also release the robot for this
    user, who has pressed STOP.
    """
    bus = robot[1]
    if first == "the other stop":
        bus.get("srv/stop")
        shows(browser, "mode", "STOPPED")
    browser.js(
        "window.sent = 0;"
        "stopping.send = async () => (sent++, {ok: false, lost: true, text: 'no answer'});"
        "stopping.press(); 0"
    )
    if first == "this stop":
        bus.get("srv/stop")
        shows(browser, "mode", "STOPPED")
    before = browser.js("sent")
    until(lambda: browser.js("sent") > before + 2, 5.0, "the page sends STOP again")
    assert "STOP is not confirmed" in browser.text("alarm")
    browser.release()
    shows(browser, "mode", "READY")
    until(lambda: browser.text("alarm") == "", 5.0, "the operator has released the stop")


def clicked(browser: Browser, name: str, times: int = 1) -> None:
    """Click the element with a script, so that it need not be visible on the screen."""
    browser.js("; ".join([f"document.getElementById({name!r}).click()"] * times))


def test_the_alarm_calls_a_stop_unconfirmed_until_the_robot_has_answered_one(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    bus = robot[1]
    browser.js("window.send = stopping.send; stopping.send = () => new Promise(() => {}); 0")
    browser.js("stopping.press(); stopping.over()")
    shows(browser, "alarm", "STOP was not confirmed")
    clicked(browser, "reset")
    shows(browser, "set-answer", "pose is x 0")
    clicked(browser, "deactivate")
    shows(browser, "mode", "INACTIVE")
    bus.get("srv/stop")
    shows(browser, "mode", "STOPPED")
    clicked(browser, "clear", times=2)
    shows(browser, "complaint", "pressed twice")
    shows(browser, "alarm", "STOP was not confirmed")
    bus.get("srv/clear")
    shows(browser, "mode", "INACTIVE")
    forgets(browser, 5.0)
    shows(browser, "alarm", "STOP was not confirmed")
    browser.js("stopping.send = send; 0")
    browser.tap("stop")
    until(lambda: browser.text("alarm") == "", 5.0, "the robot has answered")
    for mode in ("INACTIVE", "READY"):
        browser.release()
        shows(browser, "mode", mode)


CORNER = """(b => [b.x + 40, b.y + b.height / 2])(
    document.getElementById('stop').getBoundingClientRect())"""
"""The part of STOP at whose place the button that releases STOP appears."""


def test_a_tap_at_the_place_of_stop_leaves_the_alarm_of_a_stop_that_still_waits(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    bus, corner = robot[1], browser.js(CORNER)
    browser.js(
        "window.sent = 0; window.send = stopping.send; stopping.send = () => sent++"
        " ? new Promise(() => {})"
        " : Promise.resolve({ok: false, lost: true, text: 'no answer'}); 0"
    )
    browser.touch("Start", corner)
    browser.touch("End")
    shows(browser, "alarm", "STOP is not confirmed")
    bus.get("srv/stop")
    shows(browser, "mode", "STOPPED")
    browser.touch("Start", corner)
    browser.touch("End")
    shows(browser, "complaint", "This button has just appeared")
    shows(browser, "alarm", "STOP is not confirmed")
    bus.get("srv/clear")
    shows(browser, "mode", "READY")
    forgets(browser, 5.0)
    shows(browser, "alarm", "STOP is not confirmed")


MUTE = """(() => {
    const parse = JSON.parse;
    JSON.parse = (text) => {
        const message = parse(text);
        return window.mute && message.key === 'state' ? {} : message;
    };
})(); 0"""
"""Drops the states of the robot while `mute` is true."""

GREYED = "document.getElementById('clear').disabled"


def test_a_gap_between_two_states_greys_the_release_button_and_does_not_restart_its_second(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    bus = robot[1]

    def gap(*services: str) -> None:
        """Call these services while the page receives no state; check its grey release button."""
        place = browser.middle("stop")
        browser.js("window.mute = true")
        for service in services:
            bus.get(service)
        until(lambda: browser.js(GREYED) or browser.js(HIDDEN), 5.0, "the state is old")
        assert browser.js(HIDDEN) is False
        assert browser.middle("stop") == place
        browser.tap("clear")
        assert browser.text("clear") == "Release STOP"
        browser.js("window.mute = false")
        until(lambda: not browser.js(GREYED), 5.0, "a state arrives")
        browser.tap("clear")

    browser.js(MUTE)
    bus.get("srv/stop")
    shows(browser, "clear", "Release STOP")
    time.sleep(SETTLED_S)
    gap("srv/stop")
    shows(browser, "complaint", "This button has just appeared or changed")
    assert bus.state()["mode"] == "stopped"
    time.sleep(SETTLED_S)
    gap()
    shows(browser, "mode", "READY")
    assert browser.text("complaint") == ""


def test_switch_on_is_beside_stop_and_only_offered_while_the_robot_is_off(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    def off(name: str) -> bool:
        return bool(browser.js(f"document.getElementById({name!r}).disabled"))

    assert (off("activate"), off("deactivate")) == (True, False)  # the robot is on
    robot[1].get("srv/deactivate")
    shows(browser, "clear", "Switch on")
    assert (off("activate"), off("deactivate")) == (False, True)
    shows(browser, "reason", "switched off by unnamed")
    browser.release()
    shows(browser, "mode", "READY")
    until(lambda: off("activate"), 5.0, "the robot is on")
    robot[1].get("srv/stop")
    shows(browser, "mode", "STOPPED")
    assert (off("activate"), off("deactivate")) == (True, True)


def stopped_while_off(bus: Bus, browser: Browser) -> None:
    """Deactivate and stop the robot, and wait until the page accepts a press of "Release STOP"."""
    bus.get("srv/deactivate")
    bus.get("srv/stop")
    shows(browser, "clear", "Release STOP")
    browser.settle()


def twice(browser: Browser, name: str, pause_s: float) -> None:
    """Double-click the middle of the element, with a pause between the clicks."""
    x, y = browser.middle(name)
    for count in (1, 2):
        for kind, buttons in (("mousePressed", 1), ("mouseReleased", 0)):
            where = {"x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": count}
            browser.ask("Input.dispatchMouseEvent", type=kind, **where)
        time.sleep(pause_s if count == 1 else 0.0)


@pytest.mark.parametrize("pause_s", [0.0, 0.25, 0.8])
def test_a_double_click_releases_only_what_the_button_said_before(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page], pause_s: float
) -> None:
    bus = robot[1]
    stopped_while_off(bus, browser)
    twice(browser, "clear", pause_s)
    shows(browser, "clear", "Switch on")
    time.sleep(0.5)
    assert bus.state()["mode"] == "inactive"
    browser.release()
    shows(browser, "mode", "READY")


def test_taps_at_the_place_of_stop_do_not_release_it(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    corner = browser.js(CORNER)
    for _ in range(4):
        browser.touch("Start", corner)
        browser.touch("End")
        time.sleep(0.4)
    assert robot[1].state()["mode"] == "stopped"
    shows(browser, "complaint", "This button has just appeared or changed, or was pressed")
    forgets(browser, 15.0)
    assert browser.text("mode") == "STOPPED"
    browser.release()
    shows(browser, "mode", "READY")
    assert browser.text("complaint") == ""


def test_a_held_enter_key_releases_only_what_the_button_said_before(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    bus = robot[1]
    stopped_while_off(bus, browser)
    browser.js("document.getElementById('clear').focus()")
    enter = {"code": "Enter", "key": "Enter", "text": "\r", "windowsVirtualKeyCode": 13}
    for n in range(8):
        browser.ask("Input.dispatchKeyEvent", type="keyDown", autoRepeat=n > 0, **enter)
        time.sleep(0.2)
    browser.ask("Input.dispatchKeyEvent", type="keyUp", **enter)
    shows(browser, "clear", "Switch on")
    assert bus.state()["mode"] == "inactive"
    time.sleep(SETTLED_S)
    browser.ask("Input.dispatchKeyEvent", type="keyDown", **enter)
    browser.ask("Input.dispatchKeyEvent", type="keyUp", **enter)
    shows(browser, "mode", "READY")


def test_a_stop_during_a_fault_says_that_it_stays_latched_after_the_fault(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page]
) -> None:
    _, bus, board, _ = robot
    usual, board.reply = board.reply, lambda speeds: PLAIN((99.0, 99.0, 99.0, 99.0))
    try:
        shows(browser, "mode", "FAULT")
        browser.tap("stop")
        shows(browser, "complaint", "STOP is latched, too")
    finally:
        board.reply = usual
    shows(browser, "hint", "Press Release fault first")
    browser.release()
    shows(browser, "mode", "STOPPED")
    assert browser.text("complaint") == ""
    browser.release()
    shows(browser, "mode", "READY")
    assert bus.state()["mode"] == "ready"


PARTS = """['map', 'erase', 'where'].map(
    name => document.getElementById(name).getBoundingClientRect()).map(
    box => [box.left, box.top, box.right, box.bottom].map(Math.round))"""

DRAWN = """(() => {
    const map = document.getElementById('map'), {left, top} = map.getBoundingClientRect();
    const data = map.getContext('2d').getImageData(0, 0, map.width, map.height).data;
    const style = getComputedStyle(document.documentElement).getPropertyValue('COLOUR').trim();
    const wanted = [1, 3, 5].map(at => parseInt(style.slice(at, at + 2), 16)), found = [];
    const share = map.clientHeight / map.height;
    for (let n = 0; n < data.length; n += 4)
        if (wanted.every((one, at) => data[n + at] === one))
            found.push([left + (n / 4 % map.width) * share,
                        top + Math.floor(n / 4 / map.width) * share]);
    const [xs, ys] = [0, 1].map(at => found.map(one => one[at]));
    return [xs, ys].flatMap(all => [Math.min(...all), Math.max(...all)]);
})()"""
"""The left, right, upper and lower end of the shapes in this colour on the map, px."""


@pytest.mark.parametrize("size", [PHONE, SIDEWAYS], ids=["phone", "sideways"])
def test_the_map_shows_the_robot_and_its_direction_beside_the_buttons_and_a_scale(
    page: Page, browser: Browser, robot: tuple[Daemon, Bus, Peer, Page], size: tuple[int, int]
) -> None:
    robot[1].get("srv/set_pose", {"x": 0.0, "y": 0.0, "yaw": 0.0})
    browser.size(*size)
    shows(browser, "where", "x 0.00 m · y 0.00 m · 0°")
    (left, _, right, _), (_, _, _, tools), (_, words, _, bottom) = browser.js(PARTS)
    middle = (left + right) / 2

    def erased() -> bool:
        # The server may send the path of earlier tests after the first state.
        browser.js("document.getElementById('erase').click()")
        west = browser.js(DRAWN.replace("COLOUR", "--accent"))[0]
        return bool(west == pytest.approx(middle - 13, abs=4.0))

    until(erased, 5.0, "the map shows the robot alone")
    west, east, north, south = browser.js(DRAWN.replace("COLOUR", "--accent"))
    assert (north + south) / 2 == pytest.approx((tools + words) / 2, abs=5.0)
    assert east == pytest.approx(middle + 83, abs=8.0)  # the end of the dashed ray
    west, east, north, south = browser.js(DRAWN.replace("COLOUR", "--ink"))
    assert left < west < east < left + 70  # a bar of 45 px says 0.5 m
    assert words - 30 < north < south < bottom


SHOWN = "!!document.getElementById({!r}).checkVisibility()"


@pytest.mark.nightly
def test_a_pressed_emergency_stop_or_bumper_and_a_low_battery_are_shown_with_the_remedy(
    tmp_path: Path, browser: Browser
) -> None:
    """The page refuses a press of "Release STOP" and says what the operator must do first."""

    def says(status: bytes) -> None:
        board.reply = lambda speeds: PLAIN(speeds) + b"!status %b\r\n" % status

    low: Tables = {"battery": {"measure": "percent", "warning_below": 30.0}}
    visibility = SHOWN.format("estop")
    with (
        Peer(tmp_path / "mcu") as board,
        Daemon(tmp_path, board.path, config=low) as daemon,
        Bus(daemon.endpoint) as bus,
        Page(daemon, tmp_path) as page,
    ):
        says(b"estop=ok")
        bus.linked()
        browser.open(page.here)
        shows(browser, "mode", "READY")
        assert [browser.js(SHOWN.format(name)) for name in ("estop", "battery")] == [False, False]
        says(b"estop=ok volts=22.50 charge=21%")
        shows(browser, "battery", "21 %")
        shows(browser, "doubt", "The battery is low.")
        browser.js("document.getElementById('tab-status').click()")
        assert browser.js(SHOWN.format("volts"))
        legend = "document.querySelector('#volts .legend').textContent"
        until(lambda: browser.js(legend) == "voltage 22.50", 5.0, "the plot")
        browser.js("document.getElementById('tab-drive').click()")
        says(b"estop=pressed")
        shows(browser, "mode", "STOPPED")
        shows(browser, "reason", "emergency stop pressed at the robot")
        assert browser.js(visibility)
        assert browser.text("estop") == "⬢ E-STOP"
        shows(browser, "hint", "Emergency stop: release it at the robot first.")
        browser.release()
        shows(browser, "complaint", "release it at the robot, then")
        says(b"estop=ok")
        until(lambda: not browser.js(visibility), 5.0, "the button is released")
        shows(browser, "hint", "Stopped. Press Release STOP first.")
        browser.release()
        shows(browser, "mode", "READY")
        says(b"estop=ok bumpers=.X")
        shows(browser, "mode", "STOPPED")
        shows(browser, "reason", "bumper 2 pressed")
        shows(browser, "doubt", "bumper 2 pressed")
        browser.open("about:blank")


@pytest.mark.nightly
def test_a_viewer_reads_who_can_activate_and_a_revoked_token_ends_stop_and_camera(
    tmp_path: Path, browser: Browser
) -> None:
    stream = Stream()
    Authority.make(tmp_path / "tls", "test", 1, [NAME]).issue(tmp_path / "tls", "robot", [NAME], 1)
    config = {"web": {"camera": f"http://127.0.0.1:{stream.port}/stream"}}
    with running(tmp_path, config=config) as (daemon, bus), Page(daemon, tmp_path) as page:
        browser.open(f"{page.away}/#token={page.invite('viewer', 'tv')}")
        shows(browser, "role", "viewer")
        bus.get("srv/deactivate")
        shows(browser, "reason", "an operator switches it on")
        bus.get("srv/activate")
        shows(browser, "mode", "READY")
        page.vault.revoke("tv")
        shows(browser, "mode", "NO CONNECTION")
        shows(browser, "hint", "No connection.")
        red = "getComputedStyle(document.getElementById('stop')).backgroundColor"
        until(lambda: browser.js(red) != "rgb(196, 18, 10)", 5.0, "STOP is grey")
        time.sleep(1.0)
        before = sum(page.refused().values())
        time.sleep(2.0)
        assert sum(page.refused().values()) - before <= 1.0
        browser.tap("stop")
        shows(browser, "alarm", "STOP needs an invitation to this page")
        browser.open(f"{page.away}/#token={page.invite('operator', 'phone')}")
        shows(browser, "role", "operator")
        assert browser.js(red) == "rgb(196, 18, 10)"
    stream.close()
