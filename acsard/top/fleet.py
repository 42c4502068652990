"""The data of `acsard fleet`: the robots present, by their liveliness tokens, and their states."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from threading import Lock

import zenoh

from acsard.client import Client
from acsard.client.follower import FLEET_ASK_S, Follower
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Info, RobotState
from acsard.core.messages.topics import full_key
from acsard.daemon.bus.robot_discovery import ALL, follow, nobody, robot_of, seen
from acsard.daemon.bus.subscription import QUEUED, encoded
from acsard.top.roster import Row

MOST = 1000
"""Maximum number of robots. The bound is needed because any client of the bus can invent robot
names."""


class _Known:
    """The known facts of one robot."""

    def __init__(self) -> None:
        self.here, self.version = False, ""
        self.begin()

    def begin(self) -> None:
        """Query the robot at once, because it appeared or the search for it begins."""
        self.since = self.info_due = time.monotonic()
        self.follower = Follower(self.since, FLEET_ASK_S)
        self.follower.due = self.since


class Fleet:
    """Follows the robots with these ids, or all robots. The callbacks run on Zenoh's threads."""

    def __init__(self, robot: Client, ids: Sequence[str]) -> None:
        self._robot, self._ids, self._endpoint = robot, ids, robot.where.endpoint
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
            with self._lock:
                follower = one.follower
                asks, silent = follower.asks(now), follower.silent(now)
                state = follower.state
                age = follower.age(now) if follower.heard else math.inf
            if asks:
                self._robot.like(name).ask("state", partial(self._state, asked=True))
            if one.here and not one.version and now >= one.info_due:
                one.info_due = now + FLEET_ASK_S
                self._robot.like(name).ask("info", self._info)
            if one.here and not follower.heard and not silent:
                state = None  # wait for the robot's own answer
            rows.append(Row(name, one.here, state, age, one.version, silent))
        return rows

    def gather(self) -> list[Row]:
        """Wait until every robot that is present has answered; return no rows if none is there.

        It takes 1.5 s, or 3 s if no robot is there: on a busy computer the first answer is late.
        """
        began, rows = time.monotonic(), self.rows()
        while not self.whole:
            present = any(row.here or row.state for row in rows)
            if time.monotonic() - began >= (1.5 if present else 3.0):
                return self.rows() if present else []
            time.sleep(0.05)
            rows = self.rows()
        return self.rows()

    @property
    def whole(self) -> bool:
        """Whether all named robots are present and have reported their state and version.

        This is never true if all robots were requested, because their number is unknown.
        """
        with self._lock:
            known = list(self._known.values())
        named = ALL not in self._ids
        return named and all(one.here and one.version and one.follower.heard for one in known)

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
        return (
            f"more than {MOST} robots: the others are left out; name yours with --id robot1,robot2"
        )

    def hint(self) -> str:
        """Return the reason why there may be no robots to show."""
        return nobody(self._endpoint) if ALL in self._ids else "none of these robots is present"

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
            appeared, one.here = not one.here, sample.kind == zenoh.SampleKind.PUT
            if not one.here:
                # A restarted daemon may have another version.
                one.since, one.version = time.monotonic(), ""
            elif appeared:
                one.begin()

    def _state(self, sample: zenoh.Sample, asked: bool) -> None:
        try:
            state = self._states.decode(*encoded(sample))
        except DecodeError:
            return  # another version: the robot is shown as silent
        one = self._of(sample)
        if one is None:
            return
        with self._lock:
            (one.follower.answered if asked else one.follower.published)(state, time.monotonic())

    def _info(self, sample: zenoh.Sample) -> None:
        one = self._of(sample)
        try:
            version = self._infos.decode(*encoded(sample)).version
        except DecodeError:
            version = "?"
        if one is not None:
            one.version = version
