"""Explanations of why a tool waits: without one, a silent tool looks like a dead robot."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

import zenoh

from acsard.client import Client
from acsard.client.follower import FIRST_S
from acsard.core.config.settings import TLS
from acsard.core.formatting import printable
from acsard.daemon.bus.address import Address
from acsard.daemon.bus.quiet import Around, why
from acsard.daemon.bus.robot_discovery import around
from acsard.daemon.bus.tls import trouble


def nothing() -> str:
    """Return "": there is nothing to explain."""
    return ""


@contextmanager
def explained(
    look: Callable[[], str], ceased: Callable[[], str] | None = None, after_s: float = FIRST_S
) -> Iterator[Callable[[], None]]:
    """Yield a function that the caller calls for each message, and explain silences.

    A separate thread prints the explanations on standard error, so that the caller never waits for
    them.

    Args:
        look: explains why nothing has arrived for `after_s` s, in one line; "" prints nothing.
        ceased: explains each later silence of `after_s` s, once for each.
        after_s: silence before it is explained, s.
    """
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


def waits_for(robot: Client, key: str) -> Callable[[], str]:
    """Return a function that explains why nothing has arrived on a key."""

    def look() -> str:
        where = robot.where
        seen = around(robot.session, where.robot_id, where.endpoint)
        if seen is None:
            return ""
        reason = "" if seen.linked else of_link(where)
        reason = reason or why(key, where.robot_id, where.endpoint, seen)
        return f"waiting for {robot.key(key)}: {reason}"

    return look


def lost_by(robot: Client) -> Callable[[], str]:
    """Return a function that explains why messages ceased.

    It returns "" while the session is connected.
    """

    def look() -> str:
        try:
            if robot.session.info.links():
                return ""
        except zenoh.ZError:
            return ""  # the session is being closed
        where, gone = robot.where, Around(linked=False, here=False)
        return of_link(where) or why("", where.robot_id, where.endpoint, gone)

    return look


def of_link(where: Address) -> str:
    """Return what is wrong with the TLS connection, or "".

    A certificate may have expired while the tool followed the robot.
    """
    secured = where.tls and where.endpoint.startswith(TLS)
    return trouble(where.endpoint, where.tls) if secured else ""
