"""Connects the daemon to the Zenoh bus: owns the Zenoh session, and declares the robot's keys.

Every Zenoh call that may block (open, declare, put, reply, close) runs in a thread, never on the
event loop.
"""

from __future__ import annotations

import time
from functools import partial

import zenoh

from acsard.bus.subscription import direct
from acsard.bus.zenoh_sessions import daemon_session
from acsard.core.config.settings import Config
from acsard.core.incoming.bus_interface import BusHealth, Waker
from acsard.core.incoming.imu import SIMULATOR_SENDER
from acsard.core.messages.keys_and_roles import (
    IMU,
    STOP,
    Topic,
    full_key,
    json_key,
    offered,
    published,
)
from acsard.core.messages.signature import Signature
from acsard.core.ros.names import gid
from acsard.core.ros.transports import (
    Endpoint,
    announced_publishers,
    claims,
    endpoints,
    node_tokens,
    unused_keys,
)
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.inbox import Inbox, Replies
from acsard.daemon.bus.outlets import Outlets
from acsard.daemon.bus.router_links import RouterLinks
from acsard.host import clock
from acsard.host.errors import InUseError, MendableError
from acsard.host.threads import NoThreadError, in_thread

OPEN_TIMEOUT_S = 10.0
CLOSE_TIMEOUT_S = 0.3

TWIN_TIMEOUT_S = 0.5  # for another daemon with this robot id or these ROS names


class ZenohBus:
    """The robot's keys on the bus, for the duration of an `async with` block.

    To the control loop it is a `Bus`.
    """

    def __init__(self, config: Config, waker: Waker) -> None:
        # `waker` wakes the control loop for a command or a stop.
        self._config, self._id = config, config.robot.id
        self._alive = full_key(self._id, "alive")
        prefix = full_key(self._id, "")
        self._thread_errors: list[BaseException] = []  # ended threads of the bus
        self._replies = Replies(prefix, self._thread_errors)
        sources = tuple(source.name for source in config.commands.sources)
        self._inbox = Inbox(prefix, self._replies, sources, waker, config.rate_hz)
        # Clients of this machine are trusted, and the TLS gateway lets the others use exact keys
        # only. A router, a wildcard or a client without a certificate can lock the session's tables
        # for seconds, and the first put that meets the lock would already cost periods.
        lockable = config.bus.connect or config.bus.insecure or config.access.wildcards
        self.output = Outlets(self._thread_errors, direct=not lockable)
        # Methods of this class would be one more call in each wake-up.
        self.take = self._inbox.take
        self.reply, self.retire = self._replies.send, self._replies.retire
        self._links = RouterLinks(config.bus, self._thread_errors)
        self._session: zenoh.Session
        self._entities: list[object] = []  # Zenoh undeclares an entity when nothing refers to it

    def look(self) -> BusHealth:
        return BusHealth(*self.output.losses(clock.mono_ns()), self._links.changes.pop())

    # Opening the session.

    async def __aenter__(self) -> ZenohBus:
        # In client mode the daemon can do nothing without its router, so it waits for the router.
        patience_s = OPEN_TIMEOUT_S if self._config.bus.mode == "peer" else None
        try:
            self._session = await in_thread(self._open, patience_s)
        except NoThreadError as error:
            raise MendableError(f"cannot open the bus: {error}") from None
        except TimeoutError:
            raise MendableError(
                f"the bus did not open within {patience_s:g} s: this computer is overloaded, or a "
                "disk with certificates does not answer; start the daemon again"
            ) from None
        return self

    def _open(self) -> zenoh.Session:
        config, ros = self._config, self._config.ros
        session = daemon_session(config)
        if config.bus.connect:
            conflict = self._conflict(_others(session, self._alive, claims(ros)))
            if conflict:
                session.close()
                raise InUseError(conflict)
        # Set `own_id` before the first key is declared, because a sample may arrive immediately
        # afterwards.
        self._inbox.own_id = session.new_timestamp().get_id()
        self._replies.start(session)
        self._declare_native(session)
        zid = str(session.zid())
        for endpoint in endpoints(ros, zid, unused_keys(config)):
            self._declare_ros(session, endpoint)
        for tokens, source, transport in announced_publishers(config):
            on_token = direct(partial(self._inbox.on_token, source, transport))
            subscriber = session.liveliness().declare_subscriber(tokens, on_token, history=True)
            self._entities.append(subscriber)
        for token in (self._alive, *claims(ros), *node_tokens(ros, zid)):
            self._entities.append(session.liveliness().declare_token(token))
        self.output.start()
        self._links.start(session)
        return session

    def _conflict(self, tokens: set[str]) -> str:
        # `tokens` of this robot are another session's.
        if self._alive in tokens:
            return (
                f"another daemon on this bus already has the id {self._id}; give this robot its "
                "own robot.id"
            )
        transports = [
            name for name in ("bridge", "rmw") if any(f"/@ros/{name}/" in token for token in tokens)
        ]
        if transports:
            off = " and ".join(f"ros.{name} = false" for name in transports)
            return (
                "another robot on this bus already has ros.namespace = "
                f'"{self._config.ros.namespace}": '
                f"a ROS cmd_vel over {' or '.join(transports)} would drive both robots. Either "
                "give this robot its own namespace ([ros] namespace or `acsard run --namespace "
                f"NAME`), or set {off}"
            )
        return ""

    def _declare_native(self, session: zenoh.Session) -> None:
        inbox = self._inbox
        for topic in offered(self._config):
            key = full_key(self._id, topic.pattern)
            if topic.direction == "in":
                received = (
                    partial(inbox.on_stop, "native") if topic.key == STOP else inbox.on_sample
                )
                self._entities.append(session.declare_subscriber(key, direct(received)))
            elif topic.key not in ("alive", json_key("<key>")):
                on_query = direct(partial(inbox.on_query, topic.key))
                self._entities.append(session.declare_queryable(key, on_query))
        for topic in published(self._config):
            key = full_key(self._id, topic.key)
            signed = Signature(SIMULATOR_SENDER).pack() if topic.key == IMU else b""
            self.output.declare(
                session, topic.key, key, "msgpack", topic.type, topic.latched, signed=signed
            )
            self._declare_json(session, topic)

    def _declare_json(self, session: zenoh.Session, topic: Topic) -> None:
        # The JSON key is for clients without msgpack.
        below = json_key(topic.key)
        key = full_key(self._id, below)
        # The publisher is not latched: a latched publisher encodes every message even without
        # subscribers. A late subscriber can query the key for the newest message instead.
        self.output.declare(session, topic.key, key, "json", topic.type)
        on_query = direct(partial(self._inbox.on_query, below))
        self._entities.append(session.declare_queryable(key, on_query))

    def _declare_ros(self, session: zenoh.Session, endpoint: Endpoint) -> None:
        key = endpoint.key
        match endpoint.direction:
            case "in":
                on_sample = partial(self._inbox.on_ros_sample, endpoint)
                if endpoint.native == STOP:
                    on_sample = partial(self._inbox.on_stop, endpoint.transport)
                self._entities.append(session.declare_subscriber(key, direct(on_sample)))
            case "query" | "service":
                on_query = direct(partial(self._inbox.on_ros_query, endpoint))
                # Clients of rmw_zenoh query only complete queryables.
                self._entities.append(session.declare_queryable(key, on_query, complete=True))
            case "out":
                identity = gid(endpoint.token) if endpoint.transport == "rmw" else b""
                self.output.declare(
                    session, endpoint.native, key, "cdr", "", endpoint.latched, identity
                )
        if endpoint.token:
            self._entities.append(session.liveliness().declare_token(endpoint.token))

    # Closing the session.

    async def __aexit__(self, *_: object) -> None:
        self._replies.stop()
        try:
            await in_thread(self._close, CLOSE_TIMEOUT_S)
        except TimeoutError:
            # A remote program that hangs must not delay the end of this process.
            pass

    def _close(self) -> None:
        self.output.stop(CLOSE_TIMEOUT_S)
        self._links.stop()
        self._session.close()


def _others(session: zenoh.Session, alive: str, claims: tuple[str, ...]) -> set[str]:
    # Blocks for up to `TWIN_TIMEOUT_S`.
    liveliness = session.liveliness()
    subscribers = {
        token: liveliness.declare_subscriber(token, history=True) for token in (alive, *claims)
    }
    deadline_ns = clock.now().mono_ns + int(TWIN_TIMEOUT_S * NS_PER_S)
    tokens: set[str] = set()
    # Another daemon with this robot's id usually also has this robot's ROS names. The message about
    # the id is clearer, so wait for the token of the id until the deadline.
    while alive not in tokens and clock.now().mono_ns < deadline_ns:
        time.sleep(0.01)
        tokens |= {token for token, other in subscribers.items() if other.try_recv() is not None}
    for subscriber in subscribers.values():
        subscriber.undeclare()
    return tokens
