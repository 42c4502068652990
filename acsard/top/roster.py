"""Follows many robots: whether each daemon is present, and its newest state.

A daemon is present while Zenoh shows its liveliness token. Zenoh's threads store the newest states,
and one thread decodes them with `Roster.rows()`, which may wait for the bus.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from threading import Lock
from typing import Any

import zenoh
from msgspec import Struct
from msgspec.structs import replace

from acsard.bus.robot_discovery import ALL_ROBOTS, count_text, no_robot_text, robot_of
from acsard.bus.subscription import encoded
from acsard.client.connection import Connection
from acsard.client.follower import FLEET_QUERY_PERIOD_S, Follower
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import RobotState
from acsard.host import clock
from acsard.host.mailbox import Mailbox


class Row(Struct, frozen=True):
    robot_id: str
    here: bool  # the daemon's liveliness token is present
    state: RobotState | None
    age: float  # of `state`, s; inf before the first that proves that the daemon runs
    silent: bool = False  # `Follower.silent`


def absence(row: Row) -> str:
    """Return "GONE" for a robot without a daemon, "SILENT" for one that hangs, or ""."""
    if not row.here:
        return "GONE"
    return "SILENT" if row.silent else ""


class _TrackedRobot:
    def __init__(self) -> None:
        self.here = False
        self.newest = Mailbox[tuple[zenoh.Sample, float]](1)  # undecoded, with its arrival
        self.begin()

    def begin(self) -> None:
        now = clock.steady_s()
        self.follower = Follower(now, FLEET_QUERY_PERIOD_S)
        self.follower.due = now


class Roster:
    """Follows several robots, or all robots on the bus, and says why some may be missing."""

    def __init__(self, robot: Connection, ids: Sequence[str]) -> None:
        # Raises `ZError`. "*" in `ids` is all robots.
        self._robot, self._ids, self._lock = robot, ids, Lock()
        self._known = {robot_id: _TrackedRobot() for robot_id in ids if robot_id != ALL_ROBOTS}
        self._states = Decoder(RobotState)
        self._declared: list[Any] = []
        session, liveliness = robot.session, robot.session.liveliness()
        for robot_id in ids:
            states, tokens = full_key(robot_id, "state"), full_key(robot_id, "alive")
            self._declared += [
                session.declare_subscriber(states, self._state),
                liveliness.declare_subscriber(tokens, self._token, history=True),
            ]

    def rows(self) -> list[Row]:
        """Return a row for each robot, and query the states that are due."""
        now = clock.steady_s()
        with self._lock:
            for robot in self._known.values():
                self._take(robot)
            due = [name for name, robot in self._known.items() if robot.follower.query_is_due(now)]
            rows = [self._row(name, robot, now) for name, robot in self._known.items()]
        for name in due:
            self._robot.sibling(name).start_query("state", self._answer)
        return rows

    def gather(self) -> list[Row]:
        """Wait for the first reports, and return one row per robot.

        The wait ends when all named robots have reported; for "*" it takes 1.5 s. Without any
        robot, or if a named one is missing, it takes 3 s, because the first answer can be late on a
        busy computer. A robot that has not reported then is silent.
        """
        began, rows = time.monotonic(), self.rows()
        while (passed := time.monotonic() - began) < 3.0:
            present = any(row.here or row.state for row in rows)
            if present and self._all_reported() and (passed >= 1.5 or ALL_ROBOTS not in self._ids):
                break
            time.sleep(0.05)
            rows = self.rows()
        return [replace(row, silent=True) if math.isinf(row.age) else row for row in rows]

    def _all_reported(self) -> bool:
        named = [self._known[name] for name in self._ids if name != ALL_ROBOTS]
        return all(robot.here and robot.follower.is_confirmed for robot in named)

    @property
    def presence_text(self) -> str:
        """How many robots are present, or "" if the user named robots."""
        with self._lock:
            here = sum(robot.here for robot in self._known.values())
        return count_text(self._robot.where.endpoint, here) if ALL_ROBOTS in self._ids else ""

    def hint(self) -> str:
        """Return why no robot is there."""
        if tuple(self._ids) == (ALL_ROBOTS,):
            return no_robot_text(self._robot.where.endpoint)
        return (
            f"none of these robots is visible at {self._robot.where.endpoint}: start their daemons,"
            " or correct --id or [fleet] robots"
        )

    def _row(self, name: str, robot: _TrackedRobot, now: float) -> Row:
        follower, state = robot.follower, robot.follower.state
        silent = follower.silent(now)
        if robot.here and not follower.is_confirmed and not silent:
            # A storage on a router may have sent this old state. Wait for the daemon's own answer.
            state = None
        age = follower.age(now) if follower.is_confirmed else math.inf
        return Row(name, robot.here, state, age, silent)

    def _take(self, robot: _TrackedRobot) -> None:
        for sample, at in robot.newest.take():
            try:
                robot.follower.published(self._states.decode(*encoded(sample)), at)
            except DecodeError:
                pass  # a daemon of another version: the robot is shown as silent

    # Zenoh's threads call the methods below.

    def _of(self, sample: zenoh.Sample) -> _TrackedRobot | None:
        name = robot_of(str(sample.key_expr))
        with self._lock:
            return self._known.setdefault(name, _TrackedRobot()) if name else None

    def _token(self, sample: zenoh.Sample) -> None:
        robot = self._of(sample)
        if robot is not None:
            appeared, robot.here = not robot.here, sample.kind == zenoh.SampleKind.PUT
            if robot.here and appeared:
                robot.begin()

    def _state(self, sample: zenoh.Sample) -> None:
        robot = self._of(sample)
        if robot is not None:
            robot.newest.put((sample, clock.steady_s()))

    def _answer(self, sample: zenoh.Sample) -> None:
        robot = self._of(sample)
        if robot is None:
            return
        try:
            state = self._states.decode(*encoded(sample))
        except DecodeError:
            return
        with self._lock:
            self._take(robot)
            robot.follower.answered(state, clock.steady_s())
