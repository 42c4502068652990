"""Follows the `state` of one robot: its newest value, its age, and whether the daemon is silent.

`Follower` is pure, `Watch` connects it to the bus, and all programs share its time limits. A
storage of a Zenoh router answers queries with the last state of a robot that is off. So a published
state proves that the daemon runs, and an answer only if it is newer than an earlier state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from acsard.bus.subscription import MAX_QUEUED_SAMPLES, Subscription, encoded
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import RobotState
from acsard.core.values import Seconds
from acsard.host.mailbox import Mailbox

SILENCE = (
    "nothing received from the daemon for {:g} s: does the daemon run, and does it have the "
    "robot.id that this program uses? `acsard fleet` lists the robots"
)

UNREADABLE = (
    "the daemon's state cannot be read: does the daemon run another version of acsard than this "
    "program? Use the same version for both"
)

QUERY_PERIOD_S = 0.3  # without a new state: the robot may be configured to publish seldom

SETTLED_S = 0.2  # for a message on `state` to arrive: a later one shows the robot after an action

ROBOT_SILENCE_TIMEOUT_S = 1.0  # a drive ends then, too

FIRST_STATE_TIMEOUT_S = 2.0  # of a key, from a robot that works normally

FLEET_QUERY_PERIOD_S = 2.0  # of a program that follows many robots and so sends many queries

# Counters of `state` that decrease only when the daemon restarts.
MONOTONIC_COUNTERS = ("lines", "lines_sent", "commands")


class Follower:
    """The newest state of one robot, with its age, by a clock that a suspend does not stop, s.

    `query_period_s` is the time without a new state after which the caller must query `state`.
    """

    def __init__(self, now: Seconds, query_period_s: float = QUERY_PERIOD_S) -> None:
        self.state: RobotState | None = None  # maybe old and from a storage until `is_confirmed`
        self.is_confirmed = False  # a state has proved that the daemon runs
        self.last_seen = now  # arrival of the last such state, or the creation of this object
        self.due = now + query_period_s  # of the next query
        self.unreadable = 0  # messages in a row that could not be decoded
        self._query_period_s = query_period_s
        self._answer: RobotState | None = None

    def published(self, state: RobotState, now: Seconds) -> None:
        """Store a state that the daemon published."""
        self.state, self.last_seen, self.is_confirmed = state, now, True
        self.due, self.unreadable = now + self._query_period_s, 0

    def answered(self, state: RobotState, now: Seconds) -> bool:
        """Process an answer to a query, and return whether it proves that the daemon runs.

        It may come from a router's storage, so it must be newer than `self.state` or the previous
        one.
        """
        # The previous answer is compared too, because the robot's clock may have been set back
        # since `self.state`.
        current, before, self._answer = self.state, self._answer, state
        known = [old_state for old_state in (current, before) if old_state is not None]
        repeated = current is not None and current.stamp == state.stamp
        if not repeated and any(
            state.stamp.to_ns() > old_state.stamp.to_ns() for old_state in known
        ):
            self.published(state, now)
            return True
        if current is None:
            # A storage may have sent this first answer. Query again immediately to find out.
            self.state, self.due = state, now
        return False

    def query_is_due(self, now: Seconds) -> bool:
        """Return whether the caller must query `state` now, and set the time of the next query."""
        if now < self.due:
            return False
        self.due = now + self._query_period_s
        return True

    def age(self, now: Seconds) -> float:
        """Return the time since the running daemon last sent a state, or since the creation."""
        return max(0.0, now - self.last_seen)

    @property
    def silence_timeout_s(self) -> float:
        """Age of the last state, s, above which the robot counts as silent."""
        # If a robot publishes seldom, only answers arrive, at intervals of `query_period_s`.
        return (
            (ROBOT_SILENCE_TIMEOUT_S if self.is_confirmed else FIRST_STATE_TIMEOUT_S)
            + self._query_period_s
            - QUERY_PERIOD_S
        )

    def silent(self, now: Seconds) -> bool:
        return self.age(now) > self.silence_timeout_s

    def silence(self, now: Seconds) -> str:
        """Return why the robot counts as silent, or ""."""
        if not self.silent(now):
            return ""
        return UNREADABLE if self.unreadable else SILENCE.format(self.silence_timeout_s)


def restarted(before: RobotState | None, state: RobotState) -> bool:
    """Return whether one of `MONOTONIC_COUNTERS` has decreased, so the daemon restarted."""
    return before is not None and any(
        state.counters.get(name, 0) < before.counters.get(name, 0) for name in MONOTONIC_COUNTERS
    )


class Followed(Protocol):
    """The part of a client that a `Watch` uses."""

    def subscribe(self, name: str) -> Subscription:
        """Subscribe to a key."""

    def start_query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        """Query a key, and call `take` with each reply."""


class Watch(Follower):
    """Follows the `state` of one robot over the bus. Only one thread may use an instance."""

    def __init__(
        self, robot: Followed, now: Seconds, wake: Callable[[], object] | None = None
    ) -> None:
        # A thread of Zenoh calls `wake` each time a state arrives.
        super().__init__(now)
        self._robot, self._decoder = robot, Decoder(RobotState)
        self._states = robot.subscribe("state")
        if wake is not None:
            self._states.wakes(wake)
        # Replies of the daemon and of each storage, by a thread of Zenoh.
        self._answers = Mailbox[zenoh.Sample](16)

    def poll(self, now: Seconds) -> list[RobotState]:
        """Return the new states, and send a query if it is due. Raises `ZError` if closed."""
        states = []
        for _ in range(MAX_QUEUED_SAMPLES):  # bounded, so that a flood cannot block the caller
            sample = self._states.try_recv()
            if sample is None:
                break
            state = self._decode(sample)
            if state is not None:
                self.published(state, now)
                states.append(state)
        # Process the replies last, so that `answered` compares their stamps with the published
        # states. `published` compares no stamps.
        for sample in self._answers.take():
            state = self._decode(sample)
            if state is not None and self.answered(state, now):
                states.append(state)
        if self.query_is_due(now):
            self._robot.start_query("state", self._answers.put)
        return states

    def _decode(self, sample: zenoh.Sample) -> RobotState | None:
        try:
            return self._decoder.decode(*encoded(sample))
        except DecodeError:
            self.unreadable += 1
            return None

    def end(self) -> None:
        """Unsubscribe from `state`."""
        self._states.undeclare()
