"""Binds a `Follower` to the bus: subscribes to `state`, and queries it if none arrives in time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from acsard.client.commander import objection
from acsard.client.follower import Follower
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import RobotState
from acsard.daemon.bus.subscription import QUEUED, Subscription, encoded
from acsard.host.mailbox import Mailbox

STATE = "state"

ANSWERS = 16
"""Replies that wait at most. A query has one from the daemon and one from each storage."""


class Followed(Protocol):
    """Interface of a client as a watch uses it."""

    def subscribe(self, name: str) -> Subscription:
        """Subscribe to a key."""

    def ask(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        """Query a key, and call `take` with the reply, if one comes."""


class Watch(Follower):
    """The newest state of the robot of a client. One thread uses it."""

    def __init__(
        self, robot: Followed, now: float, wake: Callable[[], object] | None = None
    ) -> None:
        """Subscribe; `wake` is called on a thread of Zenoh when a state arrives."""
        super().__init__(now)
        self._robot, self._decoder = robot, Decoder(RobotState)
        self._states = robot.subscribe(STATE)
        if wake is not None:
            self._states.wakes(wake)
        self._answers = Mailbox[zenoh.Sample](ANSWERS)
        """Replies to queries. A thread of Zenoh puts them here and does nothing else."""

    def look(self, now: float) -> list[RobotState]:
        """Take the states that have arrived, query a late one, and return the new ones.

        Raises `ZError` after the session was closed.
        """
        news = []
        for _ in range(QUEUED):  # bounded, so that a flood cannot hold the caller
            sample = self._states.try_recv()
            if sample is None:
                break
            state = self._read(sample)
            if state is not None:
                self.published(state, now)
                news.append(state)
        # Replies come last: `answered` compares stamps, and `published` does not.
        for sample in self._answers.take():
            state = self._read(sample)
            if state is not None and self.answered(state, now):
                news.append(state)
        if self.asks(now):
            self._robot.ask(STATE, self._answers.put)
        return news

    def _read(self, sample: zenoh.Sample) -> RobotState | None:
        try:
            return self._decoder.decode(*encoded(sample))
        except DecodeError:
            self.unreadable += 1
            return None

    def objection(self, source: str, sender: str, now: float) -> str:
        """Return why commands have no effect; "" if they have one, or before the first state."""
        if self.silent(now):
            return "nothing received from the daemon: does it run?"
        return "" if self.state is None else objection(self.state, source, sender)

    def end(self) -> None:
        """Unsubscribe from `state`."""
        self._states.undeclare()
