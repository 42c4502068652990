"""The data of `acsard top`: the robot's received states, and the decision when the robot is silent.

States may be published 10 s apart, so the feed queries one at the start. It subscribes to `state`
only, which costs the daemon the same as any other reader of `state`.
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
"""Time over which rates are averaged; over less they would jump."""

GAPS = 8
"""Number of remembered intervals between states. One burst of changes must not replace all of
them."""

MISSING = 3
"""Number of consecutive missing states that count as silence."""

SLOWEST_S = 10.0
"""Interval between states at the lowest configurable rate; also assumed until two states have
arrived."""

STEADY = ("lines", "lines_sent", "commands")
"""Counters that decrease only when the daemon restarts."""


class Feed:
    """The received states of a robot."""

    def __init__(self, robot: Client, endpoint: str, robot_id: str) -> None:
        self._robot, self._endpoint, self._id = robot, endpoint, robot_id
        self._decoder = Decoder(RobotState)
        # The first query also fails with the usual message if no daemon answers.
        self._info = self._ask_info()
        self._samples = robot.subscribe("state")
        self._past: deque[tuple[float, RobotState]] = deque()
        self._heard = time.monotonic()
        self._came: float | None = None
        """Arrival time of the last published state, monotonic clock; answers to queries do not
        count."""
        self._gaps: deque[float] = deque(maxlen=GAPS)
        self._undecodable = 0

    def ask(self) -> None:
        """Query the present state instead of waiting for the next published one.

        Raises `ReplyError`.
        """
        try:
            state: RobotState = self._robot.get("state")
        except DecodeError as error:
            self._undecodable += 1
            raise ReplyError(
                f"cannot read the state ({error}); is the daemon of another version?"
            ) from None
        # A state that arrived before the answer is usually older than it, but not always.
        come = self._newest()
        later = come is not None and come.stamp.to_ns() > state.stamp.to_ns()
        self._take(come if come is not None and later else state)

    def poll(self) -> None:
        """Take the states that were published since the last call."""
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
        """Return the data for the screen; `hint` is shown in the header."""
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
        for _ in range(QUEUED):  # bounded, so a flood cannot block the screen
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
            return None  # another version; the info is only for the header

    def _refresh_info(self) -> None:
        try:
            self._info = self._ask_info()
        except MendableError:
            self._info = None


def anew(before: RobotState, state: RobotState) -> bool:
    """Return whether a counter decreased, which means that the daemon was restarted."""
    return any(state.counters.get(name, 0) < before.counters.get(name, 0) for name in STEADY)


def silence(gaps: Collection[float]) -> float:
    """Return the time in s without a state that counts as silence.

    `gaps` are the last intervals between states, s.
    """
    longest = min(SLOWEST_S, max(gaps, default=SLOWEST_S))
    return max(SILENT_S, MISSING * longest)
