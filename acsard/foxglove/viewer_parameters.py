"""The robot's live settings as the viewers' parameters: reads, changes and follows them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from threading import Lock
from typing import Any

from acsard.client import Client
from acsard.core.config.live import flat, live
from acsard.core.values import NS_PER_S, AcsardError
from acsard.foxglove.notices import Notices
from acsard.host import clock

POLL_NS = 5 * NS_PER_S
"""Interval at which the settings are read while a viewer follows them, because other clients change
them too."""


class Settings:
    """The live settings. The server's threads query them; the main thread reads them again."""

    def __init__(self, robot: Client, notices: Notices, tables: object) -> None:
        self._robot, self._notices = robot, notices
        self._lock = Lock()
        self._known: dict[str, Any] = {}
        self._read_ns = clock.mono_ns()
        self._asked = False
        self._followed: set[str] = set()
        self._readable = tables is not None
        self.learn(tables)

    def learn(self, tables: object) -> dict[str, Any]:
        """Store the configuration and return the settings that changed.

        `tables` is None if this program may not read the configuration.
        """
        now = {} if tables is None else values(tables)
        with self._lock:
            news = changes(self._known, now)
            self._known, self._read_ns = now, clock.mono_ns()
            self._asked, self._readable = False, tables is not None
        return news

    def get(self, names: Collection[str]) -> dict[str, Any]:
        """Return the settings with these names, or all, as last read."""
        with self._lock:
            self._asked = True
            return asked(self._known, names)

    def follow(self, names: Collection[str]) -> None:
        """Record that a viewer follows these settings."""
        with self._lock:
            self._followed.update(names)

    def unfollow(self, names: Collection[str]) -> None:
        """Record that no viewer follows these settings any longer."""
        with self._lock:
            self._followed.difference_update(names)

    def set(self, wishes: Mapping[str, Any]) -> dict[str, Any]:
        """Change settings, all or none, and return their values afterwards.

        A refusal is reported to the viewers.
        """
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
            return asked(self._known, wishes.keys()) if wishes else {}

    def refresh(self) -> dict[str, Any]:
        """Read the settings again if a viewer needs them; return the settings that changed."""
        with self._lock:
            age_ns = clock.mono_ns() - self._read_ns
            due = (self._asked and age_ns > NS_PER_S) or (self._followed and age_ns > POLL_NS)
        if not due or not self._readable:
            return {}
        try:
            return self.learn(self._robot.get("config"))
        except AcsardError:
            with self._lock:
                self._read_ns = clock.mono_ns()
            return {}  # the daemon is gone, which the bridge reports


def values(config: object) -> dict[str, Any]:
    """Return the settings that can be changed at run time, by key, tuples as lists."""
    found = ((key, value) for key, value in flat(config) if live(key))
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found}


def asked(known: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the settings with these names, or all of them if `names` is empty."""
    return {key: value for key, value in known.items() if key in names or not names}


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in now.items() if before.get(key) != value}
