"""A headless Chromium, spoken to by its DevTools protocol: touch, keys, sizes, pictures.

The browser is Debian's `chromium`; where there is none, tests skip.
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
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import aiohttp

from tests.system.harness import PATIENCE_S, until

CHROMIUM = shutil.which("chromium")

OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--touch-events=enabled", "--remote-debugging-port=0",
)  # fmt: skip

PHONE, DESKTOP = (390, 844), (1280, 800)


class Browser:
    """One page in a process of its own; calls come from the test's thread."""

    def __init__(self, where: Path, *options: str) -> None:
        self._where, self._options = where, options
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._number = 0
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._down: tuple[tuple[float, float], ...] = ()
        self.process: subprocess.Popen[bytes] | None = None
        self.said: list[str] = []
        """What the page wrote to its console, and errors."""

    def start(self) -> None:
        """Until it can be spoken to."""
        assert CHROMIUM is not None
        words = [
            CHROMIUM,
            *OPTIONS,
            *self._options,
            f"--user-data-dir={self._where}",
            "about:blank",
        ]
        self.process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        told = self._where / "DevToolsActivePort"

        def port() -> str | None:
            return next(iter(told.read_text().split()), None) if told.exists() else None

        self._wait(self._connect(until(port, 20.0, "a browser")))
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def end(self, how: int = signal.SIGKILL) -> None:
        """Kill it, with all its processes."""
        if self.process is None:
            return
        if how == signal.SIGKILL and hasattr(self, "_session"):
            self._wait(self._session.close())
        os.killpg(self.process.pid, how)
        if how == signal.SIGKILL:
            self.process.wait(10.0)

    async def _connect(self, port: str) -> None:
        self._session = aiohttp.ClientSession()
        async with self._session.get(f"http://127.0.0.1:{port}/json") as answer:
            pages = await answer.json()
        url = next(one["webSocketDebuggerUrl"] for one in pages if one["type"] == "page")
        self._socket = await self._session.ws_connect(url, max_msg_size=1 << 26)
        self._reader = asyncio.ensure_future(self._read())

    async def _read(self) -> None:
        async for message in self._socket:
            told = json.loads(message.data)
            if "id" in told:
                answer = self._answers.pop(told["id"], None)
                if answer is not None and not answer.done():
                    answer.set_result(told)
            elif told["method"] == "Runtime.consoleAPICalled":
                self.said.append(" ".join(str(a.get("value")) for a in told["params"]["args"]))
            elif told["method"] == "Runtime.exceptionThrown":
                self.said.append(json.dumps(told["params"]["exceptionDetails"]))
            elif told["method"] == "Log.entryAdded":
                self.said.append(told["params"]["entry"]["text"])

    def ask(self, method: str, **params: object) -> Any:
        """One command of the protocol; its result."""
        return self._wait(self._ask(method, params))

    async def _ask(self, method: str, params: dict[str, object]) -> Any:
        self._number += 1
        answer = self._answers[self._number] = self._loop.create_future()
        await self._socket.send_json({"id": self._number, "method": method, "params": params})
        told = await answer
        assert "error" not in told, told
        return told["result"]

    def _wait(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(20.0 + PATIENCE_S)

    def size(self, width: int, height: int, *, touch: bool = True, dark: bool = False) -> None:
        """As this screen has it."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=touch,
        )  # fmt: skip
        self.ask("Emulation.setTouchEmulationEnabled", enabled=touch)
        look = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.ask("Emulation.setEmulatedMedia", features=look)

    def open(self, url: str) -> None:
        """Go there; returns when it is loaded."""
        self.ask("Page.navigate", url=url)
        until(lambda: self.js("document.readyState") == "complete", 10.0, url)

    def js(self, text: str) -> Any:
        """What this expression is worth in the page; a promise is waited for."""
        told = self.ask("Runtime.evaluate", expression=text, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in told, told["exceptionDetails"]
        return told["result"].get("value")

    def text(self, name: str) -> str:
        """What stands in the element with this id."""
        return str(self.js(f"document.getElementById({name!r}).textContent"))

    def middle(self, name: str) -> tuple[float, float]:
        """Where the element is, px."""
        box = f"document.getElementById({name!r}).getBoundingClientRect()"
        found = self.js(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        return found[0], found[1]

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """`kind` is Start, Move, End or Cancel; the fingers that are down then."""
        self._down = points
        where = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(points)]
        self.ask("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=where)

    def tap(self, name: str) -> None:
        """A finger on the element and up again; one more finger is an event of the page's own,
        because Chromium passes on no touch any more once two were emulated."""
        if self._down:
            self.js(
                f"document.getElementById({name!r}).dispatchEvent(new PointerEvent('pointerdown',"
                " {pointerId: 99, bubbles: true, cancelable: true}))"
            )
        else:
            self.touch("Start", self.middle(name))
            self.touch("End")

    def lift(self) -> None:
        """All fingers, if there are any."""
        if self._down:
            self.touch("End")

    def key(self, kind: str, code: str, key: str) -> None:
        """`kind` is Down or Up."""
        kind = "rawKeyDown" if kind == "Down" else "keyUp"
        self.ask("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def picture(self, path: Path) -> None:
        """What a person sees, as PNG."""
        told = self.ask("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(told["data"]))


@contextmanager
def browsing(*options: str) -> Iterator[Browser]:
    """A browser of its own, killed in the end; `options` are of its command line."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as where:
        browser = Browser(Path(where), *options)
        try:
            browser.start()
            yield browser
        finally:
            browser.end()
            time.sleep(0.1)  # its children let go of the directory
