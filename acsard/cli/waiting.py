"""Says why a tool waits: one that is silent looks like a robot that is dead."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING

from acsard.messages.text import printable

if TYPE_CHECKING:
    from acsard.bus.address import Address
    from acsard.client import Client

QUIET_S = 2.0
"""Of silence before it is told: whatever is published comes sooner, or tells that it is late."""


@contextmanager
def explained(look: Callable[[], str], after_s: float = QUIET_S) -> Iterator[Callable[[], None]]:
    """Yields what is to be called when something has come: after so long without, what `look` finds
    is told in one line on standard error. It looks in a thread of its own: nobody waits for it."""
    come = Event()

    def tell() -> None:
        if come.wait(after_s):
            return
        told = look()
        if told and not come.is_set():
            print(f"acsard: {printable(told)}", file=sys.stderr, flush=True)

    Thread(target=tell, name="waiting", daemon=True).start()
    try:
        yield come.set
    finally:
        come.set()


def waits_for(robot: Client, key: str, where: Address) -> Callable[[], str]:
    """What there is to say of a key on which nothing has come."""

    def look() -> str:
        from acsard.bus.fleet import around
        from acsard.bus.quiet import why

        seen = around(robot.session, where.robot_id, where.endpoint)
        if seen is None:
            return ""
        reason = why(key, where.robot_id, where.endpoint, seen)
        return f"waiting for {robot.key(key)}: {reason}"

    return look
