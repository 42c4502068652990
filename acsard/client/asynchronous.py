"""The client for asyncio programs.

Calls that wait for a reply run in threads. Commands are sent in the event loop, which one blocks
for up to 3 ms (`MIN_SPACING_S`) directly after another.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, closing, suppress
from functools import partial
from typing import TypeVar

from acsard.bus.address import address_by_environment
from acsard.bus.zenoh_sessions import client_session
from acsard.client.connection import (
    REPLY_TIMEOUT_S,
    Connection,
    accepted,
    close,
    end_at_exit,
)
from acsard.client.driving import Driver, Steps, UnheardError, drive, move, turn
from acsard.client.identity import ClientIdentity
from acsard.client.reads import AsyncReads
from acsard.core.messages import schema
from acsard.core.values import AcsardError, Plain, Pose
from acsard.host.errors import NoAnswerError
from acsard.host.threads import in_thread

T = TypeVar("T")

# The longest call is a `clear`, up to 15 s: it queries the state, for 3 s while the daemon is busy,
# calls the service, and finds out why no reply came.
CALL_TIMEOUT_S = 6 * REPLY_TIMEOUT_S

CLOSE_TIMEOUT_S = 5.0  # for a connection


@asynccontextmanager
async def connect_async(
    endpoint: str | None = None,
    *,
    robot_id: str | None = None,
    source: str = "app",
    tls: str | None = None,
) -> AsyncIterator[AsyncClient]:
    """Connect to a daemon without blocking the event loop, and yield an `AsyncClient`.

    The arguments are those of `connect`.
    """
    where = await _in_thread(lambda: address_by_environment(endpoint, robot_id, tls), 5.0)
    session = await _in_thread(lambda: client_session(where.endpoint, where.tls), 10.0, late=close)
    robot = Connection(session, where.robot_id, source, where.tls, where.endpoint)
    end_at_exit(robot)
    try:
        yield AsyncClient(robot)
    except BaseException:
        # A timeout must not replace the error of the caller's block.
        with suppress(TimeoutError):
            await in_thread(robot.end, CLOSE_TIMEOUT_S)
        raise
    try:
        await in_thread(robot.end, CLOSE_TIMEOUT_S)
    except TimeoutError:
        raise NoAnswerError(
            f"the connection could not be closed within {CLOSE_TIMEOUT_S:g} s, so the final zeros "
            "may be lost: the robot stops after the timeout of its source"
        ) from None


async def _in_thread(
    call: Callable[[], T], timeout_s: float | None = None, late: Callable[[T], None] | None = None
) -> T:
    # Raises `NoAnswerError` after `timeout_s` (None: `CALL_TIMEOUT_S`), or if no thread can be
    # started.
    timeout_s = CALL_TIMEOUT_S if timeout_s is None else timeout_s
    try:
        return await in_thread(call, timeout_s, late)
    except AcsardError:
        # `NoAnswerError` is also a `TimeoutError`.
        raise
    except TimeoutError as error:
        raise NoAnswerError(
            str(error)
            or f"this call did not end within {timeout_s:g} s: the daemon or the network is stuck; "
            "try again, or run `acsard doctor` on the robot"
        ) from None


class AsyncClient(AsyncReads):
    """A client for asyncio, with the methods of `Client`. Create it with `connect_async`."""

    def __init__(self, connection: Connection) -> None:
        self._reads = self._connection = connection

    @property
    def name(self) -> str:
        """The name of this program in the robot's log of service calls. You may change it."""
        return self._connection.name

    @name.setter
    def name(self, name: str) -> None:
        self._connection.name = name

    def _call(self, function: Callable[[], T]) -> Awaitable[T]:
        return _in_thread(function)

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command: `linear` m/s, `angular` rad/s (left is +). Repeat it to keep moving."""
        self._connection.send(linear, angular)

    async def drive(self, linear: float, angular: float = 0.0, *, seconds: float) -> None:
        """Drive for `seconds`, as `Client.drive` does. If the task is cancelled, send zeros."""
        await self._run(drive(linear, angular, seconds))

    async def move(self, distance: float, *, speed: float = 0.3) -> None:
        """Drive `distance` m straight ahead (back if negative), as `Client.move` does."""
        await self._run(move(distance, speed))

    async def turn(self, degrees: float, *, speed: float = 0.8) -> None:
        """Turn on the spot by an angle (left is +), as `Client.turn` does."""
        await self._run(turn(degrees, speed))

    async def _run(self, steps: Steps) -> None:
        driver = Driver(self._connection)
        try:
            with closing(steps(driver)) as pauses:
                for pause_s in pauses:
                    await asyncio.sleep(pause_s)
        except BaseException as error:
            for pause_s in driver.zeros():
                await asyncio.sleep(pause_s)
            if isinstance(error, UnheardError | NoAnswerError):
                raise await _in_thread(partial(self._connection.explain_error, error)) from None
            raise
        finally:
            driver.end()

    async def stop(self) -> schema.ServiceReply:
        """Stop the robot, and return its reply. It stays stopped until `clear`."""
        return await self.call("stop")

    async def clear(self) -> schema.ServiceReply:
        """Release the faults and stops that are older than this call, and return the reply."""
        return await self.call("clear")

    async def call(self, service: str, **fields: object) -> schema.ServiceReply:
        """Call a service and return its reply, as `Client.call` does."""
        return accepted(await _in_thread(lambda: self._connection.call(service, **fields)))

    async def set(self, settings: Mapping[str, Plain]) -> schema.ServiceReply:
        """Change settings of the daemon and return the reply, as `Client.set` does."""
        return accepted(await _in_thread(lambda: self._connection.set(settings)))

    async def whoami(self) -> ClientIdentity:
        """Return this client's role and name at the robot, as `Client.whoami` does."""
        return await _in_thread(self._connection.whoami)

    async def pose(self) -> Pose:
        """Return the present pose of the robot in the odom frame, m and rad."""
        return await _in_thread(self._connection.pose)
