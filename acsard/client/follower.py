"""Follows the `state` of one robot: its newest value, its age, and whether the daemon is silent.

`Follower` is pure, and `Watch` connects it to the bus. All programs use the time limits of this
module, so all programs report a silent robot after the same time.

A Zenoh router may have a storage, which keeps the last messages and answers queries too. If the
robot is off, the storage sends the last state of this robot. A published state never comes from a
storage, so it always proves that the daemon runs. An answer to a query proves this only if it is
newer than an earlier state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from acsard.bus.subscription import MAX_QUEUED_SAMPLES, Subscription, encoded
from acsard.client.commander import objection
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import RobotState
from acsard.host.mailbox import Mailbox

QUERY_PERIOD_S = 0.3
"""Time without a new state after which the client queries `state`, s. Without queries, the client
could not follow a robot that is configured to publish its state seldom."""

SETTLED_S = 0.2
"""Longest time that a message on `state` takes to arrive, s. So a state that arrives more than
`SETTLED_S` after an action shows the robot after the action."""

MAX_STATE_AGE_S = 0.5
"""A program must not base an action on a state that is older than this, s."""

ROBOT_SILENCE_TIMEOUT_S = 1.0
"""If the last state is older than this, s, the robot counts as silent, and a drive ends."""

FIRST_STATE_TIMEOUT_S = 2.0
"""A robot that works normally sends its first message on a key within this time, s."""

FLEET_QUERY_PERIOD_S = 2.0
"""If a program follows many robots, and one of them has sent no new state for this time, s, the
program queries the `state` of that robot. The time is longer than `QUERY_PERIOD_S`, because such a
program sends many queries."""

MONOTONIC_COUNTERS = ("lines", "lines_sent", "commands")
"""Names of counters in `state` that decrease only when the daemon restarts."""


class Follower:
    """The newest state of one robot, with its age. All times are in s on the same monotonic clock.

    This clock must also advance while the computer is suspended, as `clock.steady_s` does. `now` is
    the present time, s. `query_period_s` is the time without a new state after which the caller
    must query `state`, s.
    """

    def __init__(self, now: float, query_period_s: float = QUERY_PERIOD_S) -> None:
        self.state: RobotState | None = None
        """The newest state; None before the first state. Until `is_confirmed` is true, it may be an
        old state from the storage of a router."""
        self.is_confirmed = False
        """Whether a state has proved that the daemon runs (see `answered()`)."""
        self.last_seen = now
        """Arrival time of the last state that proved that the daemon runs, s. Before the first such
        state, it is the time at which this object was created, s."""
        self.due = now + query_period_s
        """Time of the next query, unless a state arrives before this time."""
        self.unreadable = 0
        """Number of consecutive messages on `state` that could not be decoded."""
        self._query_period_s = query_period_s
        self._answer: RobotState | None = None

    def published(self, state: RobotState, now: float) -> None:
        """Store a state that the daemon published. It arrived at the time `now`, s."""
        self.state, self.last_seen, self.is_confirmed = state, now, True
        self.due, self.unreadable = now + self._query_period_s, 0

    def answered(self, state: RobotState, now: float) -> bool:
        """Process an answer to a query of `state`. Return whether it proves that the daemon runs.

        The answer may be an old state from the storage of a router. Therefore, it is a proof only
        if its stamp is newer than the stamp of `self.state` or of the previous answer.
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

    def query_is_due(self, now: float) -> bool:
        """Return whether the caller must query `state` now. If so, set the time of the next one."""
        if now < self.due:
            return False
        self.due = now + self._query_period_s
        return True

    def age(self, now: float) -> float:
        """Return the time since the running daemon last sent a state, s.

        An old state from the storage of a router does not count. Before the first state, return the
        time since this object was created.
        """
        return max(0.0, now - self.last_seen)

    @property
    def silence_timeout_s(self) -> float:
        """The robot counts as silent if its last state is older than this, s."""
        # If a robot publishes seldom, only answers arrive, at intervals of `query_period_s`.
        return (
            (ROBOT_SILENCE_TIMEOUT_S if self.is_confirmed else FIRST_STATE_TIMEOUT_S)
            + self._query_period_s
            - QUERY_PERIOD_S
        )

    def silent(self, now: float) -> bool:
        """Return whether the robot counts as silent at the time `now`, s."""
        return self.age(now) > self.silence_timeout_s


def restarted(before: RobotState | None, state: RobotState) -> bool:
    """Return whether the daemon restarted between the states `before` and `state`.

    The sign of a restart is that a counter in `MONOTONIC_COUNTERS` is lower in `state` than in
    `before`. Returns False if `before` is None.
    """
    return before is not None and any(
        state.counters.get(name, 0) < before.counters.get(name, 0) for name in MONOTONIC_COUNTERS
    )


class Followed(Protocol):
    """The part of a client that a `Watch` uses."""

    def subscribe(self, name: str) -> Subscription:
        """Subscribe to a key."""

    def start_query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        """Query a key. Call `take` with each reply that arrives."""


class Watch(Follower):
    """Follows the `state` of one robot over the bus. Only one thread may use an instance."""

    def __init__(
        self, robot: Followed, now: float, wake: Callable[[], object] | None = None
    ) -> None:
        """Subscribe to the state of the robot to which the client `robot` is connected.

        A thread of Zenoh calls `wake` each time a state arrives.
        """
        super().__init__(now)
        self._robot, self._decoder = robot, Decoder(RobotState)
        self._states = robot.subscribe("state")
        if wake is not None:
            self._states.wakes(wake)
        self._answers = Mailbox[zenoh.Sample](16)
        """Replies to queries, which a thread of Zenoh adds. The daemon and each storage send one
        reply to a query."""

    def poll(self, now: float) -> list[RobotState]:
        """Process the states that have arrived, and return the new states.

        If no state has arrived for some time, also send a query. A later call processes the reply.
        Raises `ZError` if the session was closed.
        """
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

    def objection(self, source: str, sender: str, now: float) -> str:
        """Return why the robot does not follow the commands of a sender; "" if it follows them.

        Before the first state arrives, the result is "" until the robot counts as silent. `source`
        and `sender` are those of the function `objection`.
        """
        if self.silent(now):
            return (
                "nothing received from the daemon: does the daemon run? `acsard doctor` on the "
                "robot checks this"
            )
        return "" if self.state is None else objection(self.state, source, sender)

    def end(self) -> None:
        """Unsubscribe from `state`."""
        self._states.undeclare()
