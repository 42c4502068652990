"""The TLS gateway between clients on other machines and the daemon on loopback.

It is a Zenoh router in its own process that forwards what the access rules allow. The worst that a
client can do is a restart (`gateway_process.py`), after which all clients reconnect.
"""

from __future__ import annotations

import threading
from typing import Any

import zenoh
from zenoh.handlers import Callback

from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.tls_files import expiry_times, files_in, require_usable
from acsard.bus.zenoh_sessions import MAX_SESSIONS, answers, gateway_session
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import GatewayState
from acsard.core.values import NS_PER_S, Ns
from acsard.daemon.gateway.session_health import Observation, SessionHealth
from acsard.host import clock

PROBE_TIMEOUT_NS = NS_PER_S  # between queries; one that has not ended by then is unanswered

QUERY_TIMEOUT_S = 60.0  # Zenoh's own, much longer than `PROBE_TIMEOUT_NS`


class Gateway:
    """The session of the TLS gateway, which admits clients only while the daemon runs."""

    most = MAX_SESSIONS - 1  # from the network; one more is the daemon's

    def __init__(self, config: Config) -> None:
        # Raises `CertificateError` or `NotPermittedError`.
        self._config, self.where = config, ", ".join(config.bus.outside)
        require_usable(config.bus.tls)
        self.files = CertificateFiles(*files_in(config.bus.tls))
        self._opened_ns = 0
        self._publisher: Any = None
        self._ends_ns = 0
        self._probe = DaemonProbe(full_key(config.robot.id, "info"))

    def ready(self) -> bool:
        """Return whether the daemon accepts connections, so that the gateway may be opened."""
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
        """Publish the gateway's part of `state`: connections, opening, expiry, fullness."""
        if self._publisher is None:
            self._ends_ns = min(expiry_times(self._config.bus.tls).values(), default=0)
            key, kind = full_key(self._config.robot.id, "gateway"), "GatewayState"
            encoding = encoding_name("msgpack", kind)
            self._publisher = session.declare_publisher(key, encoding=encoding)
        state = GatewayState(self._opened_ns, len(observed.holders), health.full, self._ends_ns)
        self._publisher.put(encode(state, "msgpack"))


class DaemonProbe:
    """Queries the daemon repeatedly to detect a connection that is open but carries no data.

    On an overloaded machine, one stayed open for minutes without the daemon's Zenoh reading it.
    """

    def __init__(self, key: str) -> None:
        # The daemon must answer queries of the full key `key`.
        self._key, self._asked_ns, self._unanswered = key, 0, 0
        # Set when a query ends, even without a reply, and cleared before the next. Within
        # `PROBE_TIMEOUT_NS` it has reached the daemon; a later end counts for the next query.
        self._ended = threading.Event()

    def unanswered(self, session: zenoh.Session, now_ns: Ns) -> int:
        """Send the next query if it is due, and return the failed ones in a row."""
        if now_ns - self._asked_ns < PROBE_TIMEOUT_NS:
            return self._unanswered
        if self._asked_ns:
            self._unanswered = 0 if self._ended.is_set() else self._unanswered + 1
        self._asked_ns = now_ns
        self._ended.clear()
        handler: Any = Callback(lambda reply: None, self._ended.set, indirect=False)
        session.get(self._key, handler=handler, timeout=QUERY_TIMEOUT_S)
        return self._unanswered
