"""Starts the WebSocket server of foxglove-sdk, which shows topics and offers the service `stop`.

The protocol of Foxglove has no authentication, and any web page in a local browser can connect. So
the subcommand (`cli/foxglove.py`) accepts only an address of this machine, and viewers can only
stop the robot.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from threading import Lock
from typing import Any

import foxglove
import msgspec
from foxglove.websocket import Capability, ChannelView, Client, WebSocketServer

from acsard.client.connection import Connection as Robot
from acsard.core.config.settings import RosConfig
from acsard.core.messages.encodings import encode
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.schema import ServiceReply
from acsard.core.ros.names import NODE, full_name
from acsard.core.values import AcsardError
from acsard.host.errors import InUseError, NotPermittedError


class ShownTopics:
    """The topics that viewers show, with the viewers that are subscribed to each topic.

    The server calls `on_subscribe` and `on_unsubscribe` on its own threads.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = Lock()
        self._viewers: dict[str, set[int]] = {}
        self._fresh: set[str] = set()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            self._viewers.setdefault(channel.topic, set()).add(client.id)
            self._fresh.add(channel.topic)
        self._wake()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            left = self._viewers.get(channel.topic, set())
            left.discard(client.id)
            if not left:
                self._viewers.pop(channel.topic, None)

    def take(self) -> tuple[set[str], set[str]]:
        """Return the topics with any viewer, and those with a new viewer since the last call."""
        with self._lock:
            fresh, self._fresh = self._fresh, set()
            return set(self._viewers), fresh


def start(
    robot: Robot,
    ros: RosConfig,
    address: tuple[str, int],
    shown_topics: ShownTopics,
    context: foxglove.Context,
) -> WebSocketServer:
    """Start the server. Raises `InUseError`, or `NotPermittedError` if the port needs root."""
    host, port = address
    try:
        return foxglove.start_server(
            name=f"acsard {robot.where.robot_id}",
            host=host,
            port=port,
            capabilities=[Capability.Services],
            server_listener=shown_topics,  # type: ignore[arg-type]  # it needs no other callbacks
            supported_encodings=["json"],
            services=[stop_service(robot, ros)],
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


def stop_service(robot: Robot, ros: RosConfig) -> foxglove.Service:
    """Return the service that stops the robot, under its ROS name, such as `/acsard/stop`."""

    def answer(request: foxglove.ServiceRequest) -> bytes:
        try:
            reply = robot.call("stop")
        except AcsardError as error:
            reply = ServiceReply(False, str(error))
        return encode(reply, "json")

    request = {"type": "object", "title": "std_srvs/srv/Trigger_Request", "properties": {}}
    schema = foxglove.ServiceSchema(
        "std_srvs/srv/Trigger",
        request=_schema(request),
        response=_schema(SCHEMAS["ServiceReply"]),
    )
    return foxglove.Service(full_name(ros.namespace, f"{NODE}/stop"), schema=schema, handler=answer)


def _schema(schema: Mapping[str, Any]) -> foxglove.MessageSchema:
    return foxglove.MessageSchema(
        encoding="json",
        schema=foxglove.Schema(
            name=schema["title"], encoding="jsonschema", data=msgspec.json.encode(schema)
        ),
    )
