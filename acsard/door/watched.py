"""A Zenoh session that strangers come to, in a process that may be lost: watched, ended when stuck.

Whatever somebody makes Zenoh do (compare key expressions for ever, keep all connections, take
memory) happens here. No call to Zenoh can be trusted to come back then, so one thread looks at the
session, and the main thread judges whether it still does.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import threading
from typing import Protocol

import zenoh

from acsard.door.watch import Look, Watch
from acsard.host import clock
from acsard.host.exits import Exit
from acsard.host.logs import Log
from acsard.host.parent import end_with_parent
from acsard.host.systemd import Systemd

LOOK_S = 0.25

MEMORY_BYTES = 192 << 20
"""What it may keep: it takes 35 MB, and 72 with all connections in use. An attack takes 600 MB a
second, which no look could be quick enough for: the kernel refuses, and that ends the process."""

NICE = 5
"""Behind the daemon and what people run beside it."""


class Side(Protocol):
    """What is opened, and who is expected there."""

    where: str
    """Its addresses, in words."""
    most: int
    """Connections from outside, all there are."""

    def ready(self) -> bool:
        """Whether it is time to let anybody in."""

    def open(self) -> zenoh.Session:
        """Listen; blocks."""

    def look(self, session: zenoh.Session) -> Look:
        """Who is connected; may never come back."""

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """Pass on what was seen, to whom it concerns; may never come back."""


class Watched:
    """One life of the process."""

    def __init__(self, side: Side, log: Log, manager: Systemd, holder: int | None) -> None:
        """It ends when the file descriptor `holder` does, if there is one."""
        self._side, self._log, self._manager, self._holder = side, log, manager, holder
        self._session: zenoh.Session | None = None
        """Kept to the end of the process: to close it could take for ever."""
        self._look = Look(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """OK after a signal or the holder's end, FAILURE when it has to be opened anew."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._leave)
        if self._holder is not None:
            end_with_parent(signal.SIGKILL)
        _confine()
        self._manager.ready()
        while not self._side.ready():
            self._manager.status("waits for the daemon")
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

    def _open(self) -> Watch:
        side = self._side
        session = self._session = side.open()
        opened_ns = clock.mono_ns()
        self._look, watch = Look(opened_ns), Watch(side.most, opened_ns)
        threading.Thread(target=self._report, args=(session, watch), daemon=True).start()
        self._log.info("door_open", text=f"listens at {side.where}")
        self._manager.status(f"open at {side.where}")
        return watch

    def _report(self, session: zenoh.Session, watch: Watch) -> None:
        """Look, tell the log and whom it concerns, again and again."""
        try:
            pause = threading.Event()
            while True:
                look = self._look = self._side.look(session)
                event = watch.tell(look)
                if event is not None:
                    self._log.event(event)
                self._side.tell(session, look, watch)
                pause.wait(LOOK_S)
        except BaseException as error:  # noqa: BLE001 - raised by `run`, which ends the process
            self._error = error


def _confine() -> None:
    """Take no more than a door's share, as far as we may say so."""
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(NICE)
    os.environ["RUST_BACKTRACE"] = "0"  # an end for want of memory is none of the log's business
