"""`acsard top`: the robot on one screen, live.

It subscribes to `state` and to nothing else: it costs the daemon what one reader of `state` does.
What the screen looks like is in `top_view`.
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.runtime.exits import Exit, ExitError

if TYPE_CHECKING:
    import zenoh
    from rich.console import Console

    from acsard.cli.top_view import Seen
    from acsard.client import Client
    from acsard.messages.schema import Info, RobotState

PERIOD_S = 0.25
SPAN_S = 1.0
"""Rates are taken over about this; over less they would jump."""

ONCE_S = 0.5
"""The same with --once, where a person waits for it."""

FIRST_S = 3.0
"""How long --once waits for a state."""

STEADY = ("lines", "lines_sent", "commands")
"""Counters that only a new daemon has smaller."""


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
        from acsard.cli import top_view  # noqa: F401
    except ImportError:
        raise ExitError(
            Exit.FAILURE, "needs the library rich; run: pip install 'acsard[top]'"
        ) from None
    from acsard.client import connect

    endpoint, robot_id, tls = robot_address(args)
    dumb = os.environ.get("TERM", "dumb") in ("dumb", "unknown", "")
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        feed = Feed(robot, endpoint, robot_id)
        if args.once or dumb or not sys.stdout.isatty():
            return _once(feed)
        return _live(feed)


class Feed:
    """What has come of a robot's state so far."""

    def __init__(self, robot: Client, endpoint: str, robot_id: str) -> None:
        from acsard.messages.encodings import Decoder
        from acsard.messages.schema import RobotState

        self._robot, self._endpoint, self._id = robot, endpoint, robot_id
        self._decoder = Decoder(RobotState)
        # The first question also finds out whether anybody is there, in the words of all verbs.
        self._info = self._ask_info()
        self._samples = robot._subscribe("state")
        self._past: deque[tuple[float, RobotState]] = deque()
        self._heard = time.monotonic()
        self._undecodable = 0

    @property
    def any(self) -> bool:
        """There is a state to show."""
        return bool(self._past)

    def poll(self) -> None:
        """Take what has come since."""
        state = self._newest()
        if state is None:
            return
        now = time.monotonic()
        if self._past and anew(self._past[-1][1], state):
            self._past.clear()
            self._refresh_info()
        self._past.append((now, state))
        self._heard = now
        while len(self._past) > 2 and now - self._past[1][0] >= SPAN_S:
            self._past.popleft()

    def seen(self, hint: str = "") -> Seen:
        """What there is to show."""
        from acsard.cli.top_view import Seen

        return Seen(
            self._id,
            self._endpoint,
            self._past[-1][1] if self._past else None,
            self._past[0][1] if self._past else None,
            time.monotonic() - self._heard,
            self._info,
            self._undecodable,
            hint,
        )

    def _newest(self) -> RobotState | None:
        from acsard.client import QUEUED
        from acsard.messages.encodings import DecodeError

        waiting: list[zenoh.Sample] = []
        for _ in range(QUEUED):  # no flood holds up the screen
            sample = self._samples.try_recv()
            if sample is None:
                break
            if str(sample.key_expr) == self._robot.key("state"):  # else a put on a wildcard
                waiting.append(sample)
        for sample in reversed(waiting):
            try:
                state = self._decoder.decode(str(sample.encoding), sample.payload.to_bytes())
            except DecodeError:
                self._undecodable += 1
            else:
                self._undecodable = 0
                return state
        return None

    def _ask_info(self) -> Info | None:
        from acsard.messages.encodings import DecodeError

        try:
            info: Info = self._robot.get("info")
            return info
        except DecodeError:
            return None  # of another version: it is only for the header

    def _refresh_info(self) -> None:
        try:
            self._info = self._ask_info()
        except ExitError:
            self._info = None


def anew(before: RobotState, state: RobotState) -> bool:
    """It is another daemon's than the state before: its counters began again."""
    return any(state.counters.get(name, 0) < before.counters.get(name, 0) for name in STEADY)


def _once(feed: Feed) -> int:
    from rich.console import Console

    from acsard.cli.top_view import screen

    end = time.monotonic() + FIRST_S
    while not feed.any:
        if time.monotonic() > end:
            raise ExitError(Exit.UNREACHABLE, f"no state for {FIRST_S:g} s; may you read it?")
        time.sleep(0.01)
        feed.poll()
    time.sleep(ONCE_S)
    feed.poll()
    _be_lenient()
    console = Console(color_system=None, force_terminal=False)
    with console.capture() as captured:
        console.print(screen(feed.seen(), console.width))
    print("\n".join(line.rstrip() for line in captured.get().splitlines()))
    return 0


def _live(feed: Feed) -> int:
    from rich.console import Console

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

    from acsard.cli.top_view import screen

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
