"""Explanations of why a tool waits: without one, a silent tool looks like a dead robot."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import Event, Thread

import zenoh

from acsard.client import Client
from acsard.client.follower import FIRST_S
from acsard.core.config.settings import TLS
from acsard.core.formatting import printable
from acsard.daemon.bus.address import Address
from acsard.daemon.bus.robot_discovery import Presence, explain_silence, presence
from acsard.daemon.bus.tls import trouble


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


def silence_explained(robot: Client, key: str = "") -> AbstractContextManager[Callable[[], None]]:
    """Explain why nothing arrives on a key, and each later silence. "" explains only the latter."""
    return explained(lambda: _none_yet(robot, key) if key else "", lambda: _ceased(robot))


def _none_yet(robot: Client, key: str) -> str:
    where = robot.where
    seen = presence(robot.session, where.robot_id, where.endpoint)
    if seen is None:
        return ""
    reason = "" if seen.linked else _of_link(where)
    reason = reason or explain_silence(key, where.robot_id, where.endpoint, seen)
    return f"waiting for {robot.key(key)}: {reason}"


def _ceased(robot: Client) -> str:
    """Return why messages ceased, or "" while the session is connected."""
    try:
        if robot.session.info.links():
            return ""
    except zenoh.ZError:
        return ""  # the session is being closed
    where, gone = robot.where, Presence(linked=False, here=False)
    return _of_link(where) or explain_silence("", where.robot_id, where.endpoint, gone)


def _of_link(where: Address) -> str:
    """Return what is wrong with the TLS connection, or "".

    A certificate may have expired while the tool followed the robot.
    """
    secured = where.tls and where.endpoint.startswith(TLS)
    return trouble(where.endpoint, where.tls) if secured else ""
