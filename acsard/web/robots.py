"""Connects to the daemon of the page's robot, follows the robot's state, and detects silence."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import msgspec
import zenoh
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.tls import shown_at
from acsard.client import Client
from acsard.client.follower import Watch, restarted
from acsard.core.config.settings import RatesConfig
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Info, PoseStamped, RobotState, Twist, TwistStamped
from acsard.core.thinning import Place, Track
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.errors import MendableError, UnreachableError
from acsard.host.threads import NoThreadError, in_thread
from acsard.web.last_minute import Minute, Plotted
from acsard.web.metrics import Counts
from acsard.web.streams import DECLARE_TIMEOUT_S, NOT_READY_ERRORS, Stream, Streams

PROCESS_PERIOD_S = 0.1
"""Interval at which the server processes the states that have arrived, s."""

RETRY_DELAY_S = 1.0
"""Delay before the next attempt to reach a daemon that does not answer, s."""

ABOUT_PERIOD_S, ABOUT_RETRY_S = 10.0, 1.0
"""Delay before the next query of the values of `About`, s: after a query that the daemon has
answered (`ABOUT_PERIOD_S`), and after a query without an answer (`ABOUT_RETRY_S`)."""

PATH_S, PATH_POINTS, PATH_STEP_M = 600.0, 5000, 0.02
"""Limits of the path that the page draws: maximum age of a point, s (`PATH_S`), maximum number of
points (`PATH_POINTS`), and minimum distance between two points, m (`PATH_STEP_M`)."""

T = TypeVar("T")

Connect = Callable[[], Client]
"""Function that connects to the daemon, and blocks until it is connected. It raises
`UnreachableError` if the daemon is not reachable."""


class About(Struct, frozen=True):
    """Facts about the daemon and its robot, from its keys `info` and `config`."""

    version: str
    simulated: bool
    linear: float
    """Highest forward speed, m/s."""
    angular: float
    """Highest turn rate, rad/s."""
    state_hz: float
    recordings: str
    """Directory of the black box on the daemon's machine; "" if the daemon records nothing."""
    timeouts: Mapping[str, float]
    """Timeout of each command source, s, by the name of the source."""


def _path() -> Track:
    # The last argument, 1 m, is the longest step of a path. No robot drives 1 m between two states.
    # So a longer step means that the pose was set, and the path restarts.
    return Track(PATH_POINTS, PATH_STEP_M, PATH_S, 1.0)


class _TaskQueries:
    """Bus client for a `Watch`. Its queries run in threads, so the event loop never waits."""

    def __init__(self, client: Client) -> None:
        self.subscribe, self._client = client.subscribe, client
        self._asked: asyncio.Task[None] | None = None

    def start_query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        if self._asked is None or self._asked.done():
            self._asked = asyncio.create_task(self._query(name, take))

    async def _query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        with suppress(*NOT_READY_ERRORS):
            await in_thread(lambda: self._client.start_query(name, take), None)


class Robots:
    """The connection to the daemon of the page's robot, and the data for a newly opened page."""

    def __init__(self, address: Address, connect: Connect, about: About, counts: Counts) -> None:
        """Create an instance without a connection. `run()` connects to the daemon.

        `about` contains values from the local configuration, which are used until the daemon
        answers.
        """
        self.id, self.endpoint = address.robot_id, address.endpoint
        self.certificate = shown_at(address.endpoint, address.tls)
        """Common name of the TLS certificate with which this server connects to the bus; "" without
        TLS. It is a part of the public names of all viewers."""
        self.about = about
        self.client: Client | None = None
        self.streams = Streams()
        self.gone = f"no daemon answers at {address.endpoint} yet"
        """Reason why the robot is not reachable, in words; "" while it is reachable."""
        self._connect, self._counts = connect, counts
        self._paths = {"path": _path(), "truth": _path()}
        self._minute = Minute()
        self._poses, self._wishes = Decoder(PoseStamped), Decoder(TwistStamped)
        self._refresh_requested = asyncio.Event()
        self._watch: Watch | None = None

    async def run(self) -> None:
        """Connect to the robot's daemon, and process the robot's states until cancelled.

        While the daemon is not reachable, try again every `RETRY_DELAY_S`. Raises `MendableError`
        if the connection fails for a reason that another attempt cannot change.
        """
        client = self.client = await self._reached()
        asking = asyncio.create_task(self._ask_again_and_again())

        def watch() -> Watch:
            return Watch(_TaskQueries(client), clock.steady_s())

        try:
            await self._follow(
                await self._retried(lambda: in_thread(watch, DECLARE_TIMEOUT_S, Watch.end))
            )
        finally:
            asking.cancel()

    @property
    def state(self) -> RobotState | None:
        """The newest state of the robot, or None before the first state."""
        return None if self._watch is None else self._watch.state

    def refresh_about(self) -> None:
        """Query the values of `about` from the daemon now, before the next regular query."""
        self._refresh_requested.set()

    def paths(self) -> dict[str, list[tuple[float, float]]]:
        """Return the points (x, y) of two paths in the last ten minutes, m, by name of the path.

        "path" is the robot's path in the odom frame. "truth" is the true path of a simulated robot,
        and is empty for a real robot.
        """
        return {
            name: [(round(place.x, 3), round(place.y, 3)) for place in path.places()]
            for name, path in self._paths.items()
        }

    def minute(self) -> Plotted:
        return self._minute.plotted(clock.steady_ns())

    async def _reached(self) -> Client:
        while True:
            try:
                return await in_thread(self._connect, None)
            except UnreachableError as error:
                self.gone = str(error)
            except NoThreadError as error:
                self.gone = f"{error}; the page tries again by itself"
            await asyncio.sleep(RETRY_DELAY_S)

    async def _retried(self, call: Callable[[], Awaitable[T]]) -> T:
        while True:
            try:
                return await call()
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
                truth = await self._retried(self._truth)
            if truth is not None:
                self._take_truth(truth, now_ns)
            await asyncio.sleep(PROCESS_PERIOD_S)

    def _take(self, before: RobotState | None, state: RobotState, now_ns: int) -> None:
        if restarted(before, state):
            self._paths = {name: _path() for name in self._paths}
        self._paths["path"].add(Place(now_ns / NS_PER_S, state.x, state.y, state.yaw))
        if self._minute.due(now_ns):
            self._minute.add(now_ns, state, self._wished(now_ns))

    def _wished(self, now_ns: int) -> Twist | None:
        """Return the newest twist that the robot was commanded to drive, after the limits.

        Return None if no viewer is subscribed to `cmd_vel_out`, if the newest twist is older than
        2 s, or if it cannot be decoded.
        """
        stream = self.streams.followed("cmd_vel_out")
        raw = None if stream is None else stream.raw()
        # A twist that is older than 2 s does not belong to the row that is plotted now.
        if stream is None or raw is None or now_ns - stream.at_ns > 2 * NS_PER_S:
            return None
        try:
            return self._wishes.decode(*raw).twist
        except DecodeError:
            return None

    async def _truth(self) -> Stream:
        assert self.client is not None
        return await self.streams.follow(self.client, "sim/pose")

    def _take_truth(self, truth: Stream, now_ns: int) -> None:
        raw = truth.raw()
        if raw is None:
            return
        try:
            at = self._poses.decode(*raw).pose.position
        except DecodeError:
            return
        self._paths["truth"].add(Place(now_ns / NS_PER_S, at.x, at.y, 0.0))

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
