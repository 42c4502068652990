"""Starts the WebSocket server of foxglove-sdk, and contains its callbacks, settings and services.

The protocol of Foxglove has no authentication. So the subcommand (`cli/foxglove.py`) accepts only
an address of this machine.
"""

from __future__ import annotations

import errno
import logging
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from threading import Lock
from typing import Any

import foxglove
import msgspec
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, WebSocketServer

from acsard.client import Client as Robot
from acsard.core.config.live import find_live_setting, flat
from acsard.core.config.settings import RosConfig
from acsard.core.messages.encodings import DecodeError, Decoder, encode
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import PLAIN_SERVICES, SERVICES
from acsard.core.messages.schema import MESSAGES, ServiceReply
from acsard.core.ros.names import NODE, full_name
from acsard.core.values import NS_PER_S, AcsardError, Verb
from acsard.foxglove.drives import DrivingViewers
from acsard.foxglove.notices import Notices
from acsard.host import clock
from acsard.host.errors import InUseError, NotPermittedError
from acsard.host.mailbox import Mailbox

MAX_WAITING_CHANGES = 16
"""Largest number of requested changes of settings that wait until they are sent to the daemon."""

POLL_PERIOD_NS = 5 * NS_PER_S
"""Time between two queries for the robot's settings while a viewer shows them, ns. The queries are
needed because other clients may change the settings."""


class ShownTopics:
    """The topics that viewers show, with the viewers that are subscribed to each topic."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = Lock()
        self._viewers: dict[str, set[int]] = {}
        self._fresh: set[str] = set()

    def add(self, topic: str, client: int) -> None:
        with self._lock:
            self._viewers.setdefault(topic, set()).add(client)
            self._fresh.add(topic)
        self._wake()

    def remove(self, topic: str, client: int) -> None:
        with self._lock:
            left = self._viewers.get(topic, set())
            left.discard(client)
            if not left:
                self._viewers.pop(topic, None)
        self._wake()

    def take(self) -> tuple[set[str], set[str]]:
        """Return two sets: the topics with any viewer, and the topics with a new viewer.

        A viewer of a topic is new if it has subscribed to the topic since the last call.
        """
        with self._lock:
            fresh, self._fresh = self._fresh, set()
            return set(self._viewers), fresh


class Settings:
    """The settings of the robot that viewers can read and change while the daemon runs.

    The main thread calls `learn` and `is_due`, and the server's threads call `get`, `set`, `follow`
    and `unfollow`. None of these calls waits for the daemon, because the main thread must forward
    topics, and the server's threads must pass on a viewer's stop. `refresh` waits for the daemon,
    so the main thread starts a separate thread for each call of `refresh`.
    """

    def __init__(
        self, robot: Robot, notices: Notices, tables: object, wake: Callable[[], None]
    ) -> None:
        self._robot, self._notices = robot, notices
        self._lock = Lock()
        self._wishes = Mailbox[dict[str, Any]](MAX_WAITING_CHANGES, wake)
        self._known: dict[str, Any] = {}
        self._read_ns = clock.mono_ns()
        self._asked = False
        self._followed: set[str] = set()
        self._readable = tables is not None
        self._learned = 0
        """Number of times that the configuration was stored."""
        self.learn(tables)

    def _query(self) -> dict[str, Any]:
        learned = self._learned
        return self.learn(self._robot.get("config"), learned)

    def learn(self, tables: object, learned: int | None = None) -> dict[str, Any]:
        """Store the robot's configuration, and return the settings that have changed.

        `tables` is the configuration as nested dicts, or None if this program may not read it. If
        it was queried, `learned` is the value of `_learned` before the query.
        """
        now = {} if tables is None else live_settings(tables)
        with self._lock:
            if learned not in (None, self._learned):
                # The daemon has restarted during this query, and the main thread has already
                # learned its newer settings.
                return {}
            self._learned += 1
            news = changes(self._known, now)
            self._known, self._read_ns = now, clock.mono_ns()
            self._asked, self._readable = False, tables is not None
        return news

    def get(self, names: Collection[str]) -> dict[str, Any]:
        """Return the known settings with these names, without a query to the daemon.

        If `names` is empty, return all known settings.
        """
        with self._lock:
            self._asked = True
            return select_settings(self._known, names) if names else dict(self._known)

    def follow(self, names: Collection[str]) -> None:
        with self._lock:
            self._followed.update(names)

    def unfollow(self, names: Collection[str]) -> None:
        with self._lock:
            self._followed.difference_update(names)

    def set(self, wishes: dict[str, Any]) -> dict[str, Any]:
        """Queue a change of settings, and return the present values of these settings.

        `refresh` makes the change later. A notice then tells all viewers whether the change
        succeeded. If `MAX_WAITING_CHANGES` changes wait already, the new change is dropped, and a
        notice says so. `wishes` maps settings to their new values.
        """
        with self._lock:
            full = len(self._wishes.waiting) >= MAX_WAITING_CHANGES
            if not full:
                self._wishes.put(wishes)
        if full:
            why = f"{MAX_WAITING_CHANGES} earlier changes wait for the daemon; try again"
            return self.refuse(wishes, why)
        return self._present_values(wishes)

    def refuse(self, wishes: dict[str, Any], why: str) -> dict[str, Any]:
        """Tell all viewers that a change was refused, and return the present values.

        Args:
            wishes: maps the settings of the refused change to their requested values.
            why: the reason of the refusal, as text.
        """
        self._notices.enqueue("error", "set", f"not set: {why}")
        return self._present_values(wishes)

    def _present_values(self, wishes: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            return select_settings(self._known, wishes.keys())

    def _change(self, wishes: dict[str, Any]) -> dict[str, Any]:
        """Change all settings in `wishes`, or none.

        Return the settings that have changed and the settings in `wishes`, with their present
        values. The settings in `wishes` are returned even after a failure, because viewers may
        already show the new values.
        """
        news = dict[str, Any]()
        try:
            if any(value is None for value in wishes.values()):
                raise AcsardError("a setting cannot be removed, only changed")
            reply = self._robot.set(wishes)
            text, done = reply.message, reply.success
            if self._readable:
                news = self._query()
        except AcsardError as error:
            text, done = str(error), False
        self._notices.enqueue(
            "info" if done else "error", "set", text if done else f"not set: {text}"
        )
        return news | self._present_values(wishes)

    def is_due(self, here: bool) -> bool:
        """Return whether `refresh` has a change to make or settings to query.

        `here` says whether the daemon is present; if not, the settings are not queried.
        """
        return bool(self._wishes.waiting) or (here and self._is_query_due())

    def _is_query_due(self) -> bool:
        with self._lock:
            age_ns = clock.mono_ns() - self._read_ns
            asked = self._asked and age_ns > NS_PER_S
            return self._readable and (asked or (bool(self._followed) and age_ns > POLL_PERIOD_NS))

    def refresh(self, here: bool) -> dict[str, Any]:
        """Make one queued change. If no change waits, query the settings if a viewer needs them.

        Return the settings that have changed. This call waits for at most two replies of the
        daemon. `here` says whether the daemon is present; if not, the settings are not queried.
        """
        wishes = self._wishes.pop()
        if wishes is not None:
            return self._change(wishes)
        if not (here and self._is_query_due()):
            return {}
        try:
            return self._query()
        except AcsardError:
            with self._lock:
                self._read_ns = clock.mono_ns()
            return {}  # the daemon is gone, which the bridge reports


def live_settings(config: object) -> dict[str, Any]:
    """Return the settings in `config` that can change while the daemon runs, by dotted key.

    `config` is the configuration as nested dicts. Tuples become lists.
    """
    items = ((key, value) for key, value in flat(config) if find_live_setting(key))
    return {key: list(value) if isinstance(value, tuple) else value for key, value in items}


def select_settings(known: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return those settings in `known` whose names are in `names`."""
    return {key: value for key, value in known.items() if key in names}


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in now.items() if before.get(key) != value}


class Listener:
    """The callbacks for requests of viewers. The server runs them on its own threads."""

    def __init__(self, shown: ShownTopics, drives: DrivingViewers, settings: Settings) -> None:
        self._shown_topics, self._drives, self._settings = shown, drives, settings

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._shown_topics.add(channel.topic, client.id)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        self._shown_topics.remove(channel.topic, client.id)

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        self._drives.advertised(
            client.id, channel.id, channel.topic, channel.encoding, channel.schema_name
        )

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        self._drives.withdrawn(client.id, client_channel_id)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        self._drives.received(client.id, client_channel_id, data)

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[foxglove.Parameter]:
        return as_parameters(self._settings.get(param_names))

    def on_set_parameters(
        self, client: Client, parameters: list[foxglove.Parameter], request_id: str | None = None
    ) -> list[foxglove.Parameter]:
        wishes = {parameter.name: parameter.get_value() for parameter in parameters}
        if len(wishes) < len(parameters):
            ((name, _),) = Counter(parameter.name for parameter in parameters).most_common(1)
            return as_parameters(self._settings.refuse(wishes, f"{name} is in the request twice"))
        return as_parameters(self._settings.set(wishes))

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        self._settings.follow(param_names)

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        self._settings.unfollow(param_names)


def as_parameters(values: dict[str, foxglove.AnyNativeParameterValue]) -> list[foxglove.Parameter]:
    return [foxglove.Parameter(key, value=value) for key, value in values.items()]


def start(
    name: str,
    address: tuple[str, int],
    listener: Listener,
    services: list[foxglove.Service],
    context: foxglove.Context,
    *,
    acts: bool,
) -> WebSocketServer:
    """Start the server, and return it.

    Viewers show the name `name`. `acts` says whether viewers may send commands and change settings.
    Raises `InUseError` if the port is in use, and `NotPermittedError` if the port needs root.
    """
    host, port = address
    takes = [Capability.Services]
    if acts:
        takes += [Capability.ClientPublish, Capability.Parameters]
    try:
        return foxglove.start_server(
            name=name,
            host=host,
            port=port,
            capabilities=takes,
            server_listener=listener,  # type: ignore[arg-type]  # all but playback
            supported_encodings=["json", "cdr"],
            services=services,
            context=context,
            message_backlog_size=256,
        )
    except RuntimeError as error:
        another = f"--address {host}:{max(1024, port % 65535 + 1)}"
        if os.strerror(errno.EACCES) in str(error):
            raise NotPermittedError(
                f"no permission to listen on {host}:{port}; use a port above 1023: {another}"
            ) from None
        raise InUseError(
            f"cannot listen on {host}:{port}: {error}; stop the program that uses the port "
            f"(another acsard foxglove, or foxglove_bridge?), or use another port: {another}"
        ) from None


class Refusals(logging.Handler):
    """Log handler that tells the viewers about each client that foxglove-sdk has refused.

    It ignores all other log messages.
    """

    def __init__(self, notices: Notices) -> None:
        super().__init__(logging.ERROR)
        self._notices = notices

    def emit(self, record: logging.LogRecord) -> None:
        if "handshake failed" in record.getMessage():
            self._notices.enqueue(
                "warning",
                "refused",
                "a client was refused: either it is not a Foxglove viewer, or it is too old for "
                "the protocol foxglove.sdk.v1 (as Lichtblick before 2026 is). Use a newer viewer",
            )


DRIVE_SERVICES: tuple[Verb, ...] = tuple(verb for verb in SERVICES if verb != "set")
"""Services that viewers may call with the option `--drive`: all except `set`. Viewers change
settings through the parameters of Foxglove instead."""

OPEN_SERVICES: tuple[Verb, ...] = ("stop",)
"""Services that viewers may call without the option `--drive`. Only a stop is safe, because any web
page in a local browser can connect, and this server cannot tell which page it is."""

EMPTY_SCHEMA = {"type": "object", "title": "std_srvs/srv/Trigger_Request", "properties": {}}


def services(robot: Robot, ros: RosConfig, verbs: Iterable[Verb]) -> list[foxglove.Service]:
    """Return the services `verbs` of the robot under their ROS names, such as `/acsard/stop`."""
    return [_service(robot, verb, full_name(ros.namespace, f"{NODE}/{verb}")) for verb in verbs]


def _service(robot: Robot, verb: Verb, name: str) -> foxglove.Service:
    payload = "" if verb in PLAIN_SERVICES else SERVICES[verb].payload

    def answer(request: foxglove.ServiceRequest) -> bytes:
        return encode(called(robot, verb, request.payload), "json")

    schema = foxglove.ServiceSchema(
        f"acsard/srv/{payload}" if payload else "std_srvs/srv/Trigger",
        request=_schema(SCHEMAS[payload] if payload else EMPTY_SCHEMA),
        response=_schema(SCHEMAS["ServiceReply"]),
    )
    return foxglove.Service(name, schema=schema, handler=answer)


def called(robot: Robot, verb: Verb, payload: bytes) -> ServiceReply:
    """Call a service of the robot, and return its reply. If the call fails, the reply says why.

    `payload` is the request in JSON.
    """
    try:
        fields: dict[str, float] = {}
        if verb not in PLAIN_SERVICES:
            decoder = Decoder(MESSAGES[SERVICES[verb].payload])
            fields = msgspec.structs.asdict(decoder.decode("application/json", payload))
        return robot.call(verb, **fields)
    except DecodeError as error:
        return ServiceReply(False, f"{verb} needs a payload like {SERVICES[verb].example}: {error}")
    except AcsardError as error:
        return ServiceReply(False, str(error))


def _schema(schema: dict[str, Any]) -> foxglove.MessageSchema:
    data = msgspec.json.encode(schema)
    return foxglove.MessageSchema(
        encoding="json",
        schema=foxglove.Schema(name=schema["title"], encoding="jsonschema", data=data),
    )
