"""The door: clients from other machines by TLS on one side, the daemon on loopback on the other.

A Zenoh router of its own, which lets through what the access rules allow. The worst that somebody
can do is that the door is opened anew (`watched.py`), and all come in again.
"""

from __future__ import annotations

import socket
import threading
from typing import Any

import zenoh
from zenoh.handlers import Callback

from acsard.bus.access import door_access
from acsard.bus.certificates import ends_ns, require_usable
from acsard.bus.session import MAX_SESSIONS, door_session, reachable
from acsard.config.settings import Config
from acsard.door.watch import DOOR_EVENTS, Look, Watch
from acsard.host import clock
from acsard.messages.encodings import encode, encoding_name
from acsard.messages.schema import DoorState
from acsard.messages.topics import full_key
from acsard.ros.transports import command_keys
from acsard.values import NS_PER_S

CONNECT_S = 1.0

ASK_NS = NS_PER_S
"""How often the daemon is asked, and how long it may take."""

LET_GO_S = 60.0
"""When Zenoh itself ends a question, which is no answer: long after enough of them were counted,
also by a door that is kept waiting for a core between its looks."""


class Door:
    """Opens when the daemon is there, and tells it who has come."""

    most = MAX_SESSIONS - 1
    """One is the daemon's."""
    events = DOOR_EVENTS

    def __init__(self, config: Config) -> None:
        """Raises `CertificateError` or `NotPermittedError` for certificates it cannot use."""
        self._config, self.where = config, ", ".join(config.bus.outside)
        require_usable(config.bus.tls)
        self._opened_ns = 0
        self._publisher: Any = None
        self._ends_ns = 0
        self._question = Question(full_key(config.robot.id, "info"))

    def ready(self) -> bool:
        """Nobody is let in before there is a daemon."""
        host, _, port = reachable(self._config.bus.plain[0]).partition("/")[2].rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), CONNECT_S):
                return True
        except OSError:
            return False

    def open(self) -> zenoh.Session:
        """Between the network and the daemon."""
        config = self._config
        sources = tuple(source.name for source in config.commands.sources)
        limited, access = command_keys(config.ros), door_access(config)
        session = door_session(config.bus, config.robot.id, sources, limited, access)
        self._opened_ns = clock.mono_ns()
        return session

    def look(self, session: zenoh.Session) -> Look:
        """Who is connected from outside, and whether the daemon is."""
        links = session.info.links()
        near = [link for link in links if str(link.dst).startswith("tcp/")]
        holders = tuple(link.auth_identifier or "" for link in links if link not in near)
        unanswered = self._question.unanswered(session, clock.mono_ns()) if near else 0
        return Look(clock.mono_ns(), holders, bool(near), unanswered)

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """The daemon counts it in `state`."""
        if self._publisher is None:
            self._ends_ns = ends_ns(self._config.bus.tls) or 0
            key, kind = full_key(self._config.robot.id, "door"), "DoorState"
            encoding = encoding_name("msgpack", kind)
            self._publisher = session.declare_publisher(key, encoding=encoding)
        said = DoorState(self._opened_ns, len(look.holders), watch.crowded, self._ends_ns)
        self._publisher.put(encode(said, "msgpack"))


class Question:
    """Asked through the connection to the daemon again and again: that it stands is not enough.

    After two doors had died within half a minute on a machine with forty times its work, the third
    one's connection stood for minutes without the daemon's Zenoh reading from it.
    """

    def __init__(self, key: str) -> None:
        self._key, self._asked_ns, self._unanswered = key, 0, 0
        self._ended = threading.Event()
        """That Zenoh lets go of a question is an answer, too: the daemon has had it."""

    def unanswered(self, session: zenoh.Session, now_ns: int) -> int:
        """So many in a row have had no end yet."""
        if now_ns - self._asked_ns < ASK_NS:
            return self._unanswered
        if self._asked_ns:
            self._unanswered = 0 if self._ended.is_set() else self._unanswered + 1
        self._asked_ns = now_ns
        self._ended.clear()
        handler: Any = Callback(lambda reply: None, self._ended.set, indirect=False)
        session.get(self._key, handler=handler, timeout=LET_GO_S)
        return self._unanswered
