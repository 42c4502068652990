"""The data of `acsard fleet`: the robots present, by their liveliness tokens, and their states."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from threading import Lock

import zenoh

from acsard.bus.robot_discovery import ALL, follow, nobody, robot_of, seen
from acsard.bus.subscription import QUEUED, encoded
from acsard.client import Client
from acsard.client.driving import Answers
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import Info, RobotState
from acsard.messages.topics import full_key
from acsard.top.roster import Row
from acsard.top.seen import SILENT_S

ASK_S = 2.0
"""Interval of queries to a robot that is present but silent."""

SILENCE_S = SILENT_S + ASK_S
"""Age from which a robot counts as silent: the last answer may be this late."""

NEVER = -math.inf

MOST = 1000
"""Maximum number of robots. The bound is needed because any client of the bus can invent robot
names."""


class _Known:
    """The known facts of one robot."""

    def __init__(self) -> None:
        self.here = False
        self.since = time.monotonic()
        """Time when the robot appeared, or when the search for it began."""
        self.said: tuple[RobotState | None, float] = None, NEVER
        """State and arrival time in one value, because another thread reads it.

        The time is `NEVER` for a first answer to a query, which a router's storage may have sent.
        """
        self.asked = NEVER
        self.answered = Answers()
        self.version = ""


class Fleet:
    """Follows the robots with these ids, or all robots. The callbacks run on Zenoh's threads."""

    def __init__(self, robot: Client, ids: Sequence[str], endpoint: str) -> None:
        self._robot, self._ids, self._endpoint = robot, ids, endpoint
        self._lock = Lock()
        self._left_out = False
        self._known = {one: _Known() for one in ids if one != ALL}
        self._states, self._infos = Decoder(RobotState), Decoder(Info)
        self._samples = follow(robot.session, ids, "state")
        liveliness = robot.session.liveliness()
        for one in ids:
            liveliness.declare_subscriber(full_key(one, "alive"), self._token, history=True)

    def rows(self) -> list[Row]:
        """Process the received samples, query silent robots, and return one row per robot."""
        for _ in range(QUEUED):
            sample = self._samples.try_recv()
            if sample is None:
                break
            self._state(sample, asked=False)
        now = time.monotonic()
        with self._lock:
            known = list(self._known.items())
        rows = []
        for name, one in known:
            state, heard = one.said
            unheard = one.here and (heard == NEVER or not one.version)
            if now - max(heard, one.asked) > ASK_S or unheard:
                self._ask(name, one, now)
            if one.here and heard == NEVER and now - one.since < SILENCE_S:
                state = None  # wait for the robot's own answer
            age = max(0.0, now - heard)
            rows.append(Row(name, one.here, state, age, one.version, SILENCE_S))
        return rows

    @property
    def whole(self) -> bool:
        """Whether all named robots are present and have reported their state and version.

        This is never true if all robots were requested, because their number is unknown.
        """
        with self._lock:
            known = list(self._known.values())
        named = ALL not in self._ids
        return named and all(one.here and one.version and one.said[1] > NEVER for one in known)

    @property
    def seen(self) -> str:
        """Number of present robots and where they were found; "" if the robots were named."""
        with self._lock:
            here = sum(one.here for one in self._known.values())
        return seen(self._endpoint, here) if ALL in self._ids else ""

    @property
    def more(self) -> str:
        """Note that some robots are left out, or ""."""
        if not self._left_out:
            return ""
        return f"more than {MOST} robots: the others are left out; name yours, --id robot1,robot2"

    def hint(self) -> str:
        """Return the reason why there may be no robots to show."""
        return nobody(self._endpoint) if ALL in self._ids else "none of these robots is there"

    def _ask(self, name: str, one: _Known, now: float) -> None:
        if now - one.asked < ASK_S / 2:
            return
        one.asked = now
        other = self._robot.like(name)
        other.ask("state", partial(self._state, asked=True))
        other.ask("info", self._info)

    def _of(self, sample: zenoh.Sample) -> _Known | None:
        name = robot_of(str(sample.key_expr))
        with self._lock:
            if name not in self._known and name:
                if len(self._known) >= MOST:
                    self._forget_one()
                if len(self._known) < MOST:
                    self._known[name] = _Known()
                else:
                    self._left_out = True
            return self._known.get(name)

    def _forget_one(self) -> None:
        """Drop the unnamed robot that has been gone for the longest time."""
        gone = [(one.since, name) for name, one in self._known.items() if not one.here]
        for _, name in sorted(one for one in gone if one[1] not in self._ids)[:1]:
            del self._known[name]

    def _token(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        if one is not None:
            one.here = sample.kind == zenoh.SampleKind.PUT
            one.since = time.monotonic()
            if not one.here:
                one.version = ""  # a restarted daemon may have another version

    def _state(self, sample: zenoh.Sample, asked: bool) -> None:
        try:
            state = self._states.decode(*encoded(sample))
        except DecodeError:
            return  # another version: the robot is shown as silent
        one = self._of(sample)
        if one is None:
            return
        held = one.said[0]
        if not asked or one.answered.news(state, held):
            one.said = state, time.monotonic()
        elif held is None:
            one.said = state, NEVER

    def _info(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        try:
            version = self._infos.decode(*encoded(sample)).version
        except DecodeError:
            version = "?"
        if one is not None:
            one.version = version
