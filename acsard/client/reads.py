"""What a program reads of a robot: the message type of each key, for the reader and for mypy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import aclosing
from functools import lru_cache, partial
from typing import Any, Literal, TypeVar, overload

from acsard.bus.subscription import Subscription, encoded
from acsard.core.messages.encodings import Decoder
from acsard.core.messages.keys_and_roles import FOLLOWED, TOPICS, by_key, key_hint
from acsard.core.messages.schema import (
    MESSAGES,
    Battery,
    Beat,
    DiagnosticArray,
    Events,
    Imu,
    Info,
    Interfaces,
    JointState,
    Odometry,
    PoseStamped,
    RobotState,
    TFMessage,
    Topics,
    TwistStamped,
)
from acsard.host.errors import UsageError

T = TypeVar("T")

# Keys of `messages` and of `get`. The overloads below are compared with them by a test.
FOLLOWED_KEYS = {topic.key for topic in FOLLOWED}
QUERIED_KEYS = FOLLOWED_KEYS | {
    topic.key for topic in TOPICS if topic.direction == "query" and "<" not in topic.key
}


class Reads(ABC):
    """The methods of a script that read."""

    @abstractmethod
    def _reply(self, name: str) -> tuple[str, bytes]: ...

    @abstractmethod
    def _subscribe(self, name: str) -> Subscription: ...

    @overload
    def get(self, name: Literal["odom"]) -> Odometry: ...
    @overload
    def get(self, name: Literal["tf", "tf_static"]) -> TFMessage: ...
    @overload
    def get(self, name: Literal["wheel_states"]) -> JointState: ...
    @overload
    def get(self, name: Literal["battery"]) -> Battery: ...
    @overload
    def get(self, name: Literal["cmd_vel_out"]) -> TwistStamped: ...
    @overload
    def get(self, name: Literal["state"]) -> RobotState: ...
    @overload
    def get(self, name: Literal["diagnostics"]) -> DiagnosticArray: ...
    @overload
    def get(self, name: Literal["events"]) -> Events: ...
    @overload
    def get(self, name: Literal["beat"]) -> Beat: ...
    @overload
    def get(self, name: Literal["sim/pose"]) -> PoseStamped: ...
    @overload
    def get(self, name: Literal["imu"]) -> Imu: ...
    @overload
    def get(self, name: Literal["info"]) -> Info: ...
    @overload
    def get(self, name: Literal["interfaces"]) -> Interfaces: ...
    @overload
    def get(self, name: Literal["topics"]) -> Topics: ...
    @overload
    def get(self, name: Literal["config"]) -> dict[str, Any]: ...

    def get(self, name: str) -> Any:
        """Return the last message on a key such as `odom` or `state`, decoded to its type.

        Raises `UsageError` for another key, with the most similar one.
        """
        _require(name, QUERIED_KEYS)
        return decoder(name).decode(*self._reply(name))

    @overload
    def messages(
        self, name: Literal["odom"], timeout: float | None = None
    ) -> Iterator[Odometry]: ...
    @overload
    def messages(
        self, name: Literal["tf", "tf_static"], timeout: float | None = None
    ) -> Iterator[TFMessage]: ...
    @overload
    def messages(
        self, name: Literal["wheel_states"], timeout: float | None = None
    ) -> Iterator[JointState]: ...
    @overload
    def messages(
        self, name: Literal["battery"], timeout: float | None = None
    ) -> Iterator[Battery]: ...
    @overload
    def messages(
        self, name: Literal["cmd_vel_out"], timeout: float | None = None
    ) -> Iterator[TwistStamped]: ...
    @overload
    def messages(
        self, name: Literal["state"], timeout: float | None = None
    ) -> Iterator[RobotState]: ...
    @overload
    def messages(
        self, name: Literal["diagnostics"], timeout: float | None = None
    ) -> Iterator[DiagnosticArray]: ...
    @overload
    def messages(
        self, name: Literal["events"], timeout: float | None = None
    ) -> Iterator[Events]: ...
    @overload
    def messages(self, name: Literal["beat"], timeout: float | None = None) -> Iterator[Beat]: ...
    @overload
    def messages(
        self, name: Literal["sim/pose"], timeout: float | None = None
    ) -> Iterator[PoseStamped]: ...
    @overload
    def messages(self, name: Literal["imu"], timeout: float | None = None) -> Iterator[Imu]: ...

    def messages(self, name: str, timeout: float | None = None) -> Iterator[Any]:
        """Yield the messages of a published key as they arrive, decoded to their types.

        The iterator ends after `timeout` s without a message, and when the connection is closed.
        Without a `timeout`, it ends only when the connection is closed. Raises `UsageError` for
        another key, with the most similar one.
        """
        _require(name, FOLLOWED_KEYS)
        return _decoded(name, self._subscribe(name), timeout)


def _decoded(name: str, samples: Subscription, timeout: float | None) -> Iterator[Any]:
    reader = decoder(name)
    for sample in samples.until_silence(timeout):
        yield reader.decode(*encoded(sample))


class AsyncReads(ABC):
    """The methods of an asyncio program that read."""

    _reads: Reads

    @abstractmethod
    def _call(self, function: Callable[[], T]) -> Awaitable[T]: ...

    @overload
    async def get(self, name: Literal["odom"]) -> Odometry: ...
    @overload
    async def get(self, name: Literal["tf", "tf_static"]) -> TFMessage: ...
    @overload
    async def get(self, name: Literal["wheel_states"]) -> JointState: ...
    @overload
    async def get(self, name: Literal["battery"]) -> Battery: ...
    @overload
    async def get(self, name: Literal["cmd_vel_out"]) -> TwistStamped: ...
    @overload
    async def get(self, name: Literal["state"]) -> RobotState: ...
    @overload
    async def get(self, name: Literal["diagnostics"]) -> DiagnosticArray: ...
    @overload
    async def get(self, name: Literal["events"]) -> Events: ...
    @overload
    async def get(self, name: Literal["beat"]) -> Beat: ...
    @overload
    async def get(self, name: Literal["sim/pose"]) -> PoseStamped: ...
    @overload
    async def get(self, name: Literal["imu"]) -> Imu: ...
    @overload
    async def get(self, name: Literal["info"]) -> Info: ...
    @overload
    async def get(self, name: Literal["interfaces"]) -> Interfaces: ...
    @overload
    async def get(self, name: Literal["topics"]) -> Topics: ...
    @overload
    async def get(self, name: Literal["config"]) -> dict[str, Any]: ...

    async def get(self, name: str) -> Any:
        """Return the last message on a key, decoded to its type, as `Client.get` does."""
        _require(name, QUERIED_KEYS)
        return decoder(name).decode(*await self._call(partial(self._reads._reply, name)))

    @overload
    def messages(self, name: Literal["odom"]) -> AsyncIterator[Odometry]: ...
    @overload
    def messages(self, name: Literal["tf", "tf_static"]) -> AsyncIterator[TFMessage]: ...
    @overload
    def messages(self, name: Literal["wheel_states"]) -> AsyncIterator[JointState]: ...
    @overload
    def messages(self, name: Literal["battery"]) -> AsyncIterator[Battery]: ...
    @overload
    def messages(self, name: Literal["cmd_vel_out"]) -> AsyncIterator[TwistStamped]: ...
    @overload
    def messages(self, name: Literal["state"]) -> AsyncIterator[RobotState]: ...
    @overload
    def messages(self, name: Literal["diagnostics"]) -> AsyncIterator[DiagnosticArray]: ...
    @overload
    def messages(self, name: Literal["events"]) -> AsyncIterator[Events]: ...
    @overload
    def messages(self, name: Literal["beat"]) -> AsyncIterator[Beat]: ...
    @overload
    def messages(self, name: Literal["sim/pose"]) -> AsyncIterator[PoseStamped]: ...
    @overload
    def messages(self, name: Literal["imu"]) -> AsyncIterator[Imu]: ...

    def messages(self, name: str) -> AsyncIterator[Any]:
        """Yield the messages of a published key as they arrive, decoded to their types."""
        _require(name, FOLLOWED_KEYS)
        return _arriving(name, self._reads._subscribe(name))


async def _arriving(name: str, subscription: Subscription) -> AsyncIterator[Any]:
    reader = decoder(name)
    async with aclosing(subscription.arriving()) as samples:
        async for sample in samples:
            yield reader.decode(*encoded(sample))


def _require(name: str, keys: set[str]) -> None:
    if name in keys:
        return
    if name in QUERIED_KEYS:
        raise UsageError(f"nothing is published on the key {name}: use get({name!r})")
    raise UsageError(f"{name!r} is not a key of the robot: {key_hint(name)}")


@lru_cache(maxsize=64)
def decoder(name: str) -> Decoder[Any]:
    """Return the decoder for a key; those without a message type (config) give dictionaries."""
    topic = by_key(name)
    cls = None if topic is None else MESSAGES.get(topic.type)
    return Decoder(cls or dict)
