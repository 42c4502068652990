"""The robots that the bus or router knows, a row for each, while somebody looks at them."""

from __future__ import annotations

import asyncio
from typing import Any

import zenoh
from msgspec import Struct

from acsard.bus.fleet import ALL, robot_of
from acsard.bus.subscription import encoded
from acsard.host import clock
from acsard.host.threads import in_thread
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import RobotState
from acsard.messages.topics import full_key
from acsard.values import NS_PER_S
from acsard.web.robots import Robots
from acsard.web.streams import DECLARE_S

MOST = 200
"""Robots; a stranger may invent names."""

FORGET_NS = 30 * NS_PER_S
"""Not heard of for so long, it is none any more."""


class Row(Struct, frozen=True):
    """One robot."""

    robot: str
    mode: str
    reason: str
    speed: float
    """m/s"""
    link: str
    age: float
    """ms since it was heard."""


class Fleet:
    """Follows the state of all robots for as long as somebody has joined."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._joined: set[object] = set()
        self._newest: dict[str, tuple[zenoh.Sample, int]] = {}
        self._decoder = Decoder(RobotState)
        self._subscriber: Any = None
        self._lock = asyncio.Lock()

    async def join(self, viewer: object) -> None:
        """This one looks from now on."""
        self._joined.add(viewer)
        async with self._lock:
            client = self._robots.client
            if self._subscriber is None and client is not None:
                key = full_key(ALL, "state")
                declare = client.session.declare_subscriber
                try:
                    self._subscriber = await in_thread(lambda: declare(key, self._take), DECLARE_S)
                except (TimeoutError, zenoh.ZError):
                    pass  # the bus is stuck: there are no rows
        self._tidy()

    def leave(self, viewer: object) -> None:
        """This one does not."""
        self._joined.discard(viewer)
        self._tidy()

    def rows(self) -> list[Row]:
        """What is known now, by name."""
        now_ns, rows = clock.mono_ns(), []
        for robot, (sample, at_ns) in sorted(self._newest.copy().items()):
            if now_ns - at_ns > FORGET_NS:
                self._newest.pop(robot, None)
                continue
            try:
                state = self._decoder.decode(*encoded(sample))
            except DecodeError:
                continue
            age = round((now_ns - at_ns) / 1e6, 1)
            rows.append(Row(robot, state.mode, state.reason, state.linear, state.link, age))
        return rows

    def _take(self, sample: zenoh.Sample) -> None:
        robot = robot_of(str(sample.key_expr))
        if robot and (robot in self._newest or len(self._newest) < MOST):
            self._newest[robot] = sample, clock.mono_ns()

    def _tidy(self) -> None:
        if self._joined or self._subscriber is None:
            return
        subscriber, self._subscriber = self._subscriber, None
        task = asyncio.get_running_loop().create_task(in_thread(subscriber.undeclare, DECLARE_S))
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._newest.clear()
