"""Drive a headless Chromium by its DevTools protocol: touch, keys, sizes, pictures.

The browser is Debian's `chromium-headless-shell` or `chromium`; tests skip if both are missing.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import aiohttp

from tests.system.harness import PATIENCE_S, until
from tests.system.hosts import inside

CHROMIUM = shutil.which(os.environ.get("CHROMIUM", "chromium-headless-shell")) or shutil.which(
    "chromium"
)
"""Debian's headless shell has the same engine without the windows around it. The tests of the page
take 0.6 times as long in it. `CHROMIUM=chromium` chooses the whole browser."""

OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--touch-events=enabled", "--remote-debugging-port=0",
)  # fmt: skip

PHONE, SIDEWAYS, DESKTOP = (390, 844), (844, 390), (1280, 800)

SETTLED_S = 1.1
"""Time for which a test shows the button that ends the page's mode before it presses the button.
The page ignores a press in the first second."""

RED = "getComputedStyle(document.getElementById('stop')).backgroundColor === 'rgb(196, 18, 10)'"
"""Whether STOP has the red of the light style, which means that it works."""

FINGER_PX = 44
"""Minimum width and height of an element that a finger presses."""

_PRESSED = """[...document.querySelectorAll('button, a, input, select, #stick')]
    .filter(one => one.checkVisibility())
    .map(one => one.type === 'checkbox' ? one.closest('label') : one)
    .map(one => [one.id || one.textContent, one.getBoundingClientRect()])
    .filter(([, box]) => Math.min(box.width, box.height) < LEAST)
    .map(([name, box]) => [name, box.width, box.height])"""


READABLE_PX = 12
"""Minimum size of a visible text."""

_TINY = """[...document.querySelectorAll('body *')]
    .filter(one => [...one.childNodes].some(node => node.nodeType === 3 && node.data.trim()))
    .filter(one => one.checkVisibility() && parseFloat(getComputedStyle(one).fontSize) < LEAST)
    .map(one => [one.id || one.textContent, getComputedStyle(one).fontSize])"""


class Browser:
    """A browser in a separate process. The test's thread calls its methods."""

    def __init__(self, where: Path, host: str = "", options: Sequence[str] = ()) -> None:
        """Prepare the browser. `start` starts it.

        `host` is the simulated host on which it runs. `options` extend its command line.
        """
        self._where, self._options = where, options
        self._host = host
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._number = 0
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._down: tuple[tuple[float, float], ...] = ()
        self.process: subprocess.Popen[bytes] | None = None
        self.said: list[str] = []
        """Console messages and errors of the page."""
        self._document = ("", "")
        """The address and the loader of the document that the tab shows."""
        self._loaded: set[str] = set()
        """The loaders of the documents whose parts have all arrived."""

    def start(self) -> None:
        """Start the browser, and wait until it accepts commands."""
        assert CHROMIUM is not None
        words = [CHROMIUM, *OPTIONS, *self._options, f"--user-data-dir={self._where}"]
        with self._on_host():
            self.process = subprocess.Popen(
                [*words, "about:blank"],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        port_file = self._where / "DevToolsActivePort"

        def port() -> str | None:
            return next(iter(port_file.read_text().split()), None) if port_file.exists() else None

        self._wait(self._connect(until(port, 20.0, "a browser")))

    def _on_host(self) -> AbstractContextManager[None]:
        return inside(self._host) if self._host else nullcontext()

    def end(self) -> None:
        """Kill the browser with all its processes."""
        if self.process is None:
            return
        if hasattr(self, "_session"):
            self._wait(self._session.close())
        with suppress(ProcessLookupError):  # the process has already ended
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(10.0)

    async def _connect(self, port: str) -> None:
        self._session = aiohttp.ClientSession(f"http://127.0.0.1:{port}")
        with self._on_host():
            async with self._session.get("/json") as answer:
                targets = await answer.json()
            url = next(each["webSocketDebuggerUrl"] for each in targets if each["type"] == "page")
            self._socket = await self._session.ws_connect(url, max_msg_size=1 << 26)
        self._reader = asyncio.ensure_future(self._read())
        for domain in ("Page", "Runtime", "Log"):
            await self._ask(f"{domain}.enable", {})
        await self._ask("Page.setLifecycleEventsEnabled", {"enabled": True})

    async def _read(self) -> None:
        async for message in self._socket:
            frame = json.loads(message.data)
            if "id" in frame:
                answer = self._answers.pop(frame["id"], None)
                if answer is not None and not answer.done():
                    answer.set_result(frame)
            elif frame["method"] == "Page.frameNavigated":
                document = frame["params"]["frame"]
                if "parentId" not in document:
                    self._document = document["url"], document["loaderId"]
            elif frame["method"] == "Page.lifecycleEvent":
                if frame["params"]["name"] == "load":
                    self._loaded.add(frame["params"]["loaderId"])
            elif frame["method"] == "Runtime.consoleAPICalled":
                self.said.append(" ".join(str(a.get("value")) for a in frame["params"]["args"]))
            elif frame["method"] == "Runtime.exceptionThrown":
                self.said.append(json.dumps(frame["params"]["exceptionDetails"]))
            elif frame["method"] == "Log.entryAdded":
                self.said.append(frame["params"]["entry"]["text"])

    def ask(self, method: str, **params: object) -> Any:
        """Run one command of the DevTools protocol, and return its result."""
        return self._wait(self._ask(method, params))

    async def _ask(self, method: str, params: dict[str, object]) -> Any:
        self._number += 1
        answer = self._answers[self._number] = self._loop.create_future()
        await self._socket.send_json({"id": self._number, "method": method, "params": params})
        reply = await answer
        assert "error" not in reply, reply
        return reply["result"]

    def _wait(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(20.0 + PATIENCE_S)

    def size(self, width: int, height: int, *, touch: bool = True, dark: bool = False) -> None:
        """Set the screen's size, its touch support and the colour scheme."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=touch,
        )  # fmt: skip
        self.ask("Emulation.setTouchEmulationEnabled", enabled=touch)
        look = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.ask("Emulation.setEmulatedMedia", features=look)

    def open(self, url: str) -> None:
        """Open the address; return when the page is loaded."""
        if loader := self.ask("Page.navigate", url=url).get("loaderId"):
            until(lambda: loader in self._loaded, 10.0, url)

    def arrives(self, end: str) -> None:
        """Wait until the tab shows a document whose address ends so, with all its parts.

        While a tab changes its document, `js` may fail.
        """

        def arrived() -> bool:
            url, loader = self._document
            return url.endswith(end) and loader in self._loaded

        until(arrived, 10.0, f"a page {end}")

    def js(self, text: str) -> Any:
        """Evaluate a JavaScript expression in the page, wait for a promise, return the value."""
        reply = self.ask("Runtime.evaluate", expression=text, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    def text(self, name: str) -> str:
        """Return the text of the element with this id, or "" if there is no such element."""
        return str(self.js(f"document.getElementById({name!r})?.textContent ?? ''"))

    def middle(self, name: str) -> tuple[float, float]:
        """Return the position of the element's centre, in px."""
        box = f"document.getElementById({name!r}).getBoundingClientRect()"
        point = self.js(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        return point[0], point[1]

    def too_small(self) -> list[Any]:
        """Return the visible controls that are too small for a finger: name, width, height."""
        return list(self.js(_PRESSED.replace("LEAST", str(FINGER_PX - 0.5))))

    def too_tiny(self) -> list[Any]:
        """Return the visible texts that are too small to read: element, size."""
        return list(self.js(_TINY.replace("LEAST", str(READABLE_PX))))

    def obstacles(self, only: str = "") -> list[Any]:
        """Return the accessibility problems that axe finds: severity, rule, element.

        `only` selects a single rule.
        """
        rules = json.dumps({"runOnly": [only]} if only else {})
        if not self.js("'axe' in window"):
            self.js(files("axe_core_python").joinpath("axe.min.js").read_text() + ";1")
        violations: list[Any] = self.js(
            f"axe.run({rules}).then(told =>"
            " told.violations.map(one => [one.impact, one.id, one.nodes[0].html]))"
        )
        return violations

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send a touch event (Start, Move, End or Cancel) with the fingers that are down."""
        self._down = points
        where = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(points)]
        self.ask("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=where)

    def tap(self, name: str) -> None:
        """Tap the element with this id.

        If other fingers are down, the tap is a synthetic event in the page, because Chromium
        forwards no touch after two emulated ones.
        """
        if self._down:
            self.js(
                f"document.getElementById({name!r}).dispatchEvent(new PointerEvent('pointerdown',"
                " {pointerId: 99, bubbles: true, cancelable: true}))"
            )
        else:
            self.touch("Start", self.middle(name))
            self.touch("End")

    def release(self) -> None:
        """Wait until the page accepts a press of its button `clear`, and tap it."""
        self.settle()
        self.tap("clear")

    def settle(self) -> None:
        """Wait until the page accepts a press of its button `clear`.

        On a busy machine, a gap between two states makes the button gray for a moment.
        """
        time.sleep(SETTLED_S)
        until(lambda: self.js("!document.getElementById('clear').disabled"), 5.0, "it is offered")

    def lift(self) -> None:
        """Lift all fingers that are down. Do nothing if the page has gone."""
        if self._down:
            with suppress(AssertionError):
                self.touch("End")
            self._down = ()

    def push(self, x: float, y: float, kind: str = "Move") -> None:
        """Move the finger on the page's stick to this position.

        The position is in px from the stick's centre, with y upwards. `kind` is the touch event.
        """
        mx, my = self.middle("stick")
        self.touch(kind, (mx + x, my - y))

    def hold(self, drives: Callable[[], bool]) -> None:
        """Push the stick forwards until `drives` returns True.

        If a busy machine makes the page release the stick, the finger presses it again.
        """
        texts: list[str] = []

        def look() -> bool:
            if not self.js("document.getElementById('stick').matches('.held')"):
                texts.append(self.text("hint"))
                self.lift()
                self.push(0, 0, "Start")
                self.push(0, 90)
            return drives()

        try:
            until(look, 10.0, "it drives")
        except AssertionError as error:
            raise AssertionError(f"{error}; it said {texts}") from None

    def mouse(
        self, kind: str, at: tuple[float, float], button: str = "left", *, buttons: int = 1,
        clicks: int = 1,
    ) -> None:  # fmt: skip
        """Send a mouse event (Pressed, Moved or Released); `buttons` are those that are down."""
        self.ask(
            "Input.dispatchMouseEvent", type=f"mouse{kind}", x=at[0], y=at[1], button=button,
            buttons=buttons, clickCount=clicks,
        )  # fmt: skip

    def key(self, kind: str, code: str, key: str, **more: Any) -> None:
        """Send a keyboard event (Down or Up)."""
        kind = "keyUp" if kind == "Up" else "keyDown" if "text" in more else "rawKeyDown"
        self.ask("Input.dispatchKeyEvent", type=kind, code=code, key=key, **more)

    def picture(self, path: Path, *, whole: bool = False) -> None:
        """Write a PNG of the visible page, or of the `whole` page down to its end."""
        reply = self.ask(
            "Page.captureScreenshot",
            format="png",
            captureBeyondViewport=whole,
            **{"clip": self._whole()} if whole else {},
        )
        path.write_bytes(base64.b64decode(reply["data"]))

    def _whole(self) -> dict[str, float]:
        size = self.ask("Page.getLayoutMetrics")["cssContentSize"]
        return {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}


@contextmanager
def browsing(host: str = "", options: Sequence[str] = ()) -> Iterator[Browser]:
    """Run a browser, and kill it at the end."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as where:
        browser = Browser(Path(where), host, options)
        try:
            browser.start()
            yield browser
        finally:
            browser.end()
            time.sleep(0.1)  # its child processes still release the directory
