"""STOP works as soon as the page shows it in red: before, and without, every other file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from acsard.web.answers import INLINED, PAGE_DIRECTORY
from tests.system.browser import Page
from tests.system.chromium import CHROMIUM, PHONE, RED, Browser, browsing
from tests.system.harness import Bus, until
from tests.system.phone_page import running

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

WHOLE = {"index.html", *INLINED["index.html"]}
"""The files that arrive as one."""

FILES = sorted(path.name for path in PAGE_DIRECTORY.iterdir() if path.name not in WHOLE)

IMPATIENT = f"""(() => {{
    const look = () => {{
        const stop = document.getElementById("stop");
        if (stop && {RED}) {{
            window.red = performance.now();
            window.before = document.getElementById("mode").textContent;
            stop.dispatchEvent(new PointerEvent("pointerdown", {{bubbles: true}}));
        }} else requestAnimationFrame(look);
    }};
    look();
}})()"""
"""Presses STOP in the first frame in which it is red, and notes the time and the mode shown."""


class Robot:
    """A robot that is ready, its page, and a phone that presses STOP at once."""

    def __init__(self, bus: Bus, page: Page, browser: Browser) -> None:
        self.bus, self.page, self.browser = bus, page, browser

    def stopped(self) -> bool:
        return bool(self.bus.state()["mode"] == "stopped")

    def is_ready(self) -> None:
        self.bus.ask("srv/clear")
        until(lambda: self.bus.state()["mode"] == "ready", 5.0, "it is ready")

    @contextmanager
    def without(self, *names: str) -> Iterator[None]:
        """Open the page in a browser that may not load these files of it."""
        self.is_ready()
        self.browser.ask("Network.setBlockedURLs", urls=[f"*/page/{name}" for name in names])
        self.browser.open(self.page.here)
        yield
        self.browser.open("about:blank")
        self.browser.ask("Network.setBlockedURLs", urls=[])

    def alarms(self, words: str) -> None:
        until(lambda: words in self.browser.text("alarm"), 5.0, f"the page says {words!r}")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    with running(tmp_path_factory.mktemp("stop")) as (_, bus, page), browsing() as browser:
        browser.size(*PHONE)
        browser.ask("Network.enable")
        browser.ask("Network.setCacheDisabled", cacheDisabled=True)
        browser.ask("Page.addScriptToEvaluateOnNewDocument", source=IMPATIENT)
        yield Robot(bus, page, browser)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "words.js" else pytest.mark.nightly) for name in FILES],
)
def test_stop_latches_without_any_one_file_and_the_page_says_reload(
    robot: Robot, name: str
) -> None:
    with robot.without(name):
        until(robot.stopped, 5.0, f"stopped without {name}")
        if name.endswith(".js"):
            robot.alarms("eload")  # "reload it" or "Reload the page", by what happens first
            assert robot.browser.js("document.getElementById('stick').ariaDisabled") == "true"


def test_stop_latches_while_every_other_file_is_never_answered(robot: Robot) -> None:
    browser = robot.browser
    robot.is_ready()
    browser.ask("Fetch.enable", patterns=[{"urlPattern": "*/page/*"}])
    try:
        browser.ask("Page.navigate", url=robot.page.here)
        until(robot.stopped, 5.0, "stopped")
        robot.alarms("STOP: the robot has confirmed it. This page is not complete: reload it.")
        assert browser.text("mode") == "CONNECTING"
    finally:
        browser.ask("Fetch.disable")
        browser.open("about:blank")


def test_on_a_slow_network_stop_latches_before_the_page_shows_the_robot(robot: Robot) -> None:
    browser = robot.browser
    slow = {"latency": 300, "downloadThroughput": 50_000, "uploadThroughput": 50_000}
    browser.ask("Network.emulateNetworkConditions", offline=False, **slow)
    try:
        with robot.without():
            until(robot.stopped, 5.0, "stopped")
            until(lambda: browser.text("mode") == "STOPPED", 10.0, "the page shows it")
            assert browser.js("window.before") == "CONNECTING"
            print(f"\nSTOP is red after {browser.js('window.red'):.0f} ms")
    finally:
        fast = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.ask("Network.emulateNetworkConditions", offline=False, **fast)
