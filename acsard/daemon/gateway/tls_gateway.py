"""The TLS gateway between clients on other machines and the daemon on loopback.

The gateway is a Zenoh router in a separate process. It forwards only the messages that the access
rules allow. The worst effect that a client can have is a restart of the gateway
(`gateway_process.py`), after which all clients reconnect.
"""

from __future__ import annotations

import threading
from typing import Any

import zenoh
from zenoh.handlers import Callback

from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.tls import expiry_times, files_in, require_usable
from acsard.bus.zenoh_sessions import MAX_SESSIONS, answers, gateway_session
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import GatewayState
from acsard.core.values import NS_PER_S
from acsard.daemon.gateway.session_health import Observation, SessionHealth
from acsard.host import clock

PROBE_TIMEOUT_NS = NS_PER_S
"""Time between two queries to the daemon, ns. A query that has not ended when the next query is due
counts as unanswered."""

QUERY_TIMEOUT_S = 60.0
"""Time after which Zenoh itself ends a query to the daemon, s. It is much longer than
`PROBE_TIMEOUT_NS`, after which the query counts as unanswered."""


class Gateway:
    """The session of the TLS gateway.

    The gateway admits clients only after the daemon has started. It tells the daemon how many
    clients are connected.
    """

    most = MAX_SESSIONS - 1
    """Largest number of connections from the network. One more connection is for the daemon."""

    def __init__(self, config: Config) -> None:
        """Check the certificate files.

        Raises `CertificateError` or `NotPermittedError` if they cannot be used.
        """
        self._config, self.where = config, ", ".join(config.bus.outside)
        require_usable(config.bus.tls)
        self.files = CertificateFiles(*files_in(config.bus.tls))
        self._opened_ns = 0
        self._publisher: Any = None
        self._ends_ns = 0
        self._probe = DaemonProbe(full_key(config.robot.id, "info"))

    def ready(self) -> bool:
        """Return whether the daemon accepts connections. The gateway is opened only then."""
        return answers(self._config.bus.plain[0])

    def open(self) -> zenoh.Session:
        session = gateway_session(self._config)
        self._opened_ns = clock.mono_ns()
        return session

    def observe(self, session: zenoh.Session) -> Observation:
        """Return the connections from the network, and whether the daemon is connected."""
        links = session.info.links()
        # Only the link to the daemon has no TLS.
        local = [link for link in links if str(link.dst).startswith("tcp/")]
        holders = tuple(link.auth_identifier or "" for link in links if link not in local)
        unanswered = self._probe.unanswered(session, clock.mono_ns()) if local else 0
        return Observation(clock.mono_ns(), holders, bool(local), unanswered)

    def report(self, session: zenoh.Session, observed: Observation, health: SessionHealth) -> None:
        """Publish the state of the gateway, which the daemon includes in the message `state`.

        This state contains the number of connections, the opening time of the gateway, and the
        earliest expiry time of its certificates. It also contains the number of observations in
        which all connections were in use.
        """
        if self._publisher is None:
            self._ends_ns = min(expiry_times(self._config.bus.tls).values(), default=0)
            key, kind = full_key(self._config.robot.id, "gateway"), "GatewayState"
            encoding = encoding_name("msgpack", kind)
            self._publisher = session.declare_publisher(key, encoding=encoding)
        state = GatewayState(self._opened_ns, len(observed.holders), health.full, self._ends_ns)
        self._publisher.put(encode(state, "msgpack"))


class DaemonProbe:
    """Queries the daemon repeatedly to detect a connection that is open but carries no data.

    In a test on an overloaded machine, a connection stayed open for minutes, but the daemon's Zenoh
    did not read from the connection.
    """

    def __init__(self, key: str) -> None:
        """Prepare the probe. `key` is the full key of the queries, which the daemon must answer."""
        self._key, self._asked_ns, self._unanswered = key, 0, 0
        self._ended = threading.Event()
        """Set whenever a query ends, with or without a reply, and cleared before the next query is
        sent. A query that ends within `PROBE_TIMEOUT_NS` has reached the daemon. A query that ends
        later also sets the event, so that the query after it counts as answered."""

    def unanswered(self, session: zenoh.Session, now_ns: int) -> int:
        """Send the next query if it is due, and return the number of consecutive failed queries.

        A query fails if it does not end within `PROBE_TIMEOUT_NS`. `now_ns` is the present
        monotonic time, ns.
        """
        if now_ns - self._asked_ns < PROBE_TIMEOUT_NS:
            return self._unanswered
        if self._asked_ns:
            self._unanswered = 0 if self._ended.is_set() else self._unanswered + 1
        self._asked_ns = now_ns
        self._ended.clear()
        handler: Any = Callback(lambda reply: None, self._ended.set, indirect=False)
        session.get(self._key, handler=handler, timeout=QUERY_TIMEOUT_S)
        return self._unanswered
