"""The door: clients from other machines by TLS on one side, the daemon on loopback on the other.

A Zenoh router of its own, which lets through what the access rules allow. Whatever somebody makes
Zenoh do (compare key expressions for ever, keep all connections, take memory) happens here and not
in the process that drives: the worst is that the door is opened anew, and all come in again.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import socket
import threading

import zenoh

from acsard.bus.access import door_access
from acsard.bus.certificates import ends_ns, require_usable
from acsard.bus.session import MAX_SESSIONS, door_session, reachable
from acsard.config.settings import Config
from acsard.door.watch import Look, Watch
from acsard.host import clock
from acsard.host.exits import Exit
from acsard.host.logs import Log
from acsard.host.parent import end_with_parent
from acsard.host.systemd import Systemd
from acsard.messages.encodings import encode, encoding_name
from acsard.messages.schema import DoorState
from acsard.messages.topics import full_key
from acsard.ros.transports import command_keys

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
        self._session: zenoh.Session | None = None
        """Kept to the end of the process: to close it could take for ever."""
        self._opened_ns = 0
        self._look = Look(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """OK after a signal or the holder's end, FAILURE when it has to be opened anew."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._leave)
        if self._holder is not None:
            end_with_parent(signal.SIGKILL)
        require_usable(self._config.bus.tls)
        _confine()
        self._manager.ready()
        self._manager.status("waits for the daemon")
        while not self._daemon_listens():
            if self._wait():
                return Exit.OK
        watch = self._open()
        before_ns = clock.mono_ns()
        while not self._wait():
            if self._error is not None:
                raise self._error
            now_ns = clock.mono_ns()
            why = watch.reopen(self._look, now_ns - before_ns)
            if why is not None:
                self._log.event(why)
                return Exit.FAILURE
            before_ns = now_ns
        return Exit.OK

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        """A moment; whether it is time to go."""
        self._manager.alive()
        held = [] if self._holder is None else [self._holder]
        ended, _, _ = select.select(held, [], [], LOOK_S)
        return self._leaving or bool(ended and not os.read(held[0], 64))

    def _daemon_listens(self) -> bool:
        """Nobody is let in before there is one."""
        host, _, port = reachable(self._config.bus.plain[0]).partition("/")[2].rpartition(":")
        try:
            with socket.create_connection((host.strip("[]"), int(port)), CONNECT_S):
                return True
        except OSError:
            return False

    def _open(self) -> Watch:
        config = self._config
        sources = tuple(source.name for source in config.commands.sources)
        limited, access = command_keys(config.ros), door_access(config)
        session = door_session(config.bus, config.robot.id, sources, limited, access)
        self._session, self._opened_ns = session, clock.mono_ns()
        self._look = Look(self._opened_ns)
        watch, where = Watch(MAX_SESSIONS - 1, self._opened_ns), ", ".join(config.bus.outside)
        threading.Thread(target=self._report, args=(session, watch), daemon=True).start()
        self._log.info("door_open", text=f"listens at {where}")
        self._manager.status(f"open at {where}")
        return watch

    # what may get stuck

    def _report(self, session: zenoh.Session, watch: Watch) -> None:
        """Look, tell the log and the daemon, again and again."""
        try:
            ends = ends_ns(self._config.bus.tls) or 0
            key, kind = full_key(self._config.robot.id, "door"), "DoorState"
            publisher = session.declare_publisher(key, encoding=encoding_name("msgpack", kind))
            pause = threading.Event()
            while True:
                look = self._look = _look(session)
                event = watch.tell(look)
                if event is not None:
                    self._log.event(event)
                said = DoorState(self._opened_ns, len(look.holders), watch.crowded, ends)
                publisher.put(encode(said, "msgpack"))
                pause.wait(LOOK_S)
        except BaseException as error:  # noqa: BLE001 - raised by `run`, which ends the process
            self._error = error


def _look(session: zenoh.Session) -> Look:
    links = session.info.links()
    near = [link for link in links if str(link.dst).startswith("tcp/")]
    holders = tuple(link.auth_identifier or "" for link in links if link not in near)
    return Look(clock.mono_ns(), holders, bool(near))


def _confine() -> None:
    """Take no more than a door's share, as far as we may say so."""
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(NICE)
    os.environ["RUST_BACKTRACE"] = "0"  # an end for want of memory is none of the log's business
