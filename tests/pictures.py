"""What the robot's page looks like: `python -m tests.pictures DIRECTORY` writes every view as PNG,
on a phone upright and sideways and on a desktop, light and dark, for people to look at."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.system.browser import Page
from tests.system.chromium import DESKTOP, PHONE, SIDEWAYS, Browser, browsing
from tests.system.harness import Bus, Daemon, until

VIEWS = ("drive", "status", "events", "set", "robots")

SIZES = {"phone": PHONE, "sideways": SIDEWAYS, "desktop": DESKTOP}


def write(directory: Path, sizes: Sequence[str] = tuple(SIZES), *, both: bool = True) -> list[Path]:
    """The pictures, named `phone-dark-drive.png`; light alone unless `both`. What the page wrote to
    its console is an error."""
    directory.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as place,
        Daemon(Path(place), config={"record": {"directory": f"{place}/record"}}) as daemon,
        Bus(daemon.endpoint) as bus,
        Page(daemon, Path(place)) as page,
        browsing() as browser,
    ):
        _drive(bus)
        browser.size(*PHONE)
        browser.open(page.here)
        until(lambda: "live" in browser.text("age"), 10.0, "a page")
        written = [
            _picture(browser, directory, size, look, view)
            for size in sizes
            for look in (("light", "dark") if both else ("light",))
            for view in VIEWS
        ]
        assert browser.said == [], browser.said
        return written


def _drive(bus: Bus) -> None:
    """A way to see on the map, and something that was refused."""
    bus.linked()
    for angular, key, target in ((0.0, "x", 0.6), (0.8, "yaw", 1.5), (0.0, "y", 1.2)):
        with bus.commanding(0.4, angular):
            until(lambda k=key, t=target: bus.state()[k] > t, 10.0, f"{key} over {target}")  # type: ignore[misc]
    bus.at_rest()
    bus.put("cmd/app", {"linear": {"x": "fast"}})


def show(browser: Browser, view: str) -> None:
    """That one, when there is something in it."""
    browser.js(f"document.getElementById('tab-{view}').click()")
    rows = {"robots": "#cards a", "set": "#settings div", "status": "#parts li"}
    if row := rows.get(view):
        there = f"document.querySelector({row!r}) !== null"
        until(lambda: browser.js(there), 5.0, row)


def _picture(browser: Browser, directory: Path, size: str, look: str, view: str) -> Path:
    browser.size(*SIZES[size], touch=size != "desktop", dark=look == "dark")
    show(browser, view)
    browser.js("new Promise(done => setTimeout(() => requestAnimationFrame(done), 300))")
    path = directory / f"{size}-{look}-{view}.png"
    browser.picture(path)
    return path


def main() -> None:
    for path in write(Path(sys.argv[1])):
        print(path)


if __name__ == "__main__":
    main()
