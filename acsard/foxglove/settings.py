"""The viewers' parameters: what the robot's live settings are, and what they are to be."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from threading import Lock
from typing import Any

from acsard.client import Client
from acsard.foxglove import parameters
from acsard.foxglove.notices import Notices
from acsard.host import clock
from acsard.values import NS_PER_S, AcsardError

OLD_NS = NS_PER_S
"""What was read longer ago is read again for who asks."""

POLL_NS = 5 * NS_PER_S
"""While somebody follows them: others may set them too."""


class Settings:
    """Asked by the server's threads, read again by the main one."""

    def __init__(self, robot: Client, notices: Notices, tables: object) -> None:
        self._robot, self._notices = robot, notices
        self._lock = Lock()
        self._known: dict[str, Any] = {}
        self._read_ns = clock.mono_ns()
        self._asked = self._followed = False
        self._readable = tables is not None
        self.learn(tables)

    def learn(self, tables: object) -> dict[str, Any]:
        """The configuration is this one, None where we may not read it; what is new."""
        now = {} if tables is None else parameters.values(tables)
        with self._lock:
            news = parameters.news(self._known, now)
            self._known, self._read_ns = now, clock.mono_ns()
            self._asked, self._readable = False, tables is not None
        return news

    def get(self, names: Collection[str]) -> dict[str, Any]:
        """Those of these names, or all; as they were read last."""
        with self._lock:
            self._asked = True
            return parameters.asked(self._known, names)

    def follow(self, *, followed: bool) -> None:
        """Somebody wants to know of changes, or nobody does any more."""
        with self._lock:
            self._followed = followed

    def set(self, wishes: Mapping[str, Any]) -> dict[str, Any]:
        """Set these, all or none; what they are then. A refusal is told in the daemon's words."""
        try:
            if any(value is None for value in wishes.values()):
                raise AcsardError("a setting cannot be removed, only changed")
            reply = self._robot.set(wishes)
            said, done = reply.message, reply.success
            if self._readable:
                self.learn(self._robot.get("config"))
        except AcsardError as error:
            said, done = str(error), False
        self._notices.say("info" if done else "error", "set", said if done else f"not set: {said}")
        with self._lock:
            return parameters.asked(self._known, wishes.keys()) if wishes else {}

    def refresh(self) -> dict[str, Any]:
        """Read them again if somebody wants to know; what is new."""
        with self._lock:
            age_ns = clock.mono_ns() - self._read_ns
            due = (self._asked and age_ns > OLD_NS) or (self._followed and age_ns > POLL_NS)
        if not due or not self._readable:
            return {}
        try:
            return self.learn(self._robot.get("config"))
        except AcsardError:
            with self._lock:
                self._read_ns = clock.mono_ns()
            return {}  # the daemon is gone, which is told elsewhere
