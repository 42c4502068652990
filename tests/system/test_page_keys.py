"""Keys and gamepads drive the robot while a person holds them, and never later."""

from __future__ import annotations

import pytest

from tests.system.chromium import (
    CHROMIUM,
)
from tests.system.harness import until
from tests.system.phone_page import HELD, Phone

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


@pytest.fixture
def page(phone: Phone) -> Phone:
    return phone


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


PAD = """navigator.getGamepads = () => [{index: 0, connected: true, axes: AXES,
    mapping: 'standard',
    buttons: Array.from({length: 16}, (_, n) => ({pressed: n === 5 && HELD}))}]"""


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
