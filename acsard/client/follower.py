"""Follows the `state` of one robot: its newest value, its age, and whether the daemon is silent.

`Follower` is pure, and `Watch` binds it to the bus. Every program that follows `state` uses these
time limits, so a silent robot is reported equally soon by all of them.

A router's storage also answers queries, for a dead robot with its last state. A state that arrives
unqueried never comes from a storage, so it always proves that the daemon runs. An answer proves it
only if it is newer than the state before it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from acsard.client.commander import objection
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import RobotState
from acsard.daemon.bus.subscription import QUEUED, Subscription, encoded
from acsard.host.mailbox import Mailbox

ASK_S = 0.3
"""Time without a state, s, after which it is queried. The robot may publish it seldom."""

QUIET_S = 0.5
"""Age, s, above which a state is too old to act on."""

SILENT_S = 1.0
"""Age, s, above which the robot counts as silent: the operator is told, and a drive ends."""

FIRST_S = 2.0
"""Time, s, within which the first message on a key arrives from a robot that is well."""

FLEET_ASK_S = 2.0
"""Value of `ASK_S` for a program that follows many robots, whose queries add up."""

STATE = "state"

ANSWERS = 16
"""Replies that wait at most. A query has one from the daemon and one from each storage."""

STEADY = ("lines", "lines_sent", "commands")
"""Counters that decrease only when the daemon restarts."""


class Follower:
    """The newest state of one robot. All times are in s of one clock that never goes back."""

    def __init__(self, now: float, ask_s: float = ASK_S) -> None:
        self.state: RobotState | None = None
        """The newest state. Until `heard` is true, it may come from a storage."""
        self.heard = False
        """Whether the daemon has proven that it runs."""
        self.last_seen = now
        """Time of the last state that proved it, or of the start."""
        self.due = now + ask_s
        """Time of the next query, unless a state arrives before it."""
        self.unreadable = 0
        """Number of messages in succession that could not be decoded."""
        self._ask_s = ask_s
        self._answer: RobotState | None = None

    def published(self, state: RobotState, now: float) -> None:
        """Take a state that the daemon published."""
        self.state, self.last_seen, self.heard = state, now, True
        self.due, self.unreadable = now + self._ask_s, 0

    def answered(self, state: RobotState, now: float) -> bool:
        """Take the answer to a query, and return whether it is news.

        It is news if it is newer than the held state, or than the answer before it. The second
        case covers a robot whose clock was set back since the held state arrived.
        """
        held, before, self._answer = self.state, self._answer, state
        known = [one for one in (held, before) if one is not None]
        repeated = held is not None and held.stamp == state.stamp
        if not repeated and any(state.stamp.to_ns() > one.stamp.to_ns() for one in known):
            self.published(state, now)
            return True
        if held is None:
            # A storage may have sent it. Query again at once to find out.
            self.state, self.due = state, now
        return False

    def asks(self, now: float) -> bool:
        """Return whether the caller must query `state` now, and plan the next query."""
        if now < self.due:
            return False
        self.due = now + self._ask_s
        return True

    def age(self, now: float) -> float:
        """Return the time since the last sign of life of the daemon, or since the start, s."""
        return max(0.0, now - self.last_seen)

    @property
    def patience_s(self) -> float:
        """The age above which the robot counts as silent, s."""
        # A robot that publishes seldom is only heard by its answers, each `ask_s` after the other.
        return (SILENT_S if self.heard else FIRST_S) + self._ask_s - ASK_S

    def silent(self, now: float) -> bool:
        """Return whether the robot counts as silent."""
        return self.age(now) > self.patience_s


def restarted(before: RobotState | None, state: RobotState) -> bool:
    """Return whether another daemon answers than before, because a counter decreased."""
    return before is not None and any(
        state.counters.get(name, 0) < before.counters.get(name, 0) for name in STEADY
    )


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
