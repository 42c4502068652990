"""Opens and closes the connection to a robot."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import zenoh

from acsard.client.asynchronous import AsyncClient
from acsard.client.synchronous import Client
from acsard.daemon.bus.address import address_by_environment
from acsard.daemon.bus.zenoh_sessions import client_session
from acsard.host.threads import in_thread


@contextmanager
def connect(
    endpoint: str | None = None,
    *,
    robot_id: str | None = None,
    source: str = "app",
    tls: str | None = None,
) -> Iterator[Client]:
    """Connect to the daemon at `endpoint`, to command as `source` (see `[[commands.sources]]`).

    `tls` is the directory with your certificate, for an endpoint like "tls/robot.local:7449". An
    argument that is None comes from the file that the environment variable ACSARD_CONFIG names.
    Without such a file it is "tcp/127.0.0.1:7448", "acsar" or no certificate.
    """
    where = address_by_environment(endpoint, robot_id, tls)
    session = client_session(where.endpoint, where.tls)
    try:
        yield Client(session, where.robot_id, source, where.tls, where.endpoint)
    finally:
        _close(session)


@asynccontextmanager
async def connect_async(
    endpoint: str | None = None,
    *,
    robot_id: str | None = None,
    source: str = "app",
    tls: str | None = None,
) -> AsyncIterator[AsyncClient]:
    """Connect as `connect` does, for asyncio programs.

    Opening and closing do not block the event loop.
    """
    where = await in_thread(lambda: address_by_environment(endpoint, robot_id, tls), 5.0)
    session = await in_thread(lambda: client_session(where.endpoint, where.tls), 10.0, late=_close)
    try:
        yield AsyncClient(Client(session, where.robot_id, source, where.tls, where.endpoint))
    finally:
        await in_thread(lambda: _close(session), 5.0)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError:
        # The other side is stuck, and this client leaves in any case.
        pass
