"""Watches when the certificates of the bus end: the robot's own, its authority's and the router's.

A certificate on disk may be replaced while the daemon runs, and the router may get a new one. So
the ends are read again and again, by a thread, because a disk or a router may not answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, MutableMapping

from acsard.core.config.settings import TLS, BusConfig
from acsard.daemon.bus.tls import ends, peer_ends_ns
from acsard.host.threads import NoThreadError, in_thread

LOOK_S = 60.0
"""Pause between two looks at the files."""

ROUTER_LOOKS = 60
"""Number of looks at the files for each look at the routers, which costs them a connection.

A router that did not answer is looked at each time.
"""


def ends_of(routers: Iterable[str], directory: str) -> dict[str, int]:
    """Return the ends of the certificates of the routers that answer, as `expiry` takes them.

    `directory` has the certificate with which this machine connects to the routers.
    """
    found = {f"the router {one}": peer_ends_ns(one, directory) for one in routers}
    return {whose: ends_ns for whose, ends_ns in found.items() if ends_ns is not None}


async def watch_certificates(bus: BusConfig, known: MutableMapping[str, int]) -> None:
    """Keep the ends in `known` true, until cancelled. An end that cannot be read stays."""
    routers = [endpoint for endpoint in bus.connect if endpoint.startswith(TLS)]
    answered, look = 0, 0
    while True:
        found: dict[str, int] = {}
        try:
            # Without a time limit: each look at a disk that hangs would leave one more thread.
            if answered < len(routers) or look % ROUTER_LOOKS == 0:
                found |= await in_thread(lambda: ends_of(routers, bus.tls), None)
                answered = len(found)
            found |= await in_thread(lambda: ends(bus.tls), None)
        except NoThreadError:
            pass  # the next look tries again
        if bus.outside:
            # The TLS gateway reports the certificate that it uses.
            found.pop("", None)
        known.update(found)
        look += 1
        await asyncio.sleep(LOOK_S)
