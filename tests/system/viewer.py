"""A viewer that speaks Foxglove's websocket protocol with its own code, without acsard's.

Control messages are JSON. Messages with data are binary: a byte of opcode, then little-endian
fields.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.system.harness import until

MESSAGE, CALL, ANSWER = 1, 2, 3
"""Opcodes: data either way; a service's request, and its reply."""


class Came(NamedTuple):
    """A message of a channel, its time of arrival, and its bytes."""

    at: float
    payload: bytes


PROTOCOL = "foxglove.sdk.v1"


def opened(port: int) -> ClientConnection:
    """A bare connection whose data no task reads."""
    where = f"ws://127.0.0.1:{port}"
    return connect(where, subprotocols=[Subprotocol(PROTOCOL)], close_timeout=0.5)


class Viewer:
    """One connection to the bridge, which sorts all received messages by kind."""

    def __init__(self, port: int) -> None:
        self._opened = ExitStack()
        self._socket = self._opened.enter_context(opened(port))
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.statuses: list[dict[str, Any]] = []
        self.removed: list[str] = []
        self._came: dict[int, list[Came]] = {}
        self._answers: dict[int, tuple[bool, str]] = {}
        self._numbers = iter(range(1, 1 << 30))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        has = lambda: self.info and self.channels and self.services  # noqa: E731
        until(has, 5.0, "what the server has")

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()
        self._thread.join(5.0)

    def _listen(self) -> None:
        try:
            for frame in self._socket:
                if isinstance(frame, str):
                    self._process(json.loads(frame))
                else:
                    self._data(frame)
        except ConnectionClosed:
            pass

    def _process(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "serverInfo":
                self.info = message
            case "advertise":
                self.channels |= {entry["topic"]: entry for entry in message["channels"]}
            case "advertiseServices":
                self.services |= {entry["name"]: entry for entry in message["services"]}
            case "status":
                self.statuses.append(message)
            case "removeStatus":
                self.removed += message["statusIds"]
            case "serviceCallFailure":
                self._answers[message["callId"]] = False, message["message"]

    def _data(self, frame: bytes) -> None:
        if frame[0] == MESSAGE:
            (subscription,) = struct.unpack_from("<I", frame, 1)
            self._came.setdefault(subscription, []).append(Came(time.monotonic(), frame[13:]))
        elif frame[0] == ANSWER:
            _, call, size = struct.unpack_from("<III", frame, 1)
            self._answers[call] = True, frame[13 + size :].decode()

    def _send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    # looking

    def show(self, topic: str) -> SubscribedTopic:
        """Subscribe to a channel."""
        until(lambda: topic in self.channels, 5.0, f"{topic} in {sorted(self.channels)}")
        number, channel = next(self._numbers), self.channels[topic]
        subscriptions = [{"id": number, "channelId": channel["id"]}]
        self._came[number] = []
        self._send("subscribe", subscriptions=subscriptions)
        return SubscribedTopic(channel, self._came[number], lambda: self._hide(number))

    def _hide(self, number: int) -> None:
        self._send("unsubscribe", subscriptionIds=[number])

    def status(self, words: str, within: float = 5.0) -> dict[str, Any]:
        """Wait for a status message that contains these words, and return it."""

        def look() -> dict[str, Any] | None:
            return next(
                (status for status in list(self.statuses) if words in status["message"]), None
            )

        return until(look, within, f"{words!r} among {[s['message'] for s in self.statuses]}")

    # acting

    def publish_on(self, topic: str, schema_name: str) -> Callable[[bytes], None]:
        """Advertise a channel of this viewer in JSON, and return the function that sends on it."""
        number = next(self._numbers)
        channel = {"id": number, "topic": topic, "encoding": "json", "schemaName": schema_name}
        self._send("advertise", channels=[channel])
        return lambda data: self._socket.send(struct.pack("<BI", MESSAGE, number) + data)

    def call(self, service: str, request: object) -> Any:
        """Return the answer of a service. Fails if it refuses."""
        number, name = next(self._numbers), b"json"
        head = struct.pack("<BIII", CALL, self.services[service]["id"], number, len(name))
        self._socket.send(head + name + json.dumps(request).encode())
        done, text = until(lambda: self._answers.get(number), 5.0, f"an answer of {service}")
        assert done, text
        return json.loads(text)


class SubscribedTopic:
    """A topic to which the viewer has subscribed, and its received messages."""

    def __init__(
        self, channel: Mapping[str, Any], came: list[Came], hide: Callable[[], None]
    ) -> None:
        self.channel, self.came, self.hide = channel, came, hide

    def first(self, count: int = 1, within: float = 5.0) -> list[Came]:
        """Wait for `count` messages, and return the first ones."""
        until(lambda: len(self.came) >= count, within, f"{count} of {self.channel['topic']}")
        return self.came[:count]

    def read(self, payload: bytes) -> Any:
        """Decode the message with nothing but the definition that its channel announced."""
        name = self.channel["schemaName"]
        assert (self.channel["encoding"], self.channel["schemaEncoding"]) == ("cdr", "ros2msg")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(self.channel["schema"], name))
        return store.deserialize_cdr(payload, name)
