"""Finds, follows or stops the robots that an `--id` for several robots names.

Over TLS the access rules allow exact keys only, because a few wildcards can take all the time of a
router. A client over TLS must therefore name each robot.
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
from acsard.daemon.bus.silent_key import Presence
from acsard.daemon.bus.subscription import Subscription, queue_on
from acsard.host.errors import NoAnswerError, UsageError

ALL = "*"
PRESENT_S = 2.0
"""Time to wait for the liveliness tokens of the daemons, s."""


def named(text: str) -> tuple[str, ...]:
    """Return the robot ids in the text of an option `--id`.

    Returns `("*",)` if the text stands for all robots, and () if it names only one robot. Raises
    `UsageError` for a text that is not a list of robot ids.
    """
    if text == ALL:
        return (ALL,)
    if "," not in text:
        return ()
    ids = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    try:
        for robot_id in ids:
            require_id(robot_id)
    except UsageError:
        raise UsageError(
            f"--id {text}: separate the ids with commas, or write '*' for all robots"
        ) from None
    return ids


def present(session: zenoh.Session, ids: Sequence[str], endpoint: str) -> list[str]:
    """Return the ids out of `ids` whose daemon is running, sorted.

    "*" in `ids` stands for all robots. If it is there and no robot is visible, the function raises
    `NoAnswerError` with a message for the user of this `endpoint`.
    """
    found = set()
    for robot_id in ids:
        replies = session.liveliness().get(full_key(robot_id, "alive"), timeout=PRESENT_S)
        found |= {robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}
    found.discard("")
    if not found and ALL in ids:
        raise NoAnswerError(nobody(endpoint))
    return sorted(found)


def presence(session: zenoh.Session, robot_id: str, endpoint: str) -> Presence | None:
    """Return whether this robot is present, or else the other robots.

    Returns None if the session is closing.
    """
    try:
        if not session.info.links():
            return Presence(linked=False, here=False)
        if present(session, (robot_id,), endpoint):
            return Presence(linked=True, here=True)
        return Presence(True, False, tuple(present(session, (ALL,), endpoint)))
    except NoAnswerError:
        return Presence(linked=True, here=False)
    except zenoh.ZError:
        return None


def stop(session: zenoh.Session, ids: Sequence[str], sender: str) -> None:
    """Stop these robots; "*" in `ids` stands for all robots.

    This function does not wait for answers, so that a slow robot does not delay the stop of the
    others. `sender` is the caller's sender id, `NAME/SECRET`.
    """
    by = msgspec.msgpack.encode({"sender": sender})
    for robot_id in ids:
        session.put(full_key(robot_id, "stop"), b"", attachment=by, express=True)


def seen(endpoint: str, robots: int) -> str:
    """Return a sentence with the number of robots that are visible at an endpoint."""
    return f"all robots visible at {endpoint}: {many(robots, 'robot')}"


def nobody(endpoint: str) -> str:
    """Return a message that explains why no robot is visible at an endpoint."""
    if endpoint.startswith(TLS):
        return (
            "no robot is visible: over TLS you must name the robots, --id robot1,robot2 (or set "
            "[access] wildcards = true on the robot); or your certificate has no role at any "
            "robot: `acsard whoami --id robot1` shows the role"
        )
    return f"no robot is visible at {endpoint}; does a daemon run there, or behind that router?"


def follow(session: zenoh.Session, ids: Sequence[str], name: str) -> Subscription:
    """Subscribe to the key `name` of all these robots; "*" in `ids` stands for all robots.

    `robot_of` returns the robot of a sample.
    """
    topic = by_key(name)
    latched = topic is not None and topic.latched
    keys = [full_key(robot_id, name) for robot_id in ids]
    try:
        return Subscription(queue_on(session, *keys, latched=latched))
    except zenoh.ZError:
        raise UsageError(f"{name!r} is not a key; `acsard topics` lists them") from None


def robot_of(key: str) -> str:
    """Return the robot id in a full key; "" for a key expression with a wildcard."""
    root, _, rest = key.partition("/")
    return rest.partition("/")[0] if root == ROOT and not set(key) & set("*$") else ""
