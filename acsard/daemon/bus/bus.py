"""Owns the daemon's Zenoh session and its keys, takes input from the bus and publishes to it.

Every Zenoh call that may block (open, declare, put, reply, close) runs in a thread, never on the
event loop. A further thread watches whether the endpoints of `bus.connect` are connected.
"""

from __future__ import annotations

import socket
import time
from functools import partial
from threading import Event, Thread
from types import TracebackType

import zenoh
from msgspec.structs import replace

from acsard.core.config.settings import BusConfig, RosConfig
from acsard.core.incoming.bus_interface import BusInput, Waker
from acsard.core.incoming.imu import OWN
from acsard.core.incoming.queries import Reply
from acsard.core.messages.encodings import encoding_name
from acsard.core.messages.schema import Message
from acsard.core.messages.signature import Signature
from acsard.core.messages.topics import IMU, Topic, full_key, json_key
from acsard.core.ros.names import gid
from acsard.core.ros.transports import Endpoint, claims, command_keys, endpoints, node_tokens
from acsard.core.values import NS_PER_S, RoutersStatus
from acsard.daemon.bus.inbox import Inbox, Replies
from acsard.daemon.bus.outlets import Outlets, direct
from acsard.daemon.bus.zenoh_sessions import daemon_session
from acsard.host import clock
from acsard.host.errors import InUseError
from acsard.host.threads import in_thread

EVERY_S = 0.5
"""Seconds between two polls. One poll takes Zenoh 0.1 ms."""

STOP_S = 0.05


class Links:
    """Watcher of the links of one session.

    Zenoh reconnects by itself and does not report it, so nobody would notice a missing router. A
    thread of its own polls Zenoh, because the call may block.
    """

    def __init__(self, bus: BusConfig, inbox: Inbox) -> None:
        """Prepare the watcher. It writes the ids of connected routers to `inbox.routers`."""
        self._bus, self._inbox = bus, inbox
        self._status: RoutersStatus | None = None
        self._news = False
        """Whether the status has changed. It is set after the status, so that no change is
        overlooked."""
        self._over = Event()
        self._thread = Thread(target=self._run, name="links", daemon=True)
        self._session: zenoh.Session

    def news(self) -> RoutersStatus | None:
        """Return the status if it has changed since the last call, else None. Never wait."""
        if not self._news:
            return None
        self._news = False
        return self._status

    def start(self, session: zenoh.Session) -> None:
        """Start polling.

        Poll even without `bus.connect`, because a router may have connected to the daemon.
        """
        self._session = session
        self._thread.start()

    def stop(self) -> None:
        """Stop polling. Do not wait for a name lookup that is under way."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(STOP_S)

    def _run(self) -> None:
        connects = False  # the first poll reports nothing: Zenoh has had no time to connect yet
        while True:
            status = self._look()
            if connects and status != self._status:
                self._status, self._news = status, True
            connects = bool(self._bus.connect)
            if self._over.wait(EVERY_S):
                return

    def _look(self) -> RoutersStatus:
        endpoints = self._bus.connect
        try:
            info = self._session.info
            far = {str(link.dst): str(link.zid) for link in info.links()}
            kinds = {str(one.zid): one.whatami for one in info.transports()}
        except zenoh.ZError:  # the session is closing
            return self._status or RoutersStatus()
        routers = (zid for zid, kind in kinds.items() if kind == zenoh.WhatAmI.ROUTER)
        self._inbox.routers = frozenset(routers)
        missing = unreached(self._bus.mode, endpoints, set(far))
        connected = tuple(one for one in endpoints if one not in missing)
        ends = {end for end, zid in far.items() if kinds.get(zid) == zenoh.WhatAmI.PEER}
        peers = tuple(one for one in connected if _leads_there(one, ends))
        return RoutersStatus(connected, missing, peers)


def unreached(mode: str, endpoints: tuple[str, ...], ends: set[str]) -> tuple[str, ...]:
    """Return the endpoints that no link leads to, given the far `ends` of all links.

    A client has one link only, so with any link it misses none. A program that connected to the
    daemon (the TLS gateway, a bridge, a ROS node) has an ephemeral port at its end and matches no
    endpoint. Host names are resolved, which may block.
    """
    if mode == "client":
        return () if ends else endpoints
    return tuple(one for one in endpoints if not _leads_there(one, ends))


def _leads_there(endpoint: str, ends: set[str]) -> bool:
    """Return whether a link leads to the endpoint.

    Zenoh lists addresses; the endpoint may be a name.
    """
    bare = endpoint.partition("?")[0].partition("#")[0]
    protocol, _, place = bare.partition("/")
    host, _, port = place.rpartition(":")
    if bare in ends:
        return True
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    except (OSError, ValueError):  # the name no longer resolves, which does not end a link
        return bool(port) and any(
            end.startswith(f"{protocol}/") and end.endswith(f":{port}") for end in ends
        )
    hosts = (str(one[4][0]) for one in found)
    return any(f"{protocol}/{f'[{one}]' if ':' in one else one}:{port}" in ends for one in hosts)


OPEN_TIMEOUT_S = 10.0
CLOSE_TIMEOUT_S = 0.3

TWIN_PATIENCE_S = 0.5
"""Seconds to listen for another daemon with this robot's id or ROS names before claiming them."""


class ZenohBus:
    """The robot's keys on the bus, declared while the context manager is entered."""

    def __init__(
        self,
        bus: BusConfig,
        ros: RosConfig,
        silent: frozenset[str],
        robot_id: str,
        sources: tuple[str, ...],
        access: dict[str, object],
        waker: Waker,
        topics: tuple[Topic, ...],
        published: tuple[Topic, ...],
    ) -> None:
        """Store the settings; entering the bus opens the session.

        Args:
            silent: native keys that get no ROS endpoint.
            sources: names of the listed command sources.
            access: the value of Zenoh's `access_control`.
            topics: rows of the topic table that this robot offers.
            published: rows that the daemon publishes.
        """
        self._settings, self._ros, self._id, self._sources = bus, ros, robot_id, sources
        self._access, self._silent = access, silent
        self._topics, self._published = topics, published
        self._alive = full_key(robot_id, "alive")
        prefix = full_key(robot_id, "")
        self._replies = Replies(prefix)
        self._inbox = Inbox(prefix, self._replies, sources, waker)
        self._outlets, self._links = Outlets(), Links(bus, self._inbox)
        self._session: zenoh.Session
        self._kept: list[object] = []
        """Declared entities. Zenoh undeclares an entity when nothing refers to it."""

    # The control loop calls the methods below.

    @property
    def wanted(self) -> frozenset[str]:
        """Published topics that have a listener in any tree."""
        return self._outlets.wanted

    def take(self, queries: int) -> BusInput:
        """Return the input since the last call, with at most `queries` + 1 queries."""
        got = self._inbox.take(queries)
        routers = self._links.news()
        if routers is not None:
            got = replace(got, routers=routers)
        if not self._outlets.behind:
            return got
        dropped, stuck = self._outlets.losses(clock.mono_ns())
        return replace(got, dropped=dropped, stuck=stuck) if dropped or stuck else got

    def publish(self, key: str, message: Message) -> None:
        """Queue a message for its listeners. `flush` sends it."""
        self._outlets.publish(key, message)

    def flush(self) -> None:
        """Wake the thread that sends the queued messages. Never wait for it."""
        self._outlets.flush()

    def reply(self, reply: Reply) -> None:
        """Reply to the query that holds the ticket `reply.ticket`."""
        self._replies.send(reply)

    def retire(self, ticket: int) -> None:
        """End the query of this ticket: it gets no more replies."""
        self._replies.retire(ticket)

    # Opening the session.

    async def __aenter__(self) -> ZenohBus:
        # In client mode the daemon can do nothing without its router, so it waits for the router.
        patience_s = OPEN_TIMEOUT_S if self._settings.mode == "peer" else None
        self._session = await in_thread(self._open, patience_s)
        return self

    def _open(self) -> zenoh.Session:
        settings, limited = self._settings, command_keys(self._ros)
        session = daemon_session(settings, self._id, self._sources, limited, self._access)
        if settings.connect:
            taken = self._taken(_seen(session, self._alive, claims(self._ros)))
            if taken:
                session.close()
                raise InUseError(taken)
        # Set this before the first key is declared, because a sample may arrive at once.
        self._inbox.own_id = session.new_timestamp().get_id()
        self._replies.start(session)
        self._declare_native(session)
        zid = str(session.zid())
        for endpoint in endpoints(self._ros, zid, self._silent):
            self._declare_ros(session, endpoint)
        for token in (self._alive, *claims(self._ros), *node_tokens(self._ros, zid)):
            self._kept.append(session.liveliness().declare_token(token))
        self._outlets.start()
        self._links.start(session)
        return session

    def _taken(self, seen: set[str]) -> str:
        """Return the error if another daemon has this robot's id or ROS names, else ""."""
        if self._alive in seen:
            return (
                f"another daemon on this bus already has the id {self._id}; give this robot its "
                "own robot.id"
            )
        ways = [way for way in ("bridge", "rmw") if any(f"/@ros/{way}/" in one for one in seen)]
        if ways:
            off = " and ".join(f"ros.{way} = false" for way in ways)
            return (
                f'another robot on this bus already has ros.namespace = "{self._ros.namespace}": '
                f"one cmd_vel of ROS, by {' or '.join(ways)}, would drive both; give this robot "
                "its own namespace, in [ros] namespace or by `acsard run --namespace NAME`, or "
                f"{off}"
            )
        return ""

    def _declare_native(self, session: zenoh.Session) -> None:
        inbox = self._inbox
        for topic in self._topics:
            key = full_key(self._id, topic.pattern)
            if topic.direction == "in":
                self._kept.append(session.declare_subscriber(key, direct(inbox.on_sample)))
            elif topic.key not in ("alive", json_key("<key>")):
                on_query = direct(partial(inbox.on_query, topic.key))
                self._kept.append(session.declare_queryable(key, on_query))
        for topic in self._published:
            key, encoding = full_key(self._id, topic.key), encoding_name("msgpack", topic.type)
            signed = Signature(OWN).pack() if topic.key == IMU else b""
            self._outlets.declare(
                session, topic.key, key, "msgpack", encoding, topic.latched, signed=signed
            )
            self._declare_json(session, topic)

    def _declare_json(self, session: zenoh.Session, topic: Topic) -> None:
        """Publish the topic also as JSON, for clients without msgpack.

        Not latched: a latched publisher would encode every message even without subscribers. A
        query gets the present value instead.
        """
        below = json_key(topic.key)
        key, encoding = full_key(self._id, below), encoding_name("json", topic.type)
        self._outlets.declare(session, topic.key, key, "json", encoding)
        on_query = direct(partial(self._inbox.on_query, below))
        self._kept.append(session.declare_queryable(key, on_query))

    def _declare_ros(self, session: zenoh.Session, endpoint: Endpoint) -> None:
        key = endpoint.key
        match endpoint.direction:
            case "in":
                on_sample = direct(partial(self._inbox.on_ros_sample, endpoint))
                self._kept.append(session.declare_subscriber(key, on_sample))
            case "query" | "service":
                on_query = direct(partial(self._inbox.on_ros_query, endpoint))
                # Clients of rmw_zenoh query only complete queryables.
                self._kept.append(session.declare_queryable(key, on_query, complete=True))
            case "out":
                identity = gid(endpoint.token) if endpoint.transport == "rmw" else b""
                encoding = encoding_name("cdr")
                self._outlets.declare(
                    session, endpoint.native, key, "cdr", encoding, endpoint.latched, identity
                )
        if endpoint.token:
            self._kept.append(session.liveliness().declare_token(endpoint.token))

    # Closing the session.

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._replies.stop()
        try:
            await in_thread(self._close, CLOSE_TIMEOUT_S)
        except TimeoutError:
            pass  # a stuck remote; the process ends without closing the session

    def _close(self) -> None:
        self._outlets.stop(CLOSE_TIMEOUT_S)
        self._links.stop()
        self._session.close()


def _seen(session: zenoh.Session, alive: str, claims: tuple[str, ...]) -> set[str]:
    """Return the liveliness tokens that other sessions hold or declare within TWIN_PATIENCE_S."""
    liveliness = session.liveliness()
    others = {
        token: liveliness.declare_subscriber(token, history=True) for token in (alive, *claims)
    }
    deadline_ns = clock.now().mono_ns + int(TWIN_PATIENCE_S * NS_PER_S)
    found: set[str] = set()
    # A daemon with our id also has our ROS names. Wait for the id, which is the better message.
    while alive not in found and clock.now().mono_ns < deadline_ns:
        time.sleep(0.01)
        found |= {token for token, other in others.items() if other.try_recv() is not None}
    for other in others.values():
        other.undeclare()
    return found
