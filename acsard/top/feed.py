"""What `acsard top` knows of a robot: what has come of its state, and when that is a silence.

It asks for `state` at the start, since states may be 10 s apart, and subscribes to it and to
nothing else: it costs the daemon what one reader of `state` does.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection

import zenoh

from acsard.bus.subscription import QUEUED, encoded
from acsard.client import Client
from acsard.host.errors import MendableError, ReplyError
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import Info, RobotState
from acsard.top.seen import SILENT_S, Seen

SPAN_S = 1.0
"""Rates are taken over about this; over less they would jump."""

GAPS = 8
"""Times between states that are remembered, so that a burst of changes is not all of them."""

MISSING = 3
"""So many states that did not come are a silence."""

SLOWEST_S = 10.0
"""Between states at the lowest rate there is; also held to be so until two have come."""

STEADY = ("lines", "lines_sent", "commands")
"""Counters that only a new daemon has smaller."""


class Feed:
    """What has come of a robot's state so far."""

    def __init__(self, robot: Client, endpoint: str, robot_id: str) -> None:
        self._robot, self._endpoint, self._id = robot, endpoint, robot_id
        self._decoder = Decoder(RobotState)
        # The first question also finds out whether anybody is there, in the words of all verbs.
        self._info = self._ask_info()
        self._samples = robot.subscribe("state")
        self._past: deque[tuple[float, RobotState]] = deque()
        self._heard = time.monotonic()
        self._came: float | None = None
        """When the last one came unasked."""
        self._gaps: deque[float] = deque(maxlen=GAPS)
        self._undecodable = 0

    def ask(self) -> None:
        """Take the state of this moment, however long it is until the next comes by itself."""
        try:
            state: RobotState = self._robot.get("state")
        except DecodeError as error:
            self._undecodable += 1
            raise ReplyError(
                f"cannot read the state ({error}); is the daemon of another version?"
            ) from None
        # What came before the answer is older than it.
        come = self._newest()
        later = come is not None and come.stamp.to_ns() > state.stamp.to_ns()
        self._take(come if come is not None and later else state)

    def poll(self) -> None:
        """Take what has come since."""
        state = self._newest()
        if state is None:
            return
        now = time.monotonic()
        if self._came is not None:
            self._gaps.append(now - self._came)
        self._came = now
        self._take(state)

    def _take(self, state: RobotState) -> None:
        now = time.monotonic()
        if self._past and anew(self._past[-1][1], state):
            self._past.clear()
            self._gaps.clear()
            self._refresh_info()
        self._past.append((now, state))
        self._heard = now
        while len(self._past) > 2 and now - self._past[1][0] >= SPAN_S:
            self._past.popleft()

    def seen(self, hint: str = "") -> Seen:
        """What there is to show."""
        return Seen(
            self._id,
            self._endpoint,
            self._past[-1][1] if self._past else None,
            self._past[0][1] if self._past else None,
            time.monotonic() - self._heard,
            self._info,
            self._undecodable,
            hint,
            silence(self._gaps) if self._past else SILENT_S,
            self._past[-1][0] - self._past[0][0] if self._past else 0.0,
        )

    def _newest(self) -> RobotState | None:
        waiting: list[zenoh.Sample] = []
        for _ in range(QUEUED):  # no flood holds up the screen
            sample = self._samples.try_recv()
            if sample is None:
                break
            waiting.append(sample)
        for sample in reversed(waiting):
            try:
                state = self._decoder.decode(*encoded(sample))
            except DecodeError:
                self._undecodable += 1
            else:
                self._undecodable = 0
                return state
        return None

    def _ask_info(self) -> Info | None:
        try:
            info: Info = self._robot.get("info")
            return info
        except DecodeError:
            return None  # of another version: it is only for the header

    def _refresh_info(self) -> None:
        try:
            self._info = self._ask_info()
        except MendableError:
            self._info = None


def anew(before: RobotState, state: RobotState) -> bool:
    """It is another daemon's than the state before: its counters began again."""
    return any(state.counters.get(name, 0) < before.counters.get(name, 0) for name in STEADY)


def silence(gaps: Collection[float]) -> float:
    """How long without a state is a silence, by the last times between states, s."""
    longest = min(SLOWEST_S, max(gaps, default=SLOWEST_S))
    return max(SILENT_S, MISSING * longest)
