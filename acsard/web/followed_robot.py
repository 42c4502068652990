"""Connects to the daemon of the page's robot, follows its state and the keys of the viewers, and
detects silence.

This work has a thread of its own, which may wait for the bus. The event loop reads its results, and
judges the silence by the time of the last state, because the thread itself may hang. A query has
another thread: a daemon that hangs lets it wait for seconds.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial

import msgspec
import zenoh
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.tls_files import shown_at
from acsard.client.connection import Connection
from acsard.client.follower import UNREADABLE, Watch, restarted
from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import Config
from acsard.core.messages.schema import Info, RobotState
from acsard.core.values import AcsardError
from acsard.host import clock
from acsard.host.errors import UnreachableError
from acsard.host.threads import NoThreadError, Worker, in_thread
from acsard.web.metrics import Counts
from acsard.web.streams import Streams

PROCESS_PERIOD_S = 0.05

# After a failed attempt to connect.
RETRY_DELAY_S = 1.0

# Between two queries of `About`: after an answer, and after none.
ABOUT_PERIOD_S, ABOUT_RETRY_S = 10.0, 1.0

# Of the drawn path: age and number of its points, and the least distance of two.
PATH_S, PATH_POINTS, PATH_STEP_M = 600.0, 5000, 0.05

# No robot drives so far between two states: its pose was set, and the path begins again.
PATH_JUMP_M = 1.0

# Blocks until the daemon is connected. Raises `UnreachableError`.
Connect = Callable[[], Connection]


class About(Struct, frozen=True):
    """Facts about the daemon and its robot, from its keys `info` and `config`."""

    version: str
    simulated: bool
    linear: float  # highest speed, m/s
    angular: float  # rad/s
    state_hz: float
    recordings: str  # directory on the daemon's machine; "" if it records nothing
    timeouts: Mapping[str, float]  # of the command sources, s

    @classmethod
    def of(cls, version: str, simulated: bool, config: Config) -> About:
        return cls(
            version,
            simulated,
            config.limits.linear_speed,
            config.limits.angular_speed,
            config.rates.state_hz,
            config.record.directory,
            {source.name: source.timeout for source in config.commands.sources},
        )


class PathHistory:
    """The path of the last ten minutes."""

    def __init__(self) -> None:
        # Time, s, and position, m.
        self._points = deque[tuple[float, float, float]](maxlen=PATH_POINTS)
        self._last: tuple[float, float] | None = None

    def add(self, t: float, x: float, y: float) -> None:
        points, last = self._points, self._last
        self._last = x, y
        if last is not None and math.dist(last, (x, y)) > PATH_JUMP_M:
            points.clear()
        while points and t - points[0][0] > PATH_S:
            points.popleft()
        if not points or math.dist(points[-1][1:], (x, y)) >= PATH_STEP_M:
            points.append((t, x, y))

    def points(self) -> list[tuple[float, float]]:
        """Return the points (x, y), m, in the order of time; the last is the newest position."""
        points = self._points.copy()  # another thread adds points meanwhile
        places = [(x, y) for _, x, y in points] + ([self._last] if self._last else [])
        return [(round(x, 3), round(y, 3)) for x, y in places]


class FollowedRobot:
    """The connection to the daemon of the page's robot, and the data for a newly opened page.

    `about` comes from the local configuration until the daemon answers.
    """

    def __init__(self, address: Address, connect: Connect, about: About, counts: Counts) -> None:
        self.id, self.endpoint = address.robot_id, address.endpoint
        # Common name of this server's TLS certificate, a part of the public names of all viewers.
        self.certificate = shown_at(address.endpoint, address.tls)
        self.about = about
        self.client: Connection | None = None
        self.streams = Streams()
        self._not_connected = f"no daemon answers at {address.endpoint} yet"
        self._watch: Watch | None = None
        self.state: RobotState | None = None  # the newest one
        self.path = PathHistory()  # in the odom frame
        self._connect, self._counts = connect, counts
        self._about_due_s, self._is_leaving = 0.0, False

    @property
    def gone(self) -> str:
        """Why the robot is not reachable, or ""."""
        watch = self._watch
        if watch is None:
            return self._not_connected
        is_silent = watch.silent(clock.steady_s())
        if is_silent and watch.unreadable:
            return UNREADABLE
        if not watch.is_confirmed:
            return self._not_connected
        if is_silent:
            return (
                f"nothing is received from the daemon at {self.endpoint}: does the "
                "daemon run? `acsard doctor` on the robot finds the cause"
            )
        return ""

    async def run(self) -> None:
        """Follow the robot until cancelled. Raises `MendableError` if it cannot be followed."""
        try:
            await in_thread(self._run, None)
        finally:
            self._is_leaving = True

    def refresh_about(self) -> None:
        """Query `about` before the next regular query."""
        self._about_due_s = 0.0

    def _run(self) -> None:
        while self.client is None:
            try:
                self.client = self._connect()
            except UnreachableError as error:
                self._not_connected = str(error)
                time.sleep(RETRY_DELAY_S)
        watch, query = Watch(self.client, clock.steady_s()), None
        self._watch = watch
        while not self._is_leaving:
            self.streams.update(self.client)
            now = clock.steady_s()
            self._look(watch, now)
            is_free = query is None or not query.is_alive()
            if is_free and not self.gone and now >= self._about_due_s:
                self._about_due_s = now + ABOUT_PERIOD_S
                query = Worker("about", partial(self._query_about, self.client))
                with suppress(NoThreadError):
                    query.start()
            time.sleep(PROCESS_PERIOD_S)

    def _look(self, watch: Watch, now: float) -> None:
        was_gone, unreadable = bool(self.gone), watch.unreadable
        with suppress(zenoh.ZError):  # the session is closed, so the robot is silent
            for state in watch.poll(now):
                if restarted(self.state, state):
                    self.path = PathHistory()
                self.path.add(now, state.x, state.y)
                self.state = state
        if watch.unreadable > unreadable:
            self._counts.add("unreadable", watch.unreadable - unreadable)
        if was_gone and not self.gone:
            self.refresh_about()

    def _query_about(self, client: Connection) -> None:
        try:
            info: Info = client.get("info")
            config = from_builtins(client.get("config"))
            self.about = About.of(info.version, info.simulated, config)
        except (AcsardError, msgspec.MsgspecError, zenoh.ZError):
            self._about_due_s = clock.steady_s() + ABOUT_RETRY_S
