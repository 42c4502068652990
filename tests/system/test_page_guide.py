"""Checks and calibrations work in a real browser: questions, answers, stops and layout."""

from __future__ import annotations

import math
import os
import signal
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.core.config.parsing import parse
from tests.system.browser import Page
from tests.system.bystander import lost
from tests.system.chromium import CHROMIUM, DESKTOP, PHONE, SIDEWAYS, Browser, browsing
from tests.system.guided import NoDaemon, commands, none_left
from tests.system.harness import Bus, Daemon, running, until
from tests.system.test_calibrate import RIDES_S, SKIDDING

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]


class Person:
    """A person with a phone who has opened the page's view *Set*."""

    def __init__(self, browser: Browser, server: Page) -> None:
        self.browser, self.server = browser, server
        browser.size(*PHONE)
        browser.said.clear()
        browser.open(server.here)
        until(lambda: browser.text("robot") == "acsar", 5.0, "it is connected")
        self.click("tab-set")
        until(lambda: browser.js("document.querySelectorAll('#method option').length"), 5.0, "ways")

    def click(self, name: str) -> None:
        self.browser.js(f"document.getElementById({name!r}).click()")

    def shows(self, name: str, words: str, within: float = 10.0) -> None:
        try:
            until(lambda: words in self.browser.text(name), within, f"{name} says {words!r}")
        except AssertionError as error:
            texts = [self.browser.text(f"guide-{part}") for part in ("note", "doing", "story")]
            raise AssertionError(f"{error}: {texts}") from None

    def begin(self, what: str, **chosen: str) -> None:
        for name, value in chosen.items():
            self.browser.js(f"document.getElementById({name!r}).value = {value!r}")
        self.click(what)

    def check_question(self, words: str, within: float = 10.0) -> None:
        """Check that this is the current question, and that it has the focus."""
        self.shows("guide-words", words, within)
        until(lambda: not self.hidden("guide-question"), 5.0, "a question")
        focus = self.browser.js("document.activeElement.id")
        assert focus in ("guide-words", "guide-number"), focus

    def hidden(self, name: str) -> bool:
        return bool(self.browser.js(f"document.getElementById({name!r}).hidden"))

    def press(self, answer: str) -> None:
        """Press the button of this answer."""
        self.browser.js(f"document.querySelector('[data-answer={answer}]').click()")

    def types(self, value: str) -> None:
        """Type a number."""
        self.browser.js(f"document.getElementById('guide-number').value = {value!r}")
        self.browser.js("document.querySelector('#guide-answers .go').click()")

    def ended(self, words: str, within: float = 10.0) -> None:
        self.shows("guide-doing", words, within)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing() as browser:
        yield browser


def sound(browser: Browser) -> None:
    """Check the layout in light and dark colours.

    Nothing is wider than the screen, too small for a finger or an obstacle for a screen reader.
    """
    for size in (PHONE, DESKTOP):
        for dark in (False, True):
            browser.size(*size, touch=size == PHONE, dark=dark)
            assert browser.js("document.documentElement.scrollWidth") <= size[0]
            assert browser.obstacles() == []
    for size in (SIDEWAYS, PHONE):
        browser.size(*size)
        assert browser.js("document.documentElement.scrollWidth") <= size[0]
        assert browser.too_small() == []


@pytest.mark.nightly
def test_a_board_is_checked_without_a_daemon_and_the_lines_are_written(
    browser: Browser, tmp_path: Path
) -> None:
    alone = NoDaemon(tmp_path)
    with Page(alone, tmp_path) as server:
        person = Person(browser, server)
        sound(browser)
        person.begin("check", **{"check-port": "sim"})
        person.check_question("tick this")
        person.shows("guide-where", "SIMULATED")
        # The box is not ticked, so the check does not go on.
        person.press("lifted")
        assert "tick this" in browser.text("guide-words")
        assert browser.js("document.activeElement.id") == "guide-words"
        sound(browser)
        person.click("guide-tick")
        person.press("lifted")
        for n, wheel in enumerate(("fl", "fr", "rl", "rr")):
            person.check_question(f"which wheel did motor {'abcd'[n]} turn")
            if n == 0:
                sound(browser)
            person.press(wheel)
            person.check_question("which way did the wheel turn")
            person.press("forward")
        person.check_question("Write these lines")
        person.shows("guide-result", 'front_left = "+a"')
        assert browser.js("document.getElementById('guide-progress').value") == 1
        person.press("write")
        person.ended("failure (exit 1)")
        assert "FAIL wheel map" in browser.text("guide-story")
        assert "written" in browser.text("guide-story")
        sound(browser)
        person.click("guide-close")
        assert not person.hidden("check")
    assert [
        line for line in browser.said if "exception" in line.lower() or "Refused to" in line
    ] == []
    written = tomllib.loads(alone.config.read_text())["mcu"]["wheels"]
    assert written == {"front_right": "+b", "front_left": "+a"}


def test_the_lifted_wheels_can_be_confirmed_by_the_keyboard_alone(
    browser: Browser, tmp_path: Path
) -> None:
    alone = NoDaemon(tmp_path)
    with Page(alone, tmp_path) as server:
        person = Person(browser, server)
        person.begin("check", **{"check-port": "sim"})
        person.check_question("tick this")
        # From the question, Tab leads to the box. Space is STOP everywhere, so Enter ticks the box.
        browser.type_key("Tab")
        assert browser.js("document.activeElement.id") == "guide-tick"
        browser.type_key("Enter")
        browser.type_key("Tab")
        browser.type_key("Enter")
        person.check_question("which wheel did motor a turn")
        person.click("guide-leave")
        person.ended("ended")


@pytest.fixture
def skidding(tmp_path: Path) -> Iterator[tuple[Daemon, Bus, Page]]:
    with running(tmp_path, config=SKIDDING) as (daemon, bus), Page(daemon, tmp_path) as server:
        yield daemon, bus, server


def drives(person: Person, bus: Bus) -> None:
    """Start the first leg and wait until the robot moves.

    If a busy machine ends the leg, it is started again.
    """
    texts: list[str] = []
    disturbed = 0

    def moves() -> bool:
        nonlocal disturbed
        if person.hidden("guide"):
            person.begin("calibrate", method="")
            person.check_question("1. Place the", 30.0)
            person.shows("guide-where", "SIMULATED")
            person.press("start")
            disturbed = 0
        elif person.browser.text("guide-story").count("was disturbed") > disturbed:
            disturbed += 1
            person.check_question("1. Place the", 30.0)
            person.press("start")
        elif not person.hidden("guide-close"):
            texts.append(person.browser.text("guide-story"))
            person.click("guide-close")
        return bool((bus.state()["linear"] or 0.0) > 0.25)

    try:
        until(moves, 30.0, "the leg moves")
    except AssertionError as error:
        now = [person.browser.text(part) for part in ("guide-doing", "guide-words", "guide-story")]
        state = {name: bus.state()[name] for name in ("mode", "reason", "linear")}
        raise AssertionError(f"{error}; it said {texts}, now {now}, and {state}") from None


WAYS = ("stop",)
NIGHTLY = ("a key", "hidden", "the button", "a long press", "escape")


@pytest.mark.parametrize(
    "way", [*WAYS, *(pytest.param(way, marks=pytest.mark.nightly) for way in NIGHTLY)]
)
def test_any_action_of_the_operator_during_a_leg_stops_the_robot(
    browser: Browser, skidding: tuple[Daemon, Bus, Page], way: str
) -> None:
    _, bus, server = skidding
    person = Person(browser, server)
    drives(person, bus)
    begun = time.monotonic()
    if way == "a key":
        browser.key("Down", "KeyX", "x")
    elif way == "the button":
        browser.tap("guide-halt")
    elif way == "a long press":
        browser.touch("Start", browser.middle("guide-halt"))
    elif way == "escape":
        browser.key("Down", "Escape", "Escape")
    elif way == "stop":
        browser.tap("stop")
    else:
        browser.js(
            "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
    until(lambda: not any(bus.state()["wheels"]), 5.0, "at rest")
    took = time.monotonic() - begun
    print(f"{way}: at rest after {took:.2f} s")
    # 0.3 m/s at 1 m/s2, and a part of the way.
    assert took < 0.3 + 0.5 + lost(begun, begun + took)
    browser.lift()
    person.ended("failure" if way in ("a key", "the button", "a long press") else "stopped")
    none_left(server)
    browser.open("about:blank")


def test_a_browser_that_hangs_during_a_leg_stops_the_robot_within_a_second(
    browser: Browser, skidding: tuple[Daemon, Bus, Page]
) -> None:
    """The browser's connection stays open, so the server notices only that pings are missing."""
    _, bus, server = skidding
    person = Person(browser, server)
    drives(person, bus)
    assert browser.process is not None
    begun = time.monotonic()
    os.killpg(browser.process.pid, signal.SIGSTOP)
    try:
        until(lambda: not any(bus.state()["wheels"]), 10.0, "at rest")
        took = time.monotonic() - begun
        none_left(server)
    finally:
        os.killpg(browser.process.pid, signal.SIGCONT)
    print(f"at rest after {took:.2f} s")
    # Add the ramp: 0.3 m/s at 1 m/s2, and a part of the way.
    assert took < 1.0 + 0.3 + 0.5 + lost(begun, begun + took)
    browser.open("about:blank")


def test_on_the_simulator_the_card_recommends_and_preselects_a_method(
    browser: Browser, skidding: tuple[Daemon, Bus, Page]
) -> None:
    _, _, server = skidding
    person = Person(browser, server)
    assert browser.js("document.getElementById('method').value") == "positions"
    assert not person.hidden("positions-row")
    person.shows("advice", "no floor to measure with a tape")
    # The default works, and a different choice is kept.
    person.click("calibrate")
    person.check_question("1. Place the", 30.0)
    person.click("guide-leave")
    person.ended("stopped")
    person.click("guide-close")
    browser.js("document.getElementById('method').value = 'tape'")
    person.click("tab-drive")
    person.click("tab-set")
    browser.js("new Promise(done => setTimeout(done, 300))")
    assert browser.js("document.getElementById('method').value") == "tape"
    browser.open("about:blank")


@pytest.mark.soak
def test_the_simulator_is_calibrated_from_the_first_question_to_the_written_lines(
    browser: Browser, skidding: tuple[Daemon, Bus, Page]
) -> None:
    daemon, bus, server = skidding
    person = Person(browser, server)
    drives(person, bus)
    assert commands(server)
    person.check_question("from its mark", RIDES_S)
    assert "leave this empty" in browser.text("guide-words")
    assert "any key or the button stops the robot" in browser.text("guide-story")
    where = bus.get("sim/pose")["pose"]["position"]
    person.types("far")
    person.shows("guide-wrong", "a number in m")
    person.types(f"{math.hypot(where['x'], where['y']):.3f}".replace(".", ","))
    person.check_question("2. The robot drives back")
    person.press("start")
    until(
        lambda: browser.js("document.getElementById('guide-progress').value") > 0.1, 60.0, "a bar"
    )
    person.check_question("Write these lines", RIDES_S)
    person.shows("guide-result", "standard deviation")
    sound(browser)
    person.press("write")
    person.ended("done (exit 0)")
    assert "restart the daemon" in browser.text("guide-story")
    written = parse(daemon.config.read_bytes())
    assert abs(written.drive.wheel_separation_multiplier - 1.6 * 1.06) < 0.1
    assert written.odometry.wheel_separation_multiplier_std > 0
