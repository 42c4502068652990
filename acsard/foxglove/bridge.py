"""The bridge between a robot and Foxglove viewers. Its main loop runs on one thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from threading import Event

import foxglove
import msgspec
import zenoh
from foxglove import StatusLevel

from acsard.client.connection import Connection
from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import Config
from acsard.core.messages.permissions import has, least_role
from acsard.core.values import AcsardError
from acsard.foxglove.relay import Relay
from acsard.foxglove.server import ShownTopics, start
from acsard.host import clock
from acsard.host.errors import ReplyError
from acsard.host.threads import future_of

STATUS_ID = "daemon"  # of the message that tells the viewers that the daemon is gone

RETRY_S = 1.0  # shortest time from a failed query of the robot's configuration to the next one

# foxglove-sdk waits without a limit for each connection that has not sent its request yet.
STOP_TIMEOUT_S = 2.0


class Bridge:
    """Connects one robot to the viewers: starts the server, and runs the main loop.

    `tell` prints a message at the terminal.
    """

    def __init__(
        self, robot: Connection, address: tuple[str, int], tell: Callable[[str], None]
    ) -> None:
        self._robot, self._id, self._tell = robot, robot.where.robot_id, tell
        robot.name += " foxglove"
        self._wake, self._ended = Event(), False
        self._here = True
        # Whether the daemon has ended since the last query of its configuration. `_here` does not
        # show this if the daemon ends and starts again within one round.
        self._outdated = False
        self._problem = ""  # the message that the viewers show
        self._retry_s = 0.0  # monotonic time
        # Subscribe before the query. Otherwise a restart of the daemon between the two would leave
        # an outdated configuration.
        key = robot.key("alive")
        self._token = robot.session.liveliness().declare_subscriber(key, self._alive, history=True)
        config = configuration(robot)
        self._shown_topics, context = ShownTopics(self._wake.set), foxglove.Context()
        self._relay = Relay(robot, context, self._wake.set)
        self._relay.offer(config)
        self._server = start(robot, config.ros, address, self._shown_topics, context)

    def run(self) -> None:
        """Run the main loop until `end` is called."""
        while not self._ended:
            self._wake.wait(0.5)
            # Collect messages before a round, which saves a third of the processor time. The pause
            # is shorter than one frame at 60 Hz.
            time.sleep(0.015)
            self._wake.clear()
            self._round()

    def end(self) -> None:
        """Let `run` return within 0.5 s. A signal handler may call this method."""
        # `Event.set` would wait for ever if a second signal came while it holds the event's lock.
        self._ended = True

    def close(self) -> None:
        with suppress(TimeoutError):
            future_of(self._server.stop, lambda: None).result(STOP_TIMEOUT_S)

    def _alive(self, sample: zenoh.Sample) -> None:
        self._here = sample.kind == zenoh.SampleKind.PUT
        if not self._here:
            self._outdated = True
        self._wake.set()

    def _round(self) -> None:
        if not self._here:
            self._show(f"the daemon of robot {self._id} is gone; `acsard foxglove` waits for it")
        elif self._outdated and clock.steady_s() >= self._retry_s:
            self._came_back()
        topics, fresh = self._shown_topics.take()
        if fresh and self._problem:
            self._publish_problem()  # for the new viewers
        self._relay.follow(topics, fresh)
        self._relay.forward()

    def _came_back(self) -> None:
        # The daemon may restart during the query, which makes the reply outdated.
        self._outdated = False
        try:
            self._relay.offer(configuration(self._robot))
        except AcsardError as error:
            self._outdated, self._retry_s = True, clock.steady_s() + RETRY_S
            self._show(str(error))
            return
        self._problem = ""
        self._server.remove_status([STATUS_ID])
        self._tell(f"the daemon of robot {self._id} is back")

    def _show(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._publish_problem()
            self._tell(problem)

    def _publish_problem(self) -> None:
        self._server.publish_status(self._problem, StatusLevel.Error, STATUS_ID)


def configuration(robot: Connection) -> Config:
    """Return the robot's configuration, or the default one if this program may not read it.

    Raises the errors of `Connection.get`, and `ReplyError` if a reply is not readable.
    """
    if robot.where.tls and not has(robot.whoami().role, least_role("config")):
        return Config()
    tables = robot.get("config")
    try:
        return from_builtins(tables)
    except msgspec.ValidationError as error:
        raise ReplyError(
            f"cannot read the robot's configuration ({error}); is the daemon a different version? "
            "Use the same version here"
        ) from None
