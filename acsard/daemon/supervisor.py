"""Supervises the TLS gateway, a fleet's router or the web page, each a process of its own.

The process sends a sign of life all the time. The supervisor ends a process that is silent, because
it was stopped or hangs, and starts it again. If the gateway is a service, systemd does this for its
own unit (`acsard-gateway.service`), with limits that only systemd can set.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from msgspec import Struct

from acsard.core.values import Event, EventName
from acsard.host.child import Child, acsard, how_it_ended
from acsard.host.errors import Exit
from acsard.host.threads import in_thread

AGAIN_S = 0.1
"""Seconds before a process that ended is started again."""

LATER_S = 2.0
"""Seconds before a process that could not start is started again."""


class Kind(Struct, frozen=True):
    """A kind of supervised process."""

    name: str
    ended: EventName
    final: frozenset[int] = frozenset()
    """Exit codes after which it is not started again."""
    again_s: float = AGAIN_S
    """Seconds before it is started again."""
    final_at_first: frozenset[int] = frozenset()
    """Exit codes that are final for the first process only. A later one may have met files that a
    person was changing."""


GATEWAY = Kind("the TLS gateway", "gateway_ended")
"""The gateway is always started again: the robot drives on, and an operator may fix its files
meanwhile."""

ROUTER = Kind(
    "the router",
    "router_ended",
    final_at_first=frozenset({Exit.USAGE, Exit.BAD_CONFIG}),
)
"""A fleet must not lose its router because its files were incomplete when it opened again."""

PAGE = Kind(
    "the robot's page",
    "page_ended",
    frozenset({Exit.OK, Exit.USAGE, Exit.IN_USE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}),
    LATER_S,
)
"""A page that keeps failing must take no time from the robot. It reports itself why it ends."""


async def keep_running(
    words: Sequence[str], log: Callable[[Event], None], kind: Kind = GATEWAY
) -> int:
    """Run `acsard` with these arguments ("gateway", ...), again whenever it ends, until cancelled.

    Return an exit code after which it must not be started again.
    """
    final = kind.final | kind.final_at_first
    while True:
        child = Child(acsard(*words, "--supervised"))
        try:
            code = await in_thread(child.run, None)
            why = child.silent or how_it_ended(code)
        except (OSError, RuntimeError) as error:  # no room for a process or a thread
            code, why = Exit.USAGE, f"could not be started ({error})"
        else:
            if code in final:
                return code
            final = kind.final
        finally:
            child.release()
        log(Event(kind.ended, f"{kind.name} {why}; it is restarted", "warning"))
        await asyncio.sleep(kind.again_s if code <= Exit.FAILURE else LATER_S)
