"""Take pictures of the robot's page and of a recording's report, for people to look at.

`python -m tests.tools.pictures DIRECTORY` writes every view of the page as PNG: on a phone upright
and sideways and on a desktop, in light and dark colours, and the view *Drive* in each state. It
also writes the whole report of a drive, 1280 and 390 pixels wide. `--report` writes only that.
"""

from __future__ import annotations

import itertools
import random
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from acsard.core.config.settings import Config
from acsard.machine.authority import Authority
from tests.scenarios.taped import drive_through_faults, happenings, recorded_world, two_drivers
from tests.system.browser import NAME, TRUSTING, Page
from tests.system.camera_stream import Stream
from tests.system.chromium import DESKTOP, PHONE, SIDEWAYS, Browser, browsing
from tests.system.harness import Bus, Daemon, Peer, acsard, finish, plain_reply, until

VIEWS = ("drive", "status", "events", "set")

SIZES = {"phone": PHONE, "sideways": SIDEWAYS, "desktop": DESKTOP}

LOOKS = ("light", "dark")


def write(directory: Path, sizes: Sequence[str] = tuple(SIZES), *, both: bool = True) -> list[Path]:
    """Write the pictures, with names like `phone-dark-drive.png`, and return their paths.

    Dark pictures are written only if `both` is set. Fails if the page writes to the browser's
    console.
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
    """Open this view of the page, and wait until it has contents."""
    browser.js(f"document.getElementById('tab-{view}').click()")
    rows = {"set": "#settings div", "status": "#parts li"}
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


STANDS = """(mode => new MutationObserver((_, observer) => {
    if (mode.textContent !== "SHUTDOWN") return;
    observer.disconnect();
    const [now, today] = [performance.now(), Date.now()];
    performance.now = () => now;
    Date.now = () => today;
}).observe(mode, {childList: true, subtree: true}))(document.getElementById("mode"))"""
"""Stops the page's clocks at SHUTDOWN, which otherwise gives way to NO DATA after half a second."""


class _States:
    """A browser that shows the view *Drive* in one state after the other."""

    def __init__(self, there: Path, browser: Browser, seen: Callable[[Browser, str], None]) -> None:
        self.there, self.browser, self.seen = there, browser, seen

    def capture(self, state: str, mode: str, hint: str = "") -> None:
        """Wait until the page shows this mode and hint, then call `seen` for the named state."""
        until(lambda: self.browser.text("mode") == mode, 10.0, mode)
        until(lambda: hint in self.browser.text("hint"), 10.0, hint)
        self.seen(self.browser, state)
        # A busy machine may have kept the robot's computer silent for a while.
        until(lambda: self.browser.text("mode") == mode, 5.0, f"{mode} to the end")

    def look_at_a_board(self) -> None:
        """Show the states of a robot whose board works, reports wrong speeds, or is unplugged."""
        browser, look = self.browser, self.capture
        with (
            Peer(self.there / "mcu") as board,
            Daemon(self.there, board.path) as daemon,
            Bus(daemon.endpoint) as bus,
            Page(daemon, self.there) as page,
        ):
            bus.linked()
            browser.open(page.here)
            look("ready", "READY")
            browser.hold(lambda: (bus.state()["linear"] or 0.0) > 0.15)
            browser.push(-30, 60)
            look("driving", "DRIVING")
            browser.lift()
            bus.at_rest()
            usual, board.reply = board.reply, lambda speeds: plain_reply((-speeds[0], *speeds[1:]))
            with bus.commanding(0.3):
                look("wheel-fault", "FAULT", "Fault")
                assert "wheel is left out" in browser.text("doubt")
                board.reply = usual
            bus.get("srv/clear")
            with bus.commanding(0.3):
                until(lambda: not bus.state()["wheel_fault"], 10.0, "the wheel counts again")
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
            board.reply = lambda speeds: plain_reply((99.0, 99.0, 99.0, 99.0))
            look("fault", "FAULT", "Fault")
            board.unplug()
            look("fault-no-board", "FAULT · NO BOARD", "The board is missing, too.")
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
            self.seen(browser, "stop-unconfirmed")

    def look_as_others(self) -> None:
        """Show a camera, a viewer's page, an incomplete page, and a daemon that ends."""
        browser, look, tls = self.browser, self.capture, self.there / "tls"
        Authority.make(tls, "test", 1, [NAME]).issue(tls, "robot", [NAME], 1)
        with closing(Stream()) as stream:
            config = {"web": {"camera": f"http://127.0.0.1:{stream.port}/stream"}}
            with Daemon(self.there, config=config) as daemon, Page(daemon, self.there) as page:
                frozen = "document.getElementById('camera').matches('.frozen')"
                browser.open(page.here)
                until(lambda: browser.js(frozen) is False, 10.0, "the picture lives")
                look("camera", "READY")
                stream.silent = True
                until(lambda: browser.js(frozen), 5.0, "the picture is frozen")
                look("camera-frozen", "READY")
                stream.silent = False
                browser.open(f"{page.away}/#token={page.invite('viewer', 'tv')}")
                look("viewer", "READY", "You may watch and stop")
                page.vault.revoke("tv")
                until(lambda: "not valid" in browser.text("reason"), 10.0, "the invitation ends")
                browser.tap("stop")
                until(lambda: "invitation" in browser.text("alarm"), 5.0, "STOP is refused")
                look("invitation-ended", "NO CONNECTION")
                browser.ask("Network.enable")
                browser.ask("Network.setCacheDisabled", cacheDisabled=True)
                browser.ask("Network.setBlockedURLs", urls=["*/page/map.js"])
                browser.open(page.here)
                until(lambda: "Reload the page" in browser.text("alarm"), 10.0, "a file is missing")
                self.seen(browser, "file-missing")
                browser.ask("Network.setBlockedURLs", urls=[])
                browser.open(page.here)
                until(lambda: browser.text("mode") == "READY", 10.0, "the page is whole")
                browser.js(STANDS)
                daemon.signal(signal.SIGTERM)
                until(lambda: browser.text("mode") == "SHUTDOWN", 10.0, "the daemon ends")
                page.signal(signal.SIGSTOP)  # its server would report that the daemon is gone
                try:
                    look("shutdown", "SHUTDOWN", "is ending")
                finally:
                    page.signal(signal.SIGCONT)

    def look_at_no_board(self) -> None:
        """Show the page of a robot without a board."""
        with (
            Daemon(self.there, self.there / "none", name="bare") as daemon,
            Page(daemon, self.there) as page,
        ):
            self.browser.open(page.here)
            self.capture("no-board", "NO BOARD")


def states(on_state: Callable[[Browser, str], None]) -> None:
    """Call `on_state(browser, name)` for each state of the view *Drive* on a phone.

    The robot and the page stay in the state until `on_state` returns.
    """
    with tempfile.TemporaryDirectory() as place, browsing(options=TRUSTING) as browser:
        browser.size(*PHONE)
        screen = _States(Path(place), browser, on_state)
        screen.look_at_a_board()
        screen.look_as_others()
        screen.look_at_no_board()


DRAWN = "document.querySelectorAll('.js-plotly-plot:has(.main-svg)').length"


def report(directory: Path) -> list[Path]:
    """Write the pictures of a drive's report, with names like `report-phone-dark.png`."""
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place, browsing() as browser:
        drawn = Path(place) / "drive.html"
        recorded = _recorded(Path(place) / "drive.rec.zst")
        done = finish(acsard("recording", "report", str(recorded), str(drawn)), place)
        assert done.code == 0, done
        browser.ask("Emulation.setScrollbarsHidden", hidden=True)
        written = []
        for size, look in itertools.product(("phone", "desktop"), LOOKS):
            browser.size(*SIZES[size], touch=size != "desktop", dark=look == "dark")
            browser.open(drawn.as_uri())
            until(lambda: browser.js(DRAWN) == 2, 30.0, "all pictures")
            browser.js("new Promise(done => setTimeout(() => requestAnimationFrame(done), 500))")
            written.append(directory / f"report-{size}-{look}.png")
            browser.picture(written[-1], whole=True)
        assert browser.said == [], browser.said
        return written


def _recorded(path: Path) -> Path:
    """Record two minutes of driving by two clients, with a stop, lost links and wheel faults."""
    tape, world = recorded_world(Config())
    two_drivers(world)
    happenings(world, random.Random(1))
    drive_through_faults(world, 100.0)
    return tape.save(path)


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
