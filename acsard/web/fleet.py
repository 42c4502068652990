"""The robots that the bus or router knows, one row each, tracked while a viewer looks at them."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any

import zenoh

from acsard.client import Client
from acsard.client.follower import FLEET_ASK_S
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Info, RobotState
from acsard.core.messages.topics import full_key
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.robot_discovery import ALL, robot_of
from acsard.daemon.bus.subscription import encoded
from acsard.host import clock
from acsard.host.threads import in_thread
from acsard.web.robots import Robots
from acsard.web.socket_messages import Row
from acsard.web.streams import DECLARE_S, STATE, UNREADY

MOST = 200
"""Maximum number of robots. The bound is needed because any client of the bus can invent robot
names."""

FORGET_NS = 30 * NS_PER_S
"""A robot that has been silent for longer is dropped, unless its liveliness token is present."""

ASK_NS = int(FLEET_ASK_S * NS_PER_S)
"""Interval between queries to a robot that has not reported its version."""

UNROUTED = (
    "this page sees only robots that are connected to the daemon of {robot}, because daemons "
    "forward no messages. To see all robots of a router, connect this page's server to the "
    "router: acsard web --connect ROUTER --id {robot}"
)
"""Note for a server that is connected to a daemon instead of a router."""

BY_NAME = (
    "{endpoint} passes only exact keys, as every TLS endpoint does, so no other robot is "
    "visible. To see all robots of a router, run this page's server on the router's machine: "
    "acsard web --connect tcp/127.0.0.1:7447 --id {robot}"
)
"""Note for a server that is connected over TLS, which limits it to its own robot."""

LONG = 40
"""Maximum number of characters of a version that the page shows."""


class _Known:
    """The state of one robot.

    Each value is replaced as a whole because Zenoh's threads write them.
    """

    def __init__(self, now_ns: int) -> None:
        self.newest: tuple[zenoh.Sample | None, int] = None, now_ns
        """The last state and its arrival time. Before the first state: None and the time of the
        first contact."""
        self.here: bool | None = None
        """Presence of the liveliness token; None if tokens are not visible, as over TLS."""
        self.version = ""
        self.asked_ns = now_ns - ASK_NS


class Fleet:
    """Tracks all robots for as long as at least one viewer has joined."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._joined: set[object] = set()
        self._known: dict[str, _Known] = {}
        self._states, self._infos = Decoder(RobotState), Decoder(Info)
        self._declared: list[Any] = []
        self._busy: set[asyncio.Task[None]] = set()
        self.note = ""
        """Explanation of why robots may be missing from the rows; "" if all robots of a router are
        visible."""

    def join(self, viewer: object) -> None:
        """Start tracking on behalf of this viewer."""
        self._joined.add(viewer)
        self._look()

    def leave(self, viewer: object) -> None:
        """Remove this viewer; the last one to leave ends the tracking."""
        self._joined.discard(viewer)
        self._tidy()

    def rows(self) -> list[Row]:
        """Return the rows sorted by robot id, and retry missing subscriptions and versions."""
        self._look()
        now_ns, rows = clock.mono_ns(), []
        for robot, one in sorted(self._known.copy().items()):
            if now_ns - one.newest[1] > FORGET_NS and not one.here:
                self._known.pop(robot, None)
            elif (row := self._row(robot, one, now_ns)) is not None:
                rows.append(row)
        return rows

    def sees(self, robot: str) -> bool:
        """Return whether a viewer sees that this robot exists.

        It sees the robot's liveliness token in the fleet, or its state.
        """
        one, states = self._known.get(robot), self._robots.streams.followed(robot, STATE)
        return bool(one and one.here) or bool(states and states.number)

    def _row(self, robot: str, one: _Known, now_ns: int) -> Row | None:
        sample, at_ns = one.newest
        if sample is None:
            gone = one.here is False
            mode, reason = ("gone", "its daemon has ended") if gone else (None, "")
            return Row(robot, mode, reason, None, "", None, one.version)
        try:
            state = self._states.decode(*encoded(sample))
        except DecodeError:
            return None
        age = round((now_ns - at_ns) / NS_PER_S, 3)
        if one.here is False:
            was = f"its daemon has ended; it was {state.mode}"
            return Row(robot, "gone", was, None, "", age, one.version)
        return Row(
            robot,
            state.mode,
            state.reason,
            state.linear,
            state.link,
            age,
            one.version,
            state.settings_differ,
        )

    # The methods below run on Zenoh's threads.

    def _of(self, sample: zenoh.Sample) -> _Known | None:
        robot = robot_of(str(sample.key_expr))
        if robot and (robot in self._known or len(self._known) < MOST):
            return self._known.setdefault(robot, _Known(clock.mono_ns()))
        return None

    def _state(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        if one is not None:
            one.newest = sample, clock.mono_ns()

    def _token(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        if one is not None:
            one.here = sample.kind == zenoh.SampleKind.PUT
            if not one.here:
                one.newest = one.newest[0], clock.mono_ns()  # keeps the "gone" row for `FORGET_NS`
                one.version = ""  # a restarted daemon may have another version

    def _info(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        try:
            version = self._infos.decode(*encoded(sample)).version
        except DecodeError:
            version = "?"
        if one is not None:
            one.version = version[:LONG]

    # Subscriptions and queries.

    def _look(self) -> None:
        client = self._robots.client
        if not self._joined or client is None or self._busy:
            return
        if not self._declared:
            self._start(self._declare(client))
            return
        now_ns, unknown = clock.mono_ns(), []
        for robot, one in self._known.copy().items():
            if one.here is not False and not one.version and now_ns - one.asked_ns >= ASK_NS:
                one.asked_ns = now_ns
                unknown.append(robot)
        if unknown:
            self._start(self._ask(client, unknown))

    async def _declare(self, client: Client) -> None:
        def declare() -> list[Any]:
            session, robots = client.session, self._robots
            by_name = robots.endpoint.startswith("tls/")
            why = BY_NAME if by_name else "" if session.info.routers_zid() else UNROUTED
            self.note = why.format(robot=robots.id, endpoint=robots.endpoint)
            whose = robots.id if by_name else ALL
            states = session.declare_subscriber(full_key(whose, "state"), self._state)
            try:
                tokens = session.liveliness().declare_subscriber(
                    full_key(whose, "alive"), self._token, history=True
                )
            except zenoh.ZError:
                states.undeclare()
                raise
            return [states, tokens]

        try:
            self._declared = await in_thread(declare, DECLARE_S, _undeclare)
        except UNREADY:
            return  # the next viewer that looks retries
        self._tidy()

    async def _ask(self, client: Client, robots: Sequence[str]) -> None:
        def ask() -> None:
            for robot in robots:
                try:
                    client.like(robot).ask("info", self._info)
                except UNREADY:
                    continue  # the robot does not exist, or the bus is stuck

        try:
            await in_thread(ask, DECLARE_S)
        except TimeoutError:
            pass  # the bus is stuck; the queries are repeated

    def _tidy(self) -> None:
        if self._joined or not self._declared:
            return
        declared, self._declared = self._declared, []
        self._known.clear()
        self._start(_ended(declared))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._busy.add(task)
        task.add_done_callback(self._busy.discard)


async def _ended(declared: Sequence[Any]) -> None:
    try:
        await in_thread(lambda: _undeclare(declared), DECLARE_S)
    except UNREADY:
        pass  # the bus is stuck or closed, so later samples are discarded


def _undeclare(declared: Sequence[Any]) -> None:
    for one in declared:
        one.undeclare()
