"""Many robots on one bus: which `--id` names, who is there, and what comes from all of them.

Over TLS only exact keys pass, since a few wildcards can take a router's time: there each robot has
to be named.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import zenoh

from acsard.bus.address import require_id
from acsard.bus.quiet import Around
from acsard.bus.subscription import Subscription, queue_on
from acsard.config.settings import TLS
from acsard.host.errors import NoAnswerError, UsageError
from acsard.messages.topics import by_key, full_key
from acsard.values import ROOT

ALL = "*"
PRESENT_S = 2.0
"""Who is there says so within."""


def named(text: str) -> tuple[str, ...]:
    """The ids of an `--id` for many, `("*",)` for all there are; () for one robot's.

    Raises `UsageError` for what no robot can be called.
    """
    if text == ALL:
        return (ALL,)
    if "," not in text:
        return ()
    ids = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    try:
        for one in ids:
            require_id(one)
    except UsageError:
        raise UsageError(
            f"--id {text}: write ids with a comma between, or '*' for all robots"
        ) from None
    return ids


def present(session: zenoh.Session, ids: Sequence[str], endpoint: str) -> list[str]:
    """Those of the ids, or all, whose daemon is there.

    Raises `NoAnswerError` when all were meant and nobody is there, or may be seen.
    """
    found = set()
    for one in ids:
        replies = session.liveliness().get(full_key(one, "alive"), timeout=PRESENT_S)
        found |= {robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}
    found.discard("")
    if not found and ALL in ids:
        raise NoAnswerError(nobody(endpoint))
    return sorted(found)


def around(session: zenoh.Session, robot_id: str, endpoint: str) -> Around | None:
    """Whether this robot is there, and who else; None where the session is being closed."""
    try:
        if not session.info.links():
            return Around(linked=False, here=False)
        if present(session, (robot_id,), endpoint):
            return Around(linked=True, here=True)
        return Around(True, False, tuple(present(session, (ALL,), endpoint)))
    except NoAnswerError:
        return Around(linked=True, here=False)
    except zenoh.ZError:
        return None


def stop(session: zenoh.Session, ids: Sequence[str], sender: str) -> None:
    """Tell these robots to stop, or all: at once, whoever else is there and slow to answer.

    `sender` is the caller's sender id, `NAME/SECRET`.
    """
    by = msgspec.msgpack.encode({"sender": sender})
    for one in ids:
        session.put(full_key(one, "stop"), b"", attachment=by, express=True)


def seen(endpoint: str, robots: int) -> str:
    """How many there are by a wildcard, and where that was asked: another place may see others."""
    return f"all seen at {endpoint}: {robots} robot{'' if robots == 1 else 's'}"


def nobody(endpoint: str) -> str:
    """Why no robot is seen by a wildcard, in words."""
    if endpoint.startswith(TLS):
        return (
            "no robot is seen: over TLS only exact keys pass, so name them, --id robot1,robot2 "
            "(or [access] wildcards = true at the robot); or your certificate may see none: "
            "`acsard whoami --id robot1` tells"
        )
    return f"no robot is seen at {endpoint}; does a daemon run there, or behind that router?"


def follow(session: zenoh.Session, ids: Sequence[str], name: str) -> Subscription:
    """The samples of a key of all of these robots; `robot_of` says whose one is."""
    topic = by_key(name)
    latched = topic is not None and topic.latched
    keys = [full_key(one, name) for one in ids]
    try:
        return Subscription(queue_on(session, *keys, latched=latched))
    except zenoh.ZError:
        raise UsageError(f"{name!r} is not a key; `acsard topics` lists them") from None


def robot_of(key: str) -> str:
    """Whose key this is; "" for a wildcard, which is no robot's."""
    root, _, rest = key.partition("/")
    return rest.partition("/")[0] if root == ROOT and not set(key) & set("*$") else ""
