"""The robot's services and live settings in the form that viewers call and change."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from threading import Lock
from typing import Any

import foxglove
import msgspec

from acsard.client import Client
from acsard.config.settings import RosConfig
from acsard.foxglove import viewer_messages
from acsard.foxglove.notices import Notices
from acsard.host import clock
from acsard.messages.encodings import DecodeError, Decoder, encode
from acsard.messages.json_schema import SCHEMAS
from acsard.messages.schema import ServiceReply, SetPose
from acsard.messages.topics import SERVICES
from acsard.ros.names import full_name
from acsard.values import NS_PER_S, AcsardError

CALLED = tuple(verb for verb in SERVICES if verb != "set")
"""Services that are offered; `set` is left out because viewers set parameters instead."""

STOPS = ("stop",)
"""Services that are offered without `--drive`. Any web page in a local browser can connect, and the
browser does not identify the page, so only a stop is safe."""

NOTHING = {"type": "object", "title": "std_srvs/srv/Trigger_Request", "properties": {}}

_poses = Decoder(SetPose)


def services(robot: Client, ros: RosConfig, verbs: Iterable[str]) -> list[foxglove.Service]:
    """Return the services for these verbs under their ROS names, for example `/acsard/stop`."""
    return [_service(robot, verb, full_name(ros.namespace, f"{ros.node}/{verb}")) for verb in verbs]


def _service(robot: Client, verb: str, name: str) -> foxglove.Service:
    posed = verb == "set_pose"

    def answer(request: foxglove.ServiceRequest) -> bytes:
        return encode(called(robot, verb, request.payload), "json")

    schema = foxglove.ServiceSchema(
        "acsard/srv/SetPose" if posed else "std_srvs/srv/Trigger",
        request=_schema(SCHEMAS["SetPose"] if posed else NOTHING),
        response=_schema(SCHEMAS["ServiceReply"]),
    )
    return foxglove.Service(name, schema=schema, handler=answer)


def called(robot: Client, verb: str, payload: bytes) -> ServiceReply:
    """Call a service. An error becomes a negative reply."""
    try:
        fields: dict[str, float] = {}
        if verb == "set_pose":
            fields = msgspec.structs.asdict(_poses.decode("application/json", payload))
        return robot.call(verb, **fields)
    except DecodeError as error:
        return ServiceReply(False, f"{verb} wants {{x, y, yaw}}, m and rad: {error}")
    except AcsardError as error:
        return ServiceReply(False, str(error))


def _schema(schema: dict[str, Any]) -> foxglove.MessageSchema:
    data = msgspec.json.encode(schema)
    return foxglove.MessageSchema(
        encoding="json",
        schema=foxglove.Schema(name=schema["title"], encoding="jsonschema", data=data),
    )


OLD_NS = NS_PER_S
"""Age at which the settings are read again for a viewer that asks."""

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
        now = {} if tables is None else viewer_messages.parameter_values(tables)
        with self._lock:
            news = viewer_messages.changed(self._known, now)
            self._known, self._read_ns = now, clock.mono_ns()
            self._asked, self._readable = False, tables is not None
        return news

    def get(self, names: Collection[str]) -> dict[str, Any]:
        """Return the settings with these names, or all, as last read."""
        with self._lock:
            self._asked = True
            return viewer_messages.selected(self._known, names)

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
            return viewer_messages.selected(self._known, wishes.keys()) if wishes else {}

    def refresh(self) -> dict[str, Any]:
        """Read the settings again if a viewer needs them; return the settings that changed."""
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
            return {}  # the daemon is gone, which the bridge reports
