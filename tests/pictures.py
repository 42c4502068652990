"""Take pictures of the robot's page and of a recording's report, for people to look at.

`python -m tests.pictures DIRECTORY` writes every view of the page as PNG: on a phone upright and
sideways and on a desktop, in light and dark colours, and the view *Drive* in each state. It also
writes the whole report of a drive, 1280 and 390 pixels wide. `--report` writes the report alone.
"""

from __future__ import annotations

import itertools
import random
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from acsard.core.config.settings import Config
from tests.scenarios.taped import Tape, drive_through_faults, happenings
from tests.scenarios.world import World
from tests.system.browser import Page
from tests.system.chromium import DESKTOP, PHONE, SIDEWAYS, Browser, browsing
from tests.system.harness import PLAIN, Bus, Daemon, Peer, acsard, finish, until
from tests.unit.report.driven import two_drivers

VIEWS = ("drive", "status", "events", "set", "robots")

SIZES = {"phone": PHONE, "sideways": SIDEWAYS, "desktop": DESKTOP}

LOOKS = ("light", "dark")


def write(directory: Path, sizes: Sequence[str] = tuple(SIZES), *, both: bool = True) -> list[Path]:
    """Write the pictures, with names like `phone-dark-drive.png`, and return their paths.

    Only light ones are written unless `both` is set. Console output of the page is an error.
    """
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
            for look in (LOOKS if both else LOOKS[:1])
            for view in VIEWS
        ]
        assert browser.said == [], browser.said
        return written


def _drive(bus: Bus) -> None:
    """Drive a path for the map, and cause a refused command."""
    bus.linked()
    for angular, key, target in ((0.0, "x", 0.6), (0.8, "yaw", 1.5), (0.0, "y", 1.2)):
        with bus.commanding(0.4, angular):
            until(lambda k=key, t=target: bus.state()[k] > t, 10.0, f"{key} over {target}")  # type: ignore[misc]
    bus.at_rest()
    bus.put("cmd/app", {"linear": {"x": "fast"}})


def show(browser: Browser, view: str) -> None:
    """Take that one picture if the view has contents."""
    browser.js(f"document.getElementById('tab-{view}').click()")
    rows = {"robots": "#cards a", "set": "#settings div", "status": "#parts li"}
    if row := rows.get(view):
        there = f"document.querySelector({row!r}) !== null"
        until(lambda: browser.js(there), 5.0, row)


def _picture(
    browser: Browser, directory: Path, size: str, look: str, view: str, name: str = ""
) -> Path:
    browser.size(*SIZES[size], touch=size != "desktop", dark=look == "dark")
    show(browser, view)
    browser.js("new Promise(done => setTimeout(() => requestAnimationFrame(done), 300))")
    path = directory / f"{size}-{look}-{name or view}.png"
    browser.picture(path)
    return path


def states(seen: Callable[[Browser, str], None]) -> None:
    """Call `seen` with a page that shows the view *Drive*, in each state, and the state's name.

    Each time the robot and the page stay in that state until `seen` returns.
    """
    with (
        tempfile.TemporaryDirectory() as place,
        Peer(Path(place) / "mcu") as board,
        browsing() as browser,
    ):
        there = Path(place)

        def look(state: str, mode: str, hint: str = "") -> None:
            until(lambda: browser.text("mode") == mode, 10.0, mode)
            until(lambda: hint in browser.text("hint"), 10.0, hint)
            seen(browser, state)

        with (
            Daemon(there, board.path) as daemon,
            Bus(daemon.endpoint) as bus,
            Page(daemon, there) as page,
        ):
            bus.linked()
            browser.size(*PHONE)
            browser.open(page.here)
            look("ready", "READY")
            browser.hold(lambda: (bus.state()["linear"] or 0.0) > 0.15)
            browser.push(-30, 60)
            look("driving", "DRIVING")
            browser.lift()
            bus.at_rest()
            with bus.commanding(0.2):
                look("program-drives", "DRIVING")
            with bus.commanding(0.2, source="teleop"):
                look("another-drives", "DRIVING", "drives")
            bus.at_rest()
            bus.get("srv/stop")
            look("stopped", "STOPPED", "Stopped")
            bus.get("srv/clear")
            bus.get("srv/deactivate")
            look("inactive", "INACTIVE", "Switched off")
            bus.get("srv/activate")
            usual, board.reply = board.reply, lambda speeds: PLAIN((99.0, 99.0, 99.0, 99.0))
            look("fault", "FAULT", "Fault")
            board.unplug()
            look("fault-no-board", "FAULT · NO BOARD", "Fault")
            daemon.signal(signal.SIGSTOP)
            try:
                look("no-data", "NO DATA", "Nothing is received")
            finally:
                daemon.signal(signal.SIGCONT)
            # Zenoh closes this session after 2 s of silence. It may connect later than the page.
            until(lambda: bus.ask("state"), 10.0, "the bus answers again")
            board.plug()
            board.reply = usual
            until(lambda: browser.text("mode") == "FAULT", 10.0, "the board is back")
            bus.get("srv/clear")
            look("ready-again", "READY")
            board.unplug()
            look("cable-pulled", "NO BOARD", "No board")
            page.process.kill()
            look("no-connection", "NO CONNECTION", "No connection")
            browser.tap("stop")
            until(lambda: "sends it again" in browser.text("alarm"), 5.0, "STOP is not confirmed")
            seen(browser, "stop-unconfirmed")
        with Daemon(there) as daemon, Page(daemon, there) as page:
            browser.open(f"{page.here}/?robot=r2")
            look("another-robot", "WAITING")
            browser.ask("Network.enable")
            browser.ask("Network.setCacheDisabled", cacheDisabled=True)
            browser.ask("Network.setBlockedURLs", urls=["*/page/map.js"])
            browser.open(page.here)
            until(lambda: "Reload the page" in browser.text("alarm"), 10.0, "a file is missing")
            seen(browser, "file-missing")
            browser.ask("Network.setBlockedURLs", urls=[])
        (bare := there / "bare").mkdir()
        with Daemon(bare, bare / "none") as daemon, Page(daemon, bare) as page:
            browser.open(page.here)
            look("no-board", "NO BOARD")


DRAWN = "document.querySelectorAll('.picture.js-plotly-plot .main-svg').length"


def report(directory: Path) -> list[Path]:
    """Write the pictures of a drive's report, with names like `report-phone-dark.png`."""
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place, browsing() as browser:
        drawn = Path(place) / "drive.html"
        recorded = _recorded(Path(place) / "drive.mcap")
        done = finish(acsard("recording", "report", str(recorded), str(drawn)), place)
        assert done.code == 0, done
        browser.ask("Emulation.setScrollbarsHidden", hidden=True)
        written = []
        for size, look in itertools.product(("phone", "desktop"), LOOKS):
            browser.size(*SIZES[size], touch=size != "desktop", dark=look == "dark")
            browser.open(drawn.as_uri())
            until(lambda: browser.js(DRAWN) >= 7, 30.0, "all pictures")
            browser.js("new Promise(done => setTimeout(() => requestAnimationFrame(done), 500))")
            written.append(directory / f"report-{size}-{look}.png")
            browser.picture(written[-1], whole=True)
        assert browser.said == [], browser.said
        return written


def _recorded(path: Path) -> Path:
    """Record two minutes: two clients drive, one is stopped, and links and wheels fail."""
    tape = Tape()
    world = World(Config(), recorder=tape)
    two_drivers(world)
    happenings(world, random.Random(1))
    drive_through_faults(world, 100.0)
    tape.write(path, Config())
    return path


def main() -> None:
    *words, name = sys.argv[1:]
    directory = Path(name)

    def draw(browser: Browser, state: str) -> None:
        for size, look in itertools.product(SIZES, LOOKS):
            print(_picture(browser, directory, size, look, "drive", state))

    if words != ["--report"]:
        for path in write(directory):
            print(path)
        states(draw)
    for path in report(directory):
        print(path)


if __name__ == "__main__":
    main()
