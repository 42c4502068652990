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


def nothing() -> str:
    """There is nothing to say."""
    return ""


@contextmanager
def explained(
    look: Callable[[], str], after_s: float = QUIET_S, ceased: Callable[[], str] | None = None
) -> Iterator[Callable[[], None]]:
    """Yields what is to be called when something has come: after so long without, what `look` finds
    is told in one line on standard error; later, once for each silence as long, what `ceased`
    finds. It looks in a thread of its own: nobody waits for it."""
    come, end = Event(), Event()

    def say(found: str) -> bool:
        if found and not come.is_set():
            print(f"acsard: {printable(found)}", file=sys.stderr, flush=True)
        return bool(found)

    def tell() -> None:
        told = not come.wait(after_s) and say(look())
        while ceased is not None and not end.wait(after_s):
            if come.is_set():
                come.clear()
                told = False
            elif not told:
                told = say(ceased())

    Thread(target=tell, name="waiting", daemon=True).start()
    try:
        yield come.set
    finally:
        end.set()
        come.set()


def waits_for(robot: Client, key: str, where: Address) -> Callable[[], str]:
    """What there is to say of a key on which nothing has come."""

    def look() -> str:
        from acsard.bus.fleet import around
        from acsard.bus.quiet import why

        seen = around(robot.session, where.robot_id, where.endpoint)
        if seen is None:
            return ""
        reason = "" if seen.linked else of_link(where)
        reason = reason or why(key, where.robot_id, where.endpoint, seen)
        return f"waiting for {robot.key(key)}: {reason}"

    return look


def lost_by(robot: Client, where: Address) -> Callable[[], str]:
    """What there is to say once what came has ceased: nothing while we are connected."""

    def look() -> str:
        import zenoh

        from acsard.bus.quiet import Around, why

        try:
            if robot.session.info.links():
                return ""
        except zenoh.ZError:
            return ""  # it is being closed
        gone = Around(linked=False, here=False)
        return of_link(where) or why("", where.robot_id, where.endpoint, gone)

    return look


def of_link(where: Address) -> str:
    """What is wrong with the way there: by TLS a certificate may have ended while we followed."""
    from acsard.bus.tls_trouble import trouble
    from acsard.config.settings import TLS

    secured = where.tls and where.endpoint.startswith(TLS)
    return trouble(where.endpoint, where.tls) if secured else ""
