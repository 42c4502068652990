"""The door: clients from other machines by TLS on one side, the daemon on loopback on the other.

A Zenoh router of its own, which lets through what the access rules allow. Whatever somebody makes
Zenoh do (compare key expressions for ever, keep 256 connections, take memory) happens here and not
in the process that drives: the worst is that the door is opened anew, and all come in again.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import socket
import threading

import zenoh

from acsard.bus.access import door_access
from acsard.bus.certificates import check, ends_ns
from acsard.bus.session import MAX_SESSIONS, door_session
from acsard.config.settings import Config
from acsard.door.watch import Look, Watch
from acsard.host import clock
from acsard.host.logs import Log
from acsard.host.systemd import Systemd
from acsard.messages.encodings import encode, encoding_name
from acsard.messages.schema import DoorState
from acsard.messages.topics import full_key
from acsard.ros.transports import command_keys
from acsard.values import Event

LOOK_S = 0.25

MEMORY_BYTES = 192 << 20
"""What it may keep: it takes 35 MB, and 72 with all connections in use. An attack takes 600 MB a
second, which no look could be quick enough for: the kernel refuses, and that ends the process."""

NICE = 5
"""Behind the daemon and what people run beside it."""

CONNECT_S = 1.0


class Door:
    """Opens when the daemon is there, and stays open until one of the reasons in `watch.py`."""

    def __init__(self, config: Config, log: Log, manager: Systemd, holder: int | None) -> None:
        """It ends when the file descriptor `holder` does, if there is one."""
        self._config, self._log, self._manager, self._holder = config, log, manager, holder
        self._plain = config.bus.plain[0]
        self._opened_ns = 0
        self._look = Look(0)
        self._leaving = False

    def run(self) -> bool:
        """Until a signal or the holder's end (True), or until it has to be opened anew (False)."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._leave)
        check(self._config.bus.tls)
        _confine()
        while not self._reachable():
            if self._wait():
                return True
        session = self._open()
        self._manager.ready()
        self._log.info("door_open", text=f"listens at {', '.join(self._config.bus.outside)}")
        watch = Watch(MAX_SESSIONS - 1, self._opened_ns)
        threading.Thread(target=self._watch, args=(session, watch), daemon=True).start()
        while not self._wait():
            over = watch.over(self._look, clock.mono_ns())
            if over is not None:
                self._log.event(over)
                return False
            self._manager.alive()
        return True

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        """A moment; whether it is time to go."""
        held = [] if self._holder is None else [self._holder]
        ended, _, _ = select.select(held, [], [], LOOK_S)
        return self._leaving or bool(ended and not os.read(held[0], 64))

    def _reachable(self) -> bool:
        """The daemon listens: nobody is let in before there is one."""
        host, _, port = self._plain.partition("/")[2].rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), CONNECT_S):
                return True
        except OSError:
            return False

    def _open(self) -> zenoh.Session:
        config = self._config
        sources = tuple(source.name for source in config.commands.sources)
        limited, access = command_keys(config.ros), door_access(config)
        session = door_session(config.bus, config.robot.id, sources, limited, access)
        self._opened_ns = clock.mono_ns()
        self._look = Look(self._opened_ns, linked=True)
        return session

    # what may get stuck

    def _watch(self, session: zenoh.Session, watch: Watch) -> None:
        ends = ends_ns(self._config.bus.tls) or 0
        key = full_key(self._config.robot.id, "door")
        publisher = session.declare_publisher(key, encoding=encoding_name("msgpack", "DoorState"))
        pause = threading.Event()
        while True:
            look = self._look = self._looked(session)
            event: Event | None = watch.judge(look)
            if event is not None:
                self._log.event(event)
            said = DoorState(self._opened_ns, len(look.holders), watch.crowded, ends)
            publisher.put(encode(said, "msgpack"))
            pause.wait(LOOK_S)

    def _looked(self, session: zenoh.Session) -> Look:
        links = session.info.links()
        near = [link for link in links if str(link.dst).startswith("tcp/")]
        holders = tuple(link.auth_identifier or "" for link in links if link not in near)
        return Look(clock.mono_ns(), holders, bool(near))


def _confine() -> None:
    """Take no more than a door's share."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["RUST_BACKTRACE"] = "0"  # an end for want of memory is none of the log's business
    os.nice(NICE)
