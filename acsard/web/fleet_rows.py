"""The list of the robots on the bus, to which viewers of the page can subscribe."""

from __future__ import annotations

import asyncio
import math

from acsard.bus.robot_discovery import ALL_ROBOTS
from acsard.client import Client, fleet
from acsard.core.messages.state_warnings import charge, warnings
from acsard.host.threads import in_thread
from acsard.web.robots import Robots
from acsard.web.socket_messages import Row
from acsard.web.streams import DECLARE_TIMEOUT_S, NOT_READY_ERRORS, attempt
from acsard.web.tasks import start

MAX_ROBOTS = 200

NO_ROUTER_NOTE = (
    "this page sees only robots that are connected directly to the daemon of {robot}, because "
    "daemons forward no messages. To see all robots that are connected to a router, connect this "
    "page's server to that router: acsard web --connect ROUTER --id {robot}"
)
"""Note to the page's users if the page's server is connected to a daemon instead of a router."""

OWN_ROBOT_NOTE = (
    "{endpoint} uses TLS, and over TLS this page looks only for its own robot, because TLS "
    "endpoints normally refuse keys with wildcards. To see all robots of a router, run this page's "
    "server on the router's machine: acsard web --connect tcp/127.0.0.1:7447 --id {robot}"
)
"""Note to the page's users if the page's server is connected over TLS. The server can then reach
only its own robot."""


class FleetTracker:
    """Tracks all robots on the bus while any viewer is subscribed to the list of robots."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._joined: set[object] = set()
        self._tracked: fleet.Fleet | None = None
        self._busy: set[asyncio.Task[None]] = set()
        self.note = ""
        """Reason why the list of robots may be incomplete, in words. It is "" if the server is
        connected to a router, because the list then contains all robots of this router."""

    def join(self, viewer: object) -> None:
        self._joined.add(viewer)
        self._start_due_work()

    def leave(self, viewer: object) -> None:
        self._joined.discard(viewer)
        self._tidy()

    def rows(self) -> list[Row]:
        """Return one row per robot, sorted by id. Also start the queries that are due.

        The queries run in the background. The result is [] until the subscription to the robots has
        been made.
        """
        self._start_due_work()
        rows = [] if self._tracked is None else self._tracked.rows()
        return [_row(row) for row in sorted(rows, key=lambda row: row.robot_id)]

    def sees(self, robot: str) -> bool:
        """Return whether this server has found the robot with the id `robot` on the bus.

        That is the case if the robot's liveliness token is present, or if a viewer is subscribed to
        the robot's key `state` and a state has arrived.
        """
        states = self._robots.streams.followed(robot, "state")
        here = self._tracked is not None and self._tracked.is_present(robot)
        return here or bool(states and states.number)

    def _start_due_work(self) -> None:
        tracked, client = self._tracked, self._robots.client
        if not self._joined or client is None or self._busy:
            return
        if tracked is None:
            start(self._declare(client), self._busy)
        elif due := tracked.due():
            start(attempt(lambda: tracked.send_queries(due)), self._busy)

    async def _declare(self, client: Client) -> None:
        def declare() -> fleet.Fleet:
            robots, note = self._robots, NO_ROUTER_NOTE
            by_name = robots.endpoint.startswith("tls/")
            if by_name:
                note = OWN_ROBOT_NOTE
            elif client.session.info.routers_zid():
                note = ""
            self.note = note.format(robot=robots.id, endpoint=robots.endpoint)
            # A robot that has been silent for 30 s is dropped, unless its liveliness token is
            # present.
            return fleet.Fleet(client, [robots.id if by_name else ALL_ROBOTS], MAX_ROBOTS, 30.0)

        try:
            self._tracked = await in_thread(declare, DECLARE_TIMEOUT_S, lambda late: late.end())
        except NOT_READY_ERRORS:
            return  # the next call of `_start_due_work` retries
        self._tidy()

    def _tidy(self) -> None:
        if not self._joined and self._tracked is not None:
            start(attempt(self._tracked.end), self._busy)
            self._tracked = None


def _row(entry: fleet.Row) -> Row:
    state = entry.state if math.isfinite(entry.age) else None
    version = entry.version[:40]
    if state is None:
        mode, reason = ("gone", "its daemon has ended") if entry.here is False else (None, "")
        return Row(entry.robot_id, mode, reason, None, "", None, version)
    age = round(entry.age, 3)
    if entry.here is False:
        was = f"its daemon has ended; the robot was {state.mode}"
        return Row(entry.robot_id, "gone", was, None, "", age, version)
    if entry.silent:
        return Row(entry.robot_id, None, f"the robot was {state.mode}", None, "", age, version)
    return Row(
        entry.robot_id, state.mode, state.reason, state.linear, state.link, age, version,
        [str(entry) for entry in warnings(state)], [state.x, state.y, state.yaw],
        charge(state.battery),
    )  # fmt: skip
