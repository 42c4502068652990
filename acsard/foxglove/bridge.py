"""The bridge between a robot and Foxglove viewers. Its main loop runs on one thread."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from threading import Event
from typing import Any

import foxglove
import zenoh

from acsard.client import Client
from acsard.client.commander import MAX_SOURCE_TIMEOUT_S, only_needs_zero
from acsard.client.follower import Watch
from acsard.core.ros.names import full_name
from acsard.core.values import NS_PER_S, AcsardError
from acsard.foxglove.drives import DrivingViewers
from acsard.foxglove.notices import Notices, Objections
from acsard.foxglove.relay import Relay
from acsard.foxglove.robot_facts import Facts, learn
from acsard.foxglove.server import (
    DRIVE_SERVICES,
    OPEN_SERVICES,
    Listener,
    Refusals,
    Settings,
    ShownTopics,
    as_parameters,
    services,
    start,
)
from acsard.host import clock
from acsard.host.threads import NoThreadError, future_of

DAEMON_GONE_ID = "daemon"
"""Id of the status message that tells the viewers that the daemon is gone."""

LEARN_RETRY_S = 1.0
"""Shortest time from a failed query of the robot's configuration to the next query, s."""

STOP_TIMEOUT_S = 2.0
"""Time limit for the end of the server, s. foxglove-sdk waits without a limit for each connection
that has not sent its WebSocket request yet."""

RELEASE_ADVICE = "release the button for two seconds, and press it again"
"""Advice to an operator if the daemon waits for a zero command. After a panel has paused for longer
than `commander.RELEASE_TIMEOUT_NS`, the bridge sends a zero before the panel's next command."""


class Bridge:
    """Connects one robot to the viewers: starts the server, and runs the main loop."""

    def __init__(
        self,
        robot: Client,
        address: tuple[str, int],
        tell: Callable[[str], None],
        *,
        acts: bool = False,
    ) -> None:
        """Query the robot, and start the server.

        `tell` prints a message at the terminal. `acts` says whether viewers may drive the robot,
        call all services and change settings.
        """
        self._robot, self._id = robot, robot.where.robot_id
        robot.name += " foxglove"
        self._wake, self._ended = Event(), Event()
        self._notices = Notices(tell, self._wake.set)
        self._here = self._was_here = True
        self._outdated = False
        """Whether the daemon has ended since the last query of its configuration. `_here` and
        `_was_here` do not show this if the daemon ends and starts again within one round."""
        # Subscribe before the query. Otherwise a restart of the daemon between the two would leave
        # outdated facts.
        key = robot.key("alive")
        self._token = robot.session.liveliness().declare_subscriber(key, self._alive, history=True)
        facts = learn(robot)
        ros = facts.config.ros
        self._shown_topics = ShownTopics(self._wake.set)
        self._settings = Settings(robot, self._notices, facts.tables, self._wake.set)
        topic = full_name(ros.namespace, "cmd_vel")
        self._drives = DrivingViewers(self._viewer, topic, self._notices, facts.forbidden)
        self._drives.timeout_s = self._timeout_s(facts)
        context = foxglove.Context()
        self._relay = Relay(robot, context, self._wake.set)
        self._relay.offer(facts)
        self._commands_hidden_reason = facts.commands_hidden_reason
        """Reason why the viewers cannot see the commands of other programs, in words. It is "" if
        they can see these commands, or after the reason has been sent to the viewers."""
        logging.getLogger("foxglove").addHandler(Refusals(self._notices))
        listener = Listener(self._shown_topics, self._drives, self._settings)
        offered = services(robot, ros, DRIVE_SERVICES if acts else OPEN_SERVICES)
        self._server = start(f"acsard {self._id}", address, listener, offered, context, acts=acts)
        self._objections: dict[int, Objections] = {}
        self._watch: Watch | None = None
        """Receives the robot's `state` while a viewer drives; None while no viewer drives."""
        self._retry_s = 0.0
        """Earliest monotonic time of the next query of the robot's configuration, s."""
        self._pending_refresh: Future[dict[str, Any]] | None = None
        """The changed settings, which a separate thread receives from the daemon; None if no such
        thread runs."""

    def run(self) -> None:
        """Run the main loop until `end` is called.

        If an exception has ended the thread that sends commands, raise this exception.
        """
        dead = self._drives.outbox.dead
        while not self._ended.is_set():
            if dead.done():
                dead.result()
            self._wake.wait(0.5)
            # Collect messages before a round, which saves a third of the processor time. The pause
            # is shorter than one frame at 60 Hz. Commands do not wait for this loop.
            time.sleep(0.015)
            self._wake.clear()
            self._round()

    def end(self) -> None:
        """Let `run` return. A signal handler may call this method."""
        self._ended.set()
        self._wake.set()

    def close(self) -> None:
        """Send a zero command for each viewer that may be driving, then stop the server.

        Wait at most `STOP_TIMEOUT_S` for the server.
        """
        self._drives.end()
        with suppress(TimeoutError):
            future_of(self._server.stop, lambda: None).result(STOP_TIMEOUT_S)

    def _viewer(self, client: int) -> Client:
        """Return a bus client for one viewer. To the daemon, each viewer is a different sender."""
        name = self._robot.sender.rpartition("/")[0]
        return self._robot.sibling(self._id, f"{name}/{client}")

    def _alive(self, sample: zenoh.Sample) -> None:
        self._here = sample.kind == zenoh.SampleKind.PUT
        if not self._here:
            self._outdated = True
        self._wake.set()

    def _round(self) -> None:
        here = self._here
        if here and self._outdated and clock.steady_s() >= self._retry_s:
            self._came_back()
        elif self._was_here and not here:
            self._went()
        self._was_here = here
        driving = self._drives.driving()
        topics, fresh = self._shown_topics.take()
        self._relay.follow(topics, fresh)
        if self._commands_hidden_reason and not topics.isdisjoint(self._relay.commanders):
            self._notices.enqueue(
                "warning", "commands", self._commands_hidden_reason, status_id="commands"
            )
            self._commands_hidden_reason = ""
        self._relay.forward()
        self._follow(bool(driving) and here)
        self._object(driving)
        self._refresh_settings(here)
        self._notices.send(self._server, self._relay.log, newcomers=bool(fresh))

    def _refresh_settings(self, here: bool) -> None:
        """Publish changed settings, and start the next refresh of the settings if it is due.

        The refresh may wait for the daemon for several seconds. It runs in a separate thread, so
        that it does not delay the topics. `here` says whether the daemon is present.
        """
        if self._pending_refresh is not None and self._pending_refresh.done():
            news, self._pending_refresh = self._pending_refresh.result(), None
            if news:
                self._server.publish_parameter_values(as_parameters(news))
        if self._pending_refresh is None and self._settings.is_due(here):
            with suppress(NoThreadError):  # a later round tries again
                self._pending_refresh = future_of(
                    partial(self._settings.refresh, here), self._wake.set
                )

    def _went(self) -> None:
        words = f"the daemon of robot {self._id} is gone; `acsard foxglove` waits for it"
        self._notices.enqueue("error", "daemon", words, status_id=DAEMON_GONE_ID)

    def _came_back(self) -> None:
        # The daemon may restart during the query, which makes the reply outdated.
        self._outdated = False
        try:
            facts = learn(self._robot)
        except AcsardError as error:
            self._outdated, self._retry_s = True, clock.steady_s() + LEARN_RETRY_S
            self._notices.enqueue("error", "daemon", str(error), status_id=DAEMON_GONE_ID)
            return
        self._relay.offer(facts)
        self._drives.forbidden = facts.forbidden
        self._drives.timeout_s = self._timeout_s(facts)
        self._server.publish_parameter_values(as_parameters(self._settings.learn(facts.tables)))
        self._notices.remove(DAEMON_GONE_ID)
        self._notices.enqueue("info", "daemon", f"the daemon of robot {self._id} is back")

    def _timeout_s(self, facts: Facts) -> float:
        sources = facts.config.commands.sources
        return next(
            (source.timeout for source in sources if source.name == self._robot.source),
            MAX_SOURCE_TIMEOUT_S,
        )

    def _follow(self, driving: bool) -> None:
        now = clock.steady_s()
        if self._watch is not None and not driving:
            self._watch.end()
            self._watch = None
        elif self._watch is None and driving:
            self._watch = Watch(self._robot, now, self._wake.set)
        if self._watch is not None:
            with suppress(zenoh.ZError):  # the session is closed: the program is ending
                self._watch.poll(now)

    def _object(self, driving: dict[int, Client]) -> None:
        """Tell all viewers why the robot does not follow the commands of a viewer.

        `driving` contains the viewers that request a speed now. It maps the id of a viewer to the
        bus client of this viewer.
        """
        now_ns = clock.steady_ns()
        for client in driving.keys() - self._objections.keys():
            self._objections[client] = Objections()
        for client, objections in list(self._objections.items()):
            robot, why, zero_first = driving.get(client), "", False
            if robot is not None and self._watch is not None:
                why = self._watch.objection(robot.source, robot.sender, now_ns / NS_PER_S)
                state = self._watch.state
                zero_first = state is not None and only_needs_zero(state, robot.source)
            if objections.update(why, now_ns):
                status_id = f"drive {client}"
                if objections.reported:
                    mend = f" ({RELEASE_ADVICE})" if zero_first else ""
                    words = f"your commands do not drive the robot: {objections.reported}{mend}"
                    self._notices.enqueue("warning", "drive", words, status_id=status_id)
                else:
                    self._notices.remove(status_id)
            if robot is None:
                del self._objections[client]
