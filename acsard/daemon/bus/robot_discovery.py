"""Parses the `--id` lists for several robots; finds these robots, follows or stops them.

Over TLS the access rules pass exact keys only, because a few wildcards can take a router's time
without bound. A client over TLS must therefore name each robot.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import zenoh

from acsard.core.config.settings import TLS
from acsard.core.formatting import many
from acsard.core.messages.topics import by_key, full_key
from acsard.core.values import ROOT
from acsard.daemon.bus.address import require_id
from acsard.daemon.bus.quiet import Around
from acsard.daemon.bus.subscription import Subscription, queue_on
from acsard.host.errors import NoAnswerError, UsageError

ALL = "*"
PRESENT_S = 2.0
"""Seconds to wait for the liveliness tokens of the daemons that run."""


def named(text: str) -> tuple[str, ...]:
    """Return the ids in an `--id` for several robots: `("*",)` for all, () if it names one robot.

    Raises `UsageError` for a text that is not a list of robot ids.
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
            f"--id {text}: separate the ids by commas, or write '*' for all robots"
        ) from None
    return ids


def present(session: zenoh.Session, ids: Sequence[str], endpoint: str) -> list[str]:
    """Return the sorted ids, out of `ids` or out of all robots, whose daemon is running.

    Raises `NoAnswerError` if `ids` asks for all robots and none is visible from here.
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
    """Return whether this robot and others are present, or None if the session is closing."""
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
    """Stop these robots, or all of them for "*".

    The stop is sent at once: it waits for no answer, so a slow robot does not delay the others.
    `sender` is the caller's sender id, `NAME/SECRET`.
    """
    by = msgspec.msgpack.encode({"sender": sender})
    for one in ids:
        session.put(full_key(one, "stop"), b"", attachment=by, express=True)


def seen(endpoint: str, robots: int) -> str:
    """Return how many robots a wildcard found and where. Elsewhere others may be visible."""
    return f"all robots visible at {endpoint}: {many(robots, 'robot')}"


def nobody(endpoint: str) -> str:
    """Return why a wildcard found no robot, as a message."""
    if endpoint.startswith(TLS):
        return (
            "no robot is visible: over TLS only exact keys pass, so name the robots, --id "
            "robot1,robot2 (or set [access] wildcards = true on the robot); or your certificate "
            "permits none: `acsard whoami --id robot1` says so"
        )
    return f"no robot is visible at {endpoint}; does a daemon run there, or behind that router?"


def follow(session: zenoh.Session, ids: Sequence[str], name: str) -> Subscription:
    """Subscribe to one key of all these robots. `robot_of` gives the robot of a sample."""
    topic = by_key(name)
    latched = topic is not None and topic.latched
    keys = [full_key(one, name) for one in ids]
    try:
        return Subscription(queue_on(session, *keys, latched=latched))
    except zenoh.ZError:
        raise UsageError(f"{name!r} is not a key; `acsard topics` lists them") from None


def robot_of(key: str) -> str:
    """Return the robot id in a full key, "" for a key expression with a wildcard."""
    root, _, rest = key.partition("/")
    return rest.partition("/")[0] if root == ROOT and not set(key) & set("*$") else ""
