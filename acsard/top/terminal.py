"""A person's terminal: one screen after the other, keys, ^Z, and what is left as it was."""

from __future__ import annotations

import errno
import io
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.live import Live

from acsard.top.feed import Feed
from acsard.top.view import screen
from acsard.values import AcsardError

PERIOD_S = 0.25

ONCE_S = 0.5
"""Rates are taken over this with --once, where a person waits for it."""


def once(feed: Feed) -> str:
    """One screen as plain text."""
    feed.ask()
    time.sleep(ONCE_S)
    feed.ask()
    _be_lenient()
    console = Console(color_system=None, force_terminal=False)
    with console.capture() as captured:
        console.print(screen(feed.seen(), console.width))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def live(feed: Feed) -> None:
    """Show the screen, and what changes, until a key or a signal."""
    with suppress(AcsardError):  # it may come by itself; the screen says that it waits
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


def _watch(feed: Feed, console: Console, suspend: list[bool]) -> bool:
    """Show until a key or ^Z; True for ^Z."""
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
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
