"""Shows the screens of the commands `acsard top`, `acsard fleet` and `acsard drive`.

A signal or the end of the input ends each screen. The key `q` also ends the screens of `top` and
`fleet`.

These commands run within `output_in_threads`. A terminal that does not read, for example over a
connection that hangs, delays neither the keys nor the zero commands at the end of a drive.
"""

from __future__ import annotations

import errno
import io
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from acsard.host import clock
from acsard.host.logs import Writer
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.output import MAX_TEXT_WIDTH, plain, show
from acsard.terminal.prompt import ended_by_signals
from acsard.top import drive_screen
from acsard.top.feed import Feed
from acsard.top.fleet_table import table
from acsard.top.keyboard import KeyboardDrive
from acsard.top.roster import Roster
from acsard.top.screen import screen

DRAW_PERIOD_S = 0.25  # of the small screen of `drive`

# A screen of tables takes 8 ms of processor time on a PC, and several times that on a small board.
TABLES_PERIOD_S = 0.5

# Longest wait for a key before `acsard drive` does its other work.
KEY_POLL_S = 0.05


def one_screen(feed: Feed) -> str:
    feed.wait()
    _be_lenient()
    width = Console().width
    return plain(screen(feed.screen_data(), width), width=width)


def show_live(feed: Feed) -> None:
    """Show the screen of `acsard top` until `q` is typed, the input ends or a signal arrives."""

    def draw(width: int, height: int) -> RenderableType:
        feed.poll()
        return screen(feed.screen_data("q quits"), width)

    _watch(draw)


def drive(ride: KeyboardDrive) -> None:
    """Drive the robot with the typed keys, until the input ends or a signal arrives."""
    _be_lenient()
    with until_signal(), keys() as read, _screen() as display:
        due = 0.0
        while (typed := read(KEY_POLL_S)) is not None:
            ride.step(typed)
            if (typed or time.monotonic() >= due) and _terminal_reads():
                due = time.monotonic() + DRAW_PERIOD_S
                display.update(drive_screen.screen(ride.screen_data()), refresh=True)


def print_last_report(ride: KeyboardDrive) -> None:
    """Wait until the robot has stopped, at most 2 s, and print a last report on a terminal."""
    # Without the wait, the report would say that the robot still moves, or that it still follows
    # the source of this drive. The daemon follows a source until its timeout, 0.25 s by default.
    left = clock.steady_s()
    while os.isatty(0) and os.isatty(1):
        ride.take()
        teleop, took = ride.screen_data(), clock.steady_s() - left
        rests = teleop.age < took and drive_screen.released(teleop)
        # A robot usually stops within 2 s, by its own deceleration ramp.
        if rests or took > 2.0:
            show(drive_screen.last_report(teleop), most=MAX_TEXT_WIDTH)
            return
        time.sleep(KEY_POLL_S)


def roster(fleet: Roster) -> None:
    """Show a table of robots until `q` is typed, the input ends or a signal arrives."""

    def draw(width: int, height: int) -> RenderableType:
        rows = fleet.rows()
        below = f"q quits   {fleet.presence_text}" if rows else fleet.hint()
        last = Text(below.rstrip(), "dim", no_wrap=bool(rows), overflow="ellipsis")
        return Group(table(rows, width, max(1, height - 4)), Text(), last)

    _watch(draw)


def _watch(draw: Callable[[int, int], RenderableType]) -> None:
    _be_lenient()
    with until_signal(), keys() as read, _screen() as display:
        while True:
            if _terminal_reads():
                display.update(draw(*display.console.size), refresh=True)
            typed = read(TABLES_PERIOD_S)
            if typed is None or "q" in typed.lower():
                return


def _terminal_reads() -> bool:
    return not isinstance(sys.stdout, Writer) or sys.stdout.is_idle


def _screen() -> Live:
    return Live(
        console=Console(),
        screen=True,
        auto_refresh=False,
        redirect_stdout=False,
        redirect_stderr=False,
    )


def _be_lenient() -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


@contextmanager
def until_signal() -> Iterator[None]:
    """End the `with` block when a signal arrives or the terminal closes.

    Further signals are ignored, also after it: two arrive when a terminal with a shell closes, and
    the second one must not interrupt the zeros that end a drive.
    """
    try:
        with ended_by_signals(restores=False):
            yield
    except KeyboardInterrupt:
        pass
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        # The terminal was closed, so discard further output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def keys() -> Iterator[Callable[[float], str | None]]:
    """Yield a function that waits for typed text: "" without any, None at the end of the input.

    If the input is not a terminal, it always waits and returns "".
    """

    def read(seconds: float) -> str | None:
        ready, _, _ = select.select([sys.stdin], [], [], seconds)
        if not ready:
            return ""
        return os.read(sys.stdin.fileno(), 64).decode(errors="replace") or None

    def nobody(seconds: float) -> str:
        time.sleep(seconds)
        return ""

    if not sys.stdin.isatty():
        yield nobody
        return
    with single_key_mode():
        yield read
