"""STOP works as soon as the page shows it in red.

This holds if any file of the page is missing, and if any file loads slowly.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from acsard.web.answers import INLINED, PAGE_DIRECTORY
from tests.system.browser import Page
from tests.system.chromium import CHROMIUM, PHONE, Browser, browsing
from tests.system.harness import Bus, running, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell"),
]

WHOLE = {"index.html", *INLINED["index.html"]}
"""The files that arrive as one."""

FILES = sorted(path.name for path in PAGE_DIRECTORY.iterdir() if path.name not in WHOLE)

MODULES = [name for name in FILES if name.endswith(".js")]

RED = "rgb(196, 18, 10)"
"""The colour of STOP in the light style."""

IMPATIENT = f"""(() => {{
    const look = () => {{
        const stop = document.getElementById("stop");
        if (stop && getComputedStyle(stop).backgroundColor === "{RED}") {{
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

    @property
    def mode(self) -> str:
        return str(self.bus.state()["mode"])

    @contextmanager
    def without(self, *names: str) -> Iterator[None]:
        """Open the page in a browser that is not allowed to load the named files."""
        self.bus.ask("srv/clear")
        until(lambda: self.mode == "ready", 5.0, "it is ready")
        self.browser.ask("Network.setBlockedURLs", urls=[f"*/page/{name}" for name in names])
        self.browser.open(self.page.here)
        yield
        self.browser.open("about:blank")
        self.browser.ask("Network.setBlockedURLs", urls=[])

    def alarms(self, words: str) -> None:
        until(lambda: words in self.browser.text("alarm"), 5.0, f"the page says {words!r}")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    where = tmp_path_factory.mktemp("stop")
    with running(where) as (daemon, bus), Page(daemon, where) as page, browsing() as browser:
        browser.size(*PHONE)
        browser.ask("Network.enable")
        browser.ask("Network.setCacheDisabled", cacheDisabled=True)
        yield Robot(bus, page, browser)


@pytest.fixture
def impatient(robot: Robot) -> Iterator[Robot]:
    added = robot.browser.ask("Page.addScriptToEvaluateOnNewDocument", source=IMPATIENT)
    yield robot
    robot.browser.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


def some(names: Sequence[str], which: int) -> list[Any]:
    """Return parameters for all files, and mark three of four as `nightly`.

    The files without the mark are each fourth one of `FILES`, from index `which` on.
    """
    return [
        pytest.param(name, marks=() if FILES.index(name) % 4 == which else pytest.mark.nightly)
        for name in names
    ]


@pytest.mark.parametrize("name", some(FILES, 0))
def test_stop_latches_as_soon_as_it_is_red_also_if_one_file_does_not_load(
    impatient: Robot, name: str
) -> None:
    with impatient.without(name):
        until(lambda: impatient.mode == "stopped", 5.0, f"stopped without {name}")


@pytest.mark.parametrize("name", some(MODULES, 1))
def test_a_page_without_one_of_its_modules_says_reload_and_its_stick_is_grey(
    robot: Robot, name: str
) -> None:
    browser = robot.browser
    with robot.without(name):
        robot.alarms("did not load, so only STOP works here. Reload the page.")
        assert browser.text("mode") == "NOT LOADED"
        assert browser.js("document.getElementById('stick').ariaDisabled") == "true"
        browser.key("Down", "Space", " ")
        browser.key("Up", "Space", " ")
        until(lambda: robot.mode == "stopped", 5.0, f"stopped without {name}")
        robot.alarms("STOP: the robot has confirmed it")


def test_stop_latches_in_a_browser_that_lacks_a_function_of_2022(impatient: Robot) -> None:
    old = "delete AbortSignal.timeout"
    added = impatient.browser.ask("Page.addScriptToEvaluateOnNewDocument", source=old)
    with impatient.without("link.js"):  # STOP goes by HTTP
        until(lambda: impatient.mode == "stopped", 5.0, "stopped")
    impatient.browser.ask(
        "Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"]
    )


def test_stop_latches_as_soon_as_it_is_red_while_every_other_file_is_never_answered(
    impatient: Robot,
) -> None:
    browser = impatient.browser
    browser.ask("Fetch.enable", patterns=[{"urlPattern": "*/page/*"}])
    impatient.bus.ask("srv/clear")
    until(lambda: impatient.mode == "ready", 5.0, "it is ready")
    try:
        browser.ask("Page.navigate", url=impatient.page.here)
        until(lambda: impatient.mode == "stopped", 5.0, "stopped")
        impatient.alarms("STOP: the robot has confirmed it. This page is not complete: reload it.")
        assert browser.js("document.getElementById('mode').textContent") == "CONNECTING"
    finally:
        browser.ask("Fetch.disable")
        browser.open("about:blank")


DYING = """
    const send = WebSocket.prototype.send;
    WebSocket.prototype.send = function (data) { if (!window.dead) send.call(this, data); };
    Object.defineProperty(WebSocket.prototype, "onmessage", {
        set(take) { this.addEventListener("message", (event) => window.dead || take(event)); },
    });
"""
"""Makes WebSockets that pass nothing on once `dead` is set, and stay open."""


def test_stop_latches_within_a_second_while_the_socket_is_dead_but_open(robot: Robot) -> None:
    browser = robot.browser
    added = browser.ask("Page.addScriptToEvaluateOnNewDocument", source=DYING)
    try:
        with robot.without():
            until(lambda: browser.text("mode") == "READY", 10.0, "the page is complete")
            browser.js("window.dead = true")
            begun = time.monotonic()
            browser.key("Down", "Space", " ")
            browser.key("Up", "Space", " ")
            until(lambda: robot.mode == "stopped", 10.0, "stopped")
            took = time.monotonic() - begun
            print(f"\nSTOP latches {1000 * took:.0f} ms after the press")
            assert took < 1.0
    finally:
        browser.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


@pytest.fixture
def stopless(robot: Robot) -> Iterator[Robot]:
    """Provide a browser in which the script of STOP fails.

    Another script has already declared the class `Stopping`.
    """
    added = robot.browser.ask("Page.addScriptToEvaluateOnNewDocument", source="class Stopping {}")
    yield robot
    robot.browser.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


def test_a_page_whose_stop_does_not_run_has_no_red_stop_does_not_drive_and_says_reload(
    stopless: Robot,
) -> None:
    browser = stopless.browser
    with stopless.without():
        stopless.alarms("STOP does not work here")
        colour = browser.js("getComputedStyle(document.getElementById('stop')).backgroundColor")
        assert colour != RED
        assert browser.js("document.getElementById('stick').ariaDisabled") == "true"


def test_the_browser_runs_no_other_script_within_the_page(robot: Robot) -> None:
    with robot.without():
        added = (
            "document.head.append(Object.assign(document.createElement('script'),"
            " {textContent: 'window.added = true'})), window.added ?? false"
        )
        assert robot.browser.js(added) is False


def test_on_a_slow_network_stop_latches_before_the_page_shows_the_robot(impatient: Robot) -> None:
    browser = impatient.browser
    slow = {"latency": 300, "downloadThroughput": 50_000, "uploadThroughput": 50_000}
    browser.ask("Network.emulateNetworkConditions", offline=False, **slow)
    try:
        with impatient.without():
            until(lambda: impatient.mode == "stopped", 5.0, "stopped")
            until(lambda: browser.text("mode") == "STOPPED", 10.0, "the page shows it")
            until(lambda: browser.text("age").startswith("live"), 5.0, "the page is complete")
            assert browser.js("window.before") == "CONNECTING"
            now_ms = browser.js("performance.now()")
            print(f"\nSTOP is red after {browser.js('window.red'):.0f} ms; now {now_ms:.0f} ms")
    finally:
        fast = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.ask("Network.emulateNetworkConditions", offline=False, **fast)


def test_every_module_of_the_page_is_preloaded() -> None:
    """The browser can load all modules at once, because index.html lists them."""
    page = (PAGE_DIRECTORY / "index.html").read_text(encoding="utf-8")
    loaded = {name for name in MODULES if f'<link rel="modulepreload" href="page/{name}"' in page}
    assert loaded == set(MODULES) - {"main.js"}
