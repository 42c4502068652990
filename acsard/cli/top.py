"""`acsard top`: the robot on one screen, live.

What it knows of the robot is in `top.feed`, what the screen looks like in `top.view`.
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.host.errors import MendableError
from acsard.host.exits import Exit, ExitError

if TYPE_CHECKING:
    from rich.console import Console

    from acsard.top.feed import Feed

PERIOD_S = 0.25

ONCE_S = 0.5
"""Rates are taken over this with --once, where a person waits for it."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "top",
        help="the robot on one screen, live",
        description="Show mode, pose, wheels, command sources, link and timing on one screen, "
        "live; q or Ctrl-C leaves. Into a pipe, or with --once, print one screen as plain text. "
        "Needs the extra: pip install 'acsard[top]'.",
    )
    parser.add_argument("--once", action="store_true", help="print one screen and end")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Show until told otherwise."""
    try:
        from acsard.top import view  # noqa: F401
    except ImportError:
        raise ExitError(
            Exit.FAILURE, "needs the library rich; run: pip install 'acsard[top]'"
        ) from None
    from acsard.client import connect
    from acsard.top.feed import Feed

    endpoint, robot_id, tls = robot_address(args)
    dumb = os.environ.get("TERM", "dumb") in ("dumb", "unknown", "")
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        feed = Feed(robot, endpoint, robot_id)
        if args.once or dumb or not sys.stdout.isatty():
            return _once(feed)
        return _live(feed)


def _once(feed: Feed) -> int:
    from rich.console import Console

    from acsard.top.view import screen

    feed.ask()
    time.sleep(ONCE_S)
    feed.ask()
    _be_lenient()
    console = Console(color_system=None, force_terminal=False)
    with console.capture() as captured:
        console.print(screen(feed.seen(), console.width))
    print("\n".join(line.rstrip() for line in captured.get().splitlines()))
    return 0


def _live(feed: Feed) -> int:
    from rich.console import Console

    with suppress(MendableError):  # it may come by itself; the screen says that it waits
        feed.ask()
    _be_lenient()
    console, suspend = Console(), []
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # leave as by Ctrl-C
    signal.signal(signal.SIGTSTP, lambda *_: suspend.append(True))
    try:
        while _watch(feed, console, suspend):
            suspend.clear()
            os.kill(os.getpid(), signal.SIGSTOP)  # ^Z: the terminal is as it was; fg goes on
    except KeyboardInterrupt:
        pass
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        # The terminal has been closed: nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _watch(feed: Feed, console: Console, suspend: list[bool]) -> bool:
    """Show until a key or ^Z; True for ^Z."""
    from rich.live import Live

    from acsard.top.view import screen

    with (
        _keys() as pressed,
        Live(
            console=console,
            screen=True,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
        ) as live,
    ):
        while not suspend:
            feed.poll()
            width, height = console.size
            live.update(screen(feed.seen("q leaves"), width, height), refresh=True)
            if pressed(PERIOD_S):
                return False
    return True


@contextmanager
def _keys() -> Iterator[Callable[[float], bool]]:
    """Keys come one by one and unseen; yields what waits for one that means to leave."""
    import termios
    import tty

    def pressed(seconds: float) -> bool:
        if not sys.stdin.isatty():
            time.sleep(seconds)
            return False
        ready, _, _ = select.select([sys.stdin], [], [], seconds)
        if not ready:
            return False
        keys = os.read(sys.stdin.fileno(), 64)
        return not keys or b"q" in keys.lower()

    if not sys.stdin.isatty():
        yield pressed
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield pressed
    finally:
        try:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
        except (OSError, termios.error):
            pass  # the terminal has been closed


def _be_lenient() -> None:
    """A terminal without a sign of ours shows another in its place."""
    import io

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
