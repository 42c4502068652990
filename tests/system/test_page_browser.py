"""The page in a real browser drives, stops and sets a robot, for a phone that was invited.

`unit/page_stories.js` has what the page decides and says. Here is what only a browser can break:
its touches, keys and clicks, its cookies, and its rules for scripts.
"""

from __future__ import annotations

import pytest

from acsard.cli import command_line
from tests.system.chromium import CHROMIUM
from tests.system.harness import until
from tests.system.phone_page import Phone, alone

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


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
