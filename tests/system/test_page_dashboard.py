"""A web page of another origin uses the web API of the robot's page."""

from __future__ import annotations

import json
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from acsard.machine.authority import Authority
from tests.system.browser import NAME, Page
from tests.system.chromium import CHROMIUM, PHONE, browsing
from tests.system.harness import (
    PATIENCE_S,
    ROOT,
    Bus,
    Daemon,
    finish,
    free_endpoint,
    until,
)

pytestmark = pytest.mark.network

NODE = shutil.which("node")

MANUAL = ROOT / "deploy/manual/pages/howto/dashboard.md"


def block(language: str) -> str:
    """Return the only block of this language on the manual's page."""
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", MANUAL.read_text(), re.S | re.M)
    return str(text)


@pytest.fixture(scope="module")
def origin() -> str:
    return f"http://127.0.0.1:{free_endpoint().rpartition(':')[2]}"


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory, origin: str) -> Iterator[Daemon]:
    where = tmp_path_factory.mktemp("robot")
    with Daemon(where, config={"web": {"origins": [origin]}}) as robot:
        yield robot


@pytest.fixture(scope="module")
def server(robot: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    where = tmp_path_factory.mktemp("dashboard")
    Authority.make(where / "tls", "test", 1, [NAME]).issue(where / "tls", "robot", [NAME], 1)
    with Page(robot, where) as server:
        yield server


@pytest.fixture
def bus(robot: Daemon) -> Iterator[Bus]:
    """Provide a client of the robot, which has no latch and stands still."""
    with Bus(robot.endpoint) as bus:
        bus.linked()
        bus.ask("srv/clear")
        bus.at_rest()
        yield bus


@pytest.mark.skipif(NODE is None, reason="needs node")
async def test_the_proxy_of_the_manual_makes_requests_look_like_the_page_s_own(
    server: Page,
) -> None:
    dumped = block("js") + "\nconst none = JSON.stringify;\n"
    dumped = dumped.replace("export default", "const config =") + "console.log(none(config));"
    done = finish([str(NODE), "--input-type=module", "-e", dumped], ROOT)
    assert done.code == 0, done
    proxies: dict[str, Any] = json.loads(done.out)["server"]["proxy"]
    assert set(proxies) == {"/api", "/ws"}
    assert proxies["/ws"]["ws"] is True
    async with aiohttp.ClientSession() as session:
        for proxy in proxies.values():
            assert proxy["changeOrigin"] is True
            written = json.dumps(proxy).replace("http://127.0.0.1:8080", server.here)
            headers = {"Sec-Fetch-Site": "same-origin", **json.loads(written)["headers"]}
            place = f"{server.here}/api/srv/stop"
            async with session.post(place, headers=headers) as answer:
                assert answer.status == 200
            async with session.ws_connect(f"{server.here}/ws", headers=headers) as opened:
                assert "hello" in (await opened.receive()).data


class _Silent(SimpleHTTPRequestHandler):
    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        """Log nothing."""


@contextmanager
def served(where: Path, origin: str) -> Iterator[None]:
    """Serve the files of a directory at an origin."""
    port = int(origin.rpartition(":")[2])
    server = ThreadingHTTPServer(("127.0.0.1", port), partial(_Silent, directory=str(where)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


LATE = """(() => {
    const now = Date.now;
    window.tries = 0, window.told = "";
    window.fetch = async () => {
        if (++window.tries === 4) Date.now = () => now() + 31000;
        throw new Error();
    };
    window.alert = (text) => (window.told = text);
})()"""
"""Makes STOP fail, and 31 s pass at its fourth attempt."""


WATCHED = """(() => {
    const send = WebSocket.prototype.send;
    window.sent = 0, window.menus = [];
    WebSocket.prototype.send = function (data) { window.sent++; send.call(this, data); };
    addEventListener("contextmenu", (event) => window.menus.push(event.defaultPrevented));
    return true;
})()"""
"""Counts the commands, and notes which menus the page prevents."""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell")
def test_the_dashboard_of_the_manual_drives_until_a_finger_takes_over_and_stops(
    server: Page, bus: Bus, origin: str, tmp_path: Path
) -> None:
    text = block("html")
    assert "http://127.0.0.1:8080" in text
    (tmp_path / "index.html").write_text(text.replace("http://127.0.0.1:8080", server.here))

    # A tab in the background does not drive, so the robot's own page has a browser of its own.
    with served(tmp_path, origin), browsing() as browser, browsing() as phone:

        def shows(words: str) -> None:
            until(lambda: words in browser.text("state"), PATIENCE_S, f"it shows {words!r}")

        def drives(source: str) -> bool:
            state = bus.state()
            return bool(state["source"] == source and (state["linear"] or 0.0) > 0.1)

        browser.open(origin)
        shows("ready by nobody")
        phone.size(*PHONE)
        phone.open(server.here)
        browser.js(WATCHED)
        # A right button opens a menu. A browser does not report its release while the menu is open.
        forward = browser.middle("forward")
        browser.mouse("Pressed", forward, "right", buttons=2)
        time.sleep(0.5)
        browser.mouse("Released", forward, "right", buttons=0)
        assert browser.js("window.sent") == 0
        assert browser.js("window.menus") == [False]
        browser.mouse("Pressed", forward)
        shows("driving by app")
        until(lambda: drives("app"), PATIENCE_S, "the dashboard drives")
        # With Ctrl, macOS opens the menu by the left button, which drives here.
        menu = "new MouseEvent('contextmenu', {bubbles: true, cancelable: true})"
        browser.js(f"document.getElementById('forward').dispatchEvent({menu})")
        assert browser.js("window.menus") == [False, True]
        phone.hold(lambda: drives("teleop"))
        shows("driving by teleop")
        phone.lift()
        until(lambda: drives("app"), PATIENCE_S, "the dashboard drives on")
        browser.js("document.getElementById('stop').click()")
        shows("stopped by")
        assert bus.state()["mode"] == "stopped"
        browser.js(LATE)
        browser.js("document.getElementById('stop').click()")
        until(lambda: "not confirmed" in browser.js("window.told"), PATIENCE_S, "it gives up")
        time.sleep(1.0)
        assert browser.js("window.tries") == 4
