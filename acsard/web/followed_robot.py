"""Connects to the daemon of the page's robot, follows the robot's state, and detects silence."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import msgspec
import zenoh
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.tls import shown_at
from acsard.client.connection import Connection
from acsard.client.follower import Watch, restarted
from acsard.core.config.settings import RatesConfig
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Info, PoseStamped, RobotState, Twist, TwistStamped
from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock
from acsard.host.errors import MendableError, UnreachableError
from acsard.host.threads import NoThreadError, in_thread
from acsard.web.last_minute import Minute, Plotted
from acsard.web.metrics import Counts
from acsard.web.streams import (
    DECLARE_TIMEOUT_S,
    NOT_READY_ERRORS,
    RETRY_DELAY_S,
    Stream,
    Streams,
)

PROCESS_PERIOD_S = 0.1

# Between two queries of `About`: after an answer, and after none.
ABOUT_PERIOD_S, ABOUT_RETRY_S = 10.0, 1.0

# Of the drawn path: age and number of its points, and the least distance of two.
PATH_S, PATH_POINTS, PATH_STEP_M = 600.0, 5000, 0.05

# No robot drives so far between two states: its pose was set, and the path begins again.
PATH_JUMP_M = 1.0

T = TypeVar("T")

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
        places = [(x, y) for _, x, y in self._points] + ([self._last] if self._last else [])
        return [(round(x, 3), round(y, 3)) for x, y in places]


class _TaskQueries:
    def __init__(self, client: Connection) -> None:
        self.subscribe, self._client = client.subscribe, client
        self._asked: asyncio.Task[None] | None = None

    def start_query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        if self._asked is None or self._asked.done():
            self._asked = asyncio.create_task(self._query(name, take))

    async def _query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        with suppress(*NOT_READY_ERRORS):
            await in_thread(lambda: self._client.start_query(name, take), None)


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
        self.streams = Streams(lambda: self.client)
        # why the robot is not reachable, or ""
        self.gone = f"no daemon answers at {address.endpoint} yet"
        self._connect, self._counts = connect, counts
        self._paths = {"path": PathHistory(), "truth": PathHistory()}
        self._minute = Minute()
        self._poses, self._wishes = Decoder(PoseStamped), Decoder(TwistStamped)
        self._refresh_requested = asyncio.Event()
        self._watch: Watch | None = None

    async def run(self) -> None:
        """Connect to the robot's daemon again and again, and process its states until cancelled.

        Raises `MendableError` if another attempt cannot help.
        """
        client = self.client = await self._reached()
        asking = asyncio.create_task(self._ask_again_and_again())
        try:
            await self._follow(await self._watch_state(client))
        finally:
            asking.cancel()

    @property
    def state(self) -> RobotState | None:
        """Newest state, or None before the first."""
        return None if self._watch is None else self._watch.state

    def refresh_about(self) -> None:
        """Query `about` before the next regular query."""
        self._refresh_requested.set()

    def paths(self) -> dict[str, list[tuple[float, float]]]:
        """Return the paths of the last ten minutes, points (x, y) in m.

        "path" is the path in the odom frame, and "truth" the true one of a simulated robot.
        """
        return {name: path.points() for name, path in self._paths.items()}

    def minute(self) -> Plotted:
        return self._minute.plotted(clock.steady_ns())

    async def _reached(self) -> Connection:
        while True:
            try:
                return await in_thread(self._connect, None)
            except UnreachableError as error:
                self.gone = str(error)
            except NoThreadError as error:
                self.gone = f"{error}; the page tries again by itself"
            await asyncio.sleep(RETRY_DELAY_S)

    async def _watch_state(self, client: Connection) -> Watch:
        def watch() -> Watch:
            return Watch(_TaskQueries(client), clock.steady_s())

        while True:
            try:
                return await in_thread(watch, DECLARE_TIMEOUT_S, Watch.end)
            except NOT_READY_ERRORS as error:
                why = str(error) if isinstance(error, NoThreadError) else "the Zenoh bus is stuck"
                self.gone = f"{why}; the page tries again by itself"
                await asyncio.sleep(RETRY_DELAY_S)

    async def _follow(self, watch: Watch) -> None:
        self._watch, truth = watch, None
        while True:
            now_ns = clock.steady_ns()
            before, unreadable, now = watch.state, watch.unreadable, now_ns / NS_PER_S
            with suppress(zenoh.ZError):  # the session is closed, so the robot is silent
                for state in watch.poll(now):
                    self._take(before, state, now_ns)
                    before = state
            if watch.unreadable > unreadable:
                self._counts.add("unreadable", watch.unreadable - unreadable)
            quiet = watch.silent(now)
            if quiet and watch.unreadable:
                self.gone = (
                    "the daemon's state cannot be read: does the daemon run another version of "
                    "acsard? Use the same version here"
                )
            elif quiet and (watch.is_confirmed or not self.gone):
                self.gone = (
                    f"nothing is received from the daemon at {self.endpoint}: does the "
                    "daemon run? `acsard doctor` on the robot finds the cause"
                )
            elif watch.is_confirmed and not quiet and self.gone:
                self.gone = ""
                self.refresh_about()
            if self.about.simulated and truth is None:
                truth = self.streams.follow("sim/pose")
            if truth is not None:
                self._take_truth(truth, now_ns)
            await asyncio.sleep(PROCESS_PERIOD_S)

    def _take(self, before: RobotState | None, state: RobotState, now_ns: Ns) -> None:
        if restarted(before, state):
            self._paths = {name: PathHistory() for name in self._paths}
        self._paths["path"].add(now_ns / NS_PER_S, state.x, state.y)
        if self._minute.due(now_ns):
            self._minute.add(now_ns, state, self._wished(now_ns))

    def _wished(self, now_ns: Ns) -> Twist | None:
        stream = self.streams.followed("cmd_vel_out")
        raw = None if stream is None else stream.raw()
        # A twist that is older than 2 s does not belong to the row that is plotted now.
        if stream is None or raw is None or now_ns - stream.at_ns > 2 * NS_PER_S:
            return None
        try:
            return self._wishes.decode(*raw).twist
        except DecodeError:
            return None

    def _take_truth(self, truth: Stream, now_ns: Ns) -> None:
        raw = truth.raw()
        if raw is None:
            return
        try:
            at = self._poses.decode(*raw).pose.position
        except DecodeError:
            return
        self._paths["truth"].add(now_ns / NS_PER_S, at.x, at.y)

    async def _ask_again_and_again(self) -> None:
        while True:
            self._refresh_requested.clear()
            answered = await self._query_robot()
            try:
                async with asyncio.timeout(ABOUT_PERIOD_S if answered else ABOUT_RETRY_S):
                    await self._refresh_requested.wait()
            except TimeoutError:
                pass

    async def _query_robot(self) -> bool:
        client = self.client
        assert client is not None
        try:
            info: Info = await in_thread(lambda: client.get("info"), None)
            config: dict[str, Any] = await in_thread(lambda: client.get("config"), None)
            self.about = About(
                info.version,
                info.simulated,
                float(config["limits"]["linear_speed"]),
                float(config["limits"]["angular_speed"]),
                RatesConfig(telemetry=float(config["rates"]["telemetry"])).state_hz,
                str(config["record"]["directory"]),
                {
                    str(source["name"]): float(source["timeout"])
                    for source in config["commands"]["sources"]
                },
            )
        except (
            MendableError, NoThreadError, DecodeError, msgspec.MsgspecError, KeyError, TypeError,
            ValueError,
        ):  # fmt: skip
            return False
        return True
