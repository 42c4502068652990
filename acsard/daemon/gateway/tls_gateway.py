"""The TLS gateway between clients on other machines and the daemon on loopback.

The gateway is a Zenoh router of its own that forwards only what the access rules allow. The worst
that a client can cause is a restart of the gateway (`supervision.py`), after which all clients
reconnect.
"""

from __future__ import annotations

import socket
import threading
from typing import Any

import zenoh
from zenoh.handlers import Callback

from acsard.core.config.settings import Config
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.schema import GatewayState
from acsard.core.messages.topics import full_key
from acsard.core.ros.transports import command_keys
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.access import gateway_access
from acsard.daemon.bus.tls import ends_ns, require_usable
from acsard.daemon.bus.zenoh_sessions import MAX_SESSIONS, gateway_session, reachable
from acsard.daemon.gateway.watch import GATEWAY_EVENTS, Look, Watch
from acsard.host import clock

CONNECT_S = 1.0

ASK_NS = NS_PER_S
"""Interval between two queries to the daemon, ns. A query that has not ended by then counts."""

LET_GO_S = 60.0
"""Time after which Zenoh itself ends a query, s; that is not an answer. It is long after the
unanswered queries have been counted, even if the gateway waits for a core between its looks.
"""


class Gateway:
    """The TLS gateway. It opens when the daemon runs, and reports its connections to the daemon."""

    most = MAX_SESSIONS - 1
    """Largest number of connections from the network; one more is the daemon's."""
    events = GATEWAY_EVENTS

    def __init__(self, config: Config) -> None:
        """Check the certificates.

        Raises `CertificateError` or `NotPermittedError` if they cannot be used.
        """
        self._config, self.where = config, ", ".join(config.bus.outside)
        require_usable(config.bus.tls)
        self._opened_ns = 0
        self._publisher: Any = None
        self._ends_ns = 0
        self._question = Question(full_key(config.robot.id, "info"))

    def ready(self) -> bool:
        """Return whether the daemon accepts connections. Clients are not admitted before."""
        host, _, port = reachable(self._config.bus.plain[0]).partition("/")[2].rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), CONNECT_S):
                return True
        except OSError:
            return False

    def open(self) -> zenoh.Session:
        """Open the session between the network and the daemon."""
        config = self._config
        sources = tuple(source.name for source in config.commands.sources)
        limited, access = command_keys(config.ros), gateway_access(config)
        session = gateway_session(config.bus, config.robot.id, sources, limited, access)
        self._opened_ns = clock.mono_ns()
        return session

    def look(self, session: zenoh.Session) -> Look:
        """Return the connections from the network, and whether the daemon is connected."""
        links = session.info.links()
        near = [link for link in links if str(link.dst).startswith("tcp/")]
        holders = tuple(link.auth_identifier or "" for link in links if link not in near)
        unanswered = self._question.unanswered(session, clock.mono_ns()) if near else 0
        return Look(clock.mono_ns(), holders, bool(near), unanswered)

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """Report to the daemon, which shows it in `state`."""
        if self._publisher is None:
            self._ends_ns = ends_ns(self._config.bus.tls) or 0
            key, kind = full_key(self._config.robot.id, "gateway"), "GatewayState"
            encoding = encoding_name("msgpack", kind)
            self._publisher = session.declare_publisher(key, encoding=encoding)
        said = GatewayState(self._opened_ns, len(look.holders), watch.full, self._ends_ns)
        self._publisher.put(encode(said, "msgpack"))


class Question:
    """Repeated query to the daemon, because an open connection does not prove that data arrives.

    On a machine with forty times the work that it can do, two gateways ended within half a minute.
    The connection of the third stayed open for minutes, while the daemon's Zenoh did not read from
    it.
    """

    def __init__(self, key: str) -> None:
        self._key, self._asked_ns, self._unanswered = key, 0, 0
        self._ended = threading.Event()
        """Set when the query has ended. An end without a reply also counts as an answer, because
        the daemon has received the query.
        """

    def unanswered(self, session: zenoh.Session, now_ns: int) -> int:
        """Return the number of consecutive queries that have not ended yet."""
        if now_ns - self._asked_ns < ASK_NS:
            return self._unanswered
        if self._asked_ns:
            self._unanswered = 0 if self._ended.is_set() else self._unanswered + 1
        self._asked_ns = now_ns
        self._ended.clear()
        handler: Any = Callback(lambda reply: None, self._ended.set, indirect=False)
        session.get(self._key, handler=handler, timeout=LET_GO_S)
        return self._unanswered
