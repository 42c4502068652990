"""The page shows what is known now, and grays what is not known or not allowed."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import NamedTuple

import pytest

from acsard.machine.authority import Authority
from tests.system.browser import NAME, TRUSTING, Page
from tests.system.chromium import (
    CHROMIUM,
    DESKTOP,
    PHONE,
    SIDEWAYS,
    Browser,
    browsing,
)
from tests.system.harness import Bus, Daemon, Peer, until
from tests.system.phone_page import RED, Phone, alone

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


@pytest.fixture
def page(phone: Phone) -> Phone:
    return phone


SETTINGS = "[...document.querySelectorAll('#settings input')].some(one => one.matches(':enabled'))"


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


@alone
def test_a_stop_that_fails_raises_the_alarm_in_every_view(page: Phone) -> None:
    page.browser.tap("tab-events")
    page.server.process.kill()
    page.shows("age", "no connection")
    page.browser.tap("stop")
    page.shows("alarm", "STOP is not confirmed. This page sends it again")


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


def colour(browser: Browser, name: str) -> str:
    """Return the colour of an element's text."""
    return str(browser.js(f"getComputedStyle(document.getElementById({name!r})).color"))


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
