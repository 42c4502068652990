"""The serial port for `acsard mcu check`, which a running daemon lends if it has the port open."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from acsard.bus.address import address_of
from acsard.bus.zenoh_sessions import answers
from acsard.client.connection import Connection, open_connection
from acsard.core.config.settings import Config
from acsard.core.messages.schema import ReplyData
from acsard.core.values import AcsardError
from acsard.daemon.serial.blocking import BlockingPort
from acsard.host import clock
from acsard.host.errors import InUseError
from acsard.host.processes import holder_of, is_daemon_here

CLOSE_TIMEOUT_S = 3.0  # for the daemon to close the port

NEUTRAL = "each sender must send a zero first"
OUTDATED = (
    "the robot stays switched off, because the daemon has the configuration of before: restart the "
    "daemon, then type `acsard call activate`"
)


class Loan:
    """The daemon closes its port until the end. `tell` shows a text to the operator."""

    def __init__(self, config: Config, tell: Callable[[str], None]) -> None:
        self._where, self._port, self._tell = address_of(config), config.mcu.port, tell
        self._data = ReplyData()  # what the daemon latched, and the number of the loan
        self.outdated = False  # the daemon's wheels: the file has others now

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        data, self._data = self._data, ReplyData()
        if data.loan is None:
            return
        numbers = [data.loan] if self.outdated else [*data.numbers, data.loan]
        try:
            with open_connection(self._where) as robot:
                # It ends the loan even if it is refused: it names no cause of a robot that was off
                # before, or whose wheels are outdated.
                reply = robot.call("activate", numbers=numbers)
        except AcsardError as error:
            self._tell(f"the daemon did not take the port back ({error}): `acsard call activate`")
        else:
            off = f"the robot stays switched off: {reply.message}"
            text = OUTDATED if self.outdated else NEUTRAL if reply.success else off
            self._tell(f"the daemon has the port again; {text}")

    def begin(self, in_use: InUseError) -> None:
        """Ask the daemon to lend the port. Raises `InUseError` if it does not."""
        with self._daemon(in_use) as robot:
            info = robot.get("info")
            ours = is_daemon_here(info.pid) and _device(info.port) == _device(self._port)
            holder = holder_of(self._port)  # None if it is hidden from this user
            if not ours or (holder is not None and holder.pid != info.pid):
                raise in_use
            reply = robot.call("deactivate", release_port=True)
        if not reply.success:
            raise InUseError(f"the daemon keeps {self._port}: {reply.message}")
        self._data = reply.data
        self._tell("the daemon has switched the robot off, and lends the port for this check")

    @contextmanager
    def _daemon(self, in_use: InUseError) -> Iterator[Connection]:
        if not answers(self._where.endpoint):
            raise in_use
        try:
            with open_connection(self._where) as robot:
                yield robot
        except InUseError:
            raise
        except AcsardError as error:
            raise InUseError(f"{in_use}; the daemon did not lend it: {error}") from None


class BorrowedPort(BlockingPort):
    """A port that the daemon lends if it has the port open."""

    def __init__(self, path: str, loan: Loan) -> None:
        super().__init__(path)
        self._loan = loan

    def open(self, baud_rate: int) -> None:
        try:
            super().open(baud_rate)
        except InUseError as error:
            self._loan.begin(error)
            self._open_soon(baud_rate)

    def _open_soon(self, baud_rate: int) -> None:
        end_s = clock.steady_s() + CLOSE_TIMEOUT_S
        while True:
            try:
                super().open(baud_rate)
            except InUseError:
                if clock.steady_s() > end_s:
                    raise
                time.sleep(0.05)
            else:
                return


def _device(path: str) -> str:
    return os.path.realpath(path)
