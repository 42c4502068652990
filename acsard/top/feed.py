"""Collects the data of `acsard top`: the states of the robot, and the `info` of its daemon."""

from __future__ import annotations

import time
from collections import deque

from acsard.client.connection import Connection
from acsard.client.follower import Watch, restarted
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import Info, RobotState
from acsard.host import clock
from acsard.host.errors import MendableError, NoAnswerError
from acsard.top.screen import ScreenData


class Feed:
    """Receives the states of a robot, and keeps those of about the last second."""

    def __init__(self, robot: Connection) -> None:
        self._robot = robot
        # Query `info` first: if no daemon answers, this query raises an error with a clear message.
        self._info = self._ask_info()
        self._watch = Watch(robot, clock.steady_s())
        self._past: deque[tuple[float, RobotState]] = deque()

    def poll(self) -> None:
        """Store the newest state that has arrived since the last call."""
        now = clock.steady_s()
        for state in self._watch.poll(now)[-1:]:
            self._take(state, now)

    def _take(self, state: RobotState, now: float) -> None:
        if self._past and restarted(self._past[-1][1], state):
            self._past.clear()
            self._refresh_info()
        self._past.append((now, state))
        # Rates are averaged over a second. Over a shorter time they would jump.
        while len(self._past) > 2 and now - self._past[1][0] >= 1.0:
            self._past.popleft()

    def wait(self) -> None:
        """Wait for the states of half a second, over which rates are averaged, or of 3 s at most.

        Raises `NoAnswerError` without any state.
        """
        begun = clock.steady_s()
        while self.screen_data().passed < 0.5 and clock.steady_s() - begun < 3.0:
            time.sleep(0.05)
            self.poll()
        if self._watch.state is None:
            raise NoAnswerError(self._watch.silence(clock.steady_s()))

    def screen_data(self, hint: str = "") -> ScreenData:
        """Return what the screen of `acsard top` shows, with a text for its header."""
        now, watch, past = clock.steady_s(), self._watch, self._past
        return ScreenData(
            self._robot.where.robot_id,
            self._robot.where.endpoint,
            watch.state,
            past[0][1] if past else None,
            watch.age(now),
            self._info,
            watch.unreadable,
            hint,
            watch.silent(now),
            past[-1][0] - past[0][0] if past else 0.0,
        )

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
