"""The screens of `top`, `fleet` and `drive`, and `top` as plain text.

A screen ends with a key or a signal. ^Z suspends it, and `fg` resumes.
"""

from __future__ import annotations

import errno
import io
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from acsard.core.values import AcsardError
from acsard.host.terminal_modes import one_by_one
from acsard.terminal.output import plain
from acsard.top.feed import Feed
from acsard.top.fleet import Fleet
from acsard.top.roster import table
from acsard.top.teleop import Teleop, lines
from acsard.top.view import screen

PERIOD_S = 0.25

LEAVES = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def once(feed: Feed) -> str:
    feed.ask()
    time.sleep(0.5)  # rates are averaged over this time
    feed.ask()
    _be_lenient()
    width = Console().width
    return plain(screen(feed.seen(), width), width=width)


def live(feed: Feed) -> None:
    """Show the screen and update it until a key or a signal."""
    # A failed query is no problem, because the screen says that it waits for a state.
    with suppress(AcsardError):
        feed.ask()
    console = Console()

    def draw() -> RenderableType:
        feed.poll()
        return screen(feed.seen("q quits"), *console.size)

    _hold(lambda suspend: _watch(draw, console, suspend))


def drive(step: Callable[[str], None], seen: Callable[[], Teleop]) -> None:
    """Pass the typed keys to `step`, "" if none, and show the result of `seen`, until a signal."""
    console = Console()
    _hold(lambda suspend: _steer(step, seen, console, suspend))


def roster(fleet: Fleet) -> None:
    """Show a line for each robot and update them until a key or a signal."""
    console = Console()

    def draw() -> RenderableType:
        rows = fleet.rows()
        width, height = console.size
        told = [Text(line, no_wrap=True) for line in table(rows, width, height - 2)]
        told[0].stylize("bold cyan")
        for line in told[1:]:
            if "GONE" in line.plain or "SILENT" in line.plain:
                line.stylize("bold red")
        below = f"q quits   {fleet.more or fleet.seen}" if rows else fleet.hint()
        last = Text(below.rstrip(), "dim", no_wrap=bool(rows), overflow="ellipsis")
        return Group(*told, Text(), last)

    _hold(lambda suspend: _watch(draw, console, suspend))


def _watch(draw: Callable[[], RenderableType], console: Console, suspend: list[bool]) -> bool:
    with keys() as read, _screen(console) as shown:
        while not suspend:
            shown.update(draw(), refresh=True)
            typed = read(PERIOD_S)
            if typed is None or "q" in typed.lower():
                return False
    return True


def _screen(console: Console) -> Live:
    return Live(
        console=console,
        screen=True,
        auto_refresh=False,
        redirect_stdout=False,
        redirect_stderr=False,
    )


def _hold(shows: Callable[[list[bool]], bool]) -> None:
    """Show a screen until a signal arrives or `shows` returns False.

    `shows` gets a list that becomes non-empty when the user presses ^Z. It must then leave its
    screen and return True, and is called again after `fg`.
    """
    _be_lenient()
    suspend: list[bool] = []
    signal.signal(signal.SIGTSTP, lambda *_: suspend.append(True))
    with until_told():
        while shows(suspend):
            suspend.clear()
            os.kill(os.getpid(), signal.SIGSTOP)  # suspend as ^Z does; fg resumes here


def _steer(
    step: Callable[[str], None],
    seen: Callable[[], Teleop],
    console: Console,
    suspend: list[bool],
) -> bool:
    """Pass the typed keys to `step`, "" if none, and show the screen.

    Return True at ^Z and False when the input ends.
    """
    with keys() as read, _screen(console) as shown:
        due = 0.0
        while not suspend:
            typed = read(0.05)
            if typed is None:
                return False
            step(typed)
            if typed or time.monotonic() >= due:
                due = time.monotonic() + PERIOD_S
                shown.update(Group(*lines(seen(), *console.size)), refresh=True)
    for letter in ("k", "", ""):
        step(letter)  # stop the robot: no steps run while suspended
    return True


def _be_lenient() -> None:
    """Replace characters that the terminal's encoding lacks, instead of failing."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


@contextmanager
def until_told() -> Iterator[None]:
    """End the block at the first terminating signal, or when its terminal closes.

    Later signals are ignored during the cleanup: a terminal that closes under a shell sends two,
    and Ctrl-C may be held down.
    """

    def deaf() -> None:
        for number in LEAVES:
            signal.signal(number, signal.SIG_IGN)

    def leave(*_: object) -> None:
        deaf()
        raise KeyboardInterrupt

    for number in LEAVES:
        signal.signal(number, leave)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        # The terminal was closed, so discard further output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        deaf()


@contextmanager
def keys() -> Iterator[Callable[[float], str | None]]:
    """Yield a function that waits up to a number of seconds for keys.

    The function returns "" if no key was typed, and None when the input has ended.
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
    with one_by_one():
        yield read
