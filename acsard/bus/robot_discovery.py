"""Finds, follows or stops the robots that `--id` names, and explains a robot's silence.

Over TLS a client must name each robot, because the access rules allow only exact keys.
"""

from __future__ import annotations

from collections.abc import Sequence

import zenoh
from msgspec import Struct

from acsard.bus.address import require_id
from acsard.bus.subscription import Subscription
from acsard.core.config.settings import is_tls
from acsard.core.formatting import listed, many
from acsard.core.messages.keys_and_roles import (
    JSON_TREE,
    STOP,
    Topic,
    by_key,
    full_key,
    key_hint,
    row_of,
)
from acsard.core.messages.signature import Signature
from acsard.core.values import ROOT_KEY
from acsard.host.errors import NoAnswerError, UsageError

ALL_ROBOTS = "*"
DISCOVERY_S = 2.0  # longest wait for the liveliness tokens of the daemons


def parse_ids(text: str) -> tuple[str, ...]:
    """Return the ids in an option `--id` that names several robots, and () if it names only one.

    ("*",) stands for all robots. Raises `UsageError` for an invalid list.
    """
    if text == ALL_ROBOTS:
        return (ALL_ROBOTS,)
    if "," not in text:
        return ()
    ids = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    try:
        for robot_id in ids:
            require_id(robot_id)
    except UsageError:
        raise UsageError(
            f"--id {text} is not a list of robot ids: an id has 1 to 32 characters of A-Z a-z "
            "0-9 _ -, and commas separate the ids; '*' stands for all robots"
        ) from None
    return ids


def running_robots(session: zenoh.Session, ids: Sequence[str], endpoint: str) -> list[str]:
    """Return the sorted ids of those robots in `ids` ("*" for all) whose daemon is running.

    Raises `NoAnswerError`, which names `endpoint`, if `ids` is only "*" and no robot is visible.
    """
    running_ids = set[str]()
    for robot_id in ids:
        replies = session.liveliness().get(full_key(robot_id, "alive"), timeout=DISCOVERY_S)
        running_ids |= {
            robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None
        }
    running_ids.discard("")
    if not running_ids and tuple(ids) == (ALL_ROBOTS,):
        raise NoAnswerError(no_robot_text(endpoint))
    return sorted(running_ids)


def presence(session: zenoh.Session, robot_id: str, endpoint: str) -> Presence | None:
    """Return whether a robot is visible on the bus, and the others if not; None if closing."""
    try:
        if not session.info.links():
            return Presence(linked=False, here=False)
        if running_robots(session, (robot_id,), endpoint):
            return Presence(linked=True, here=True)
        return Presence(True, False, tuple(running_robots(session, (ALL_ROBOTS,), endpoint)))
    except NoAnswerError:
        return Presence(linked=True, here=False)
    except zenoh.ZError:
        return None


def stop(session: zenoh.Session, ids: Sequence[str], sender: str) -> None:
    """Send a stop to these robots ("*" for all), without waiting for an answer."""
    by = Signature(sender).pack()
    for robot_id in ids:
        session.put(full_key(robot_id, STOP), b"", attachment=by, express=True)


def count_text(endpoint: str, robots: int) -> str:
    """Return a text that says how many robots are visible at `endpoint`."""
    return f"all robots visible at {endpoint}: {many(robots, 'robot')}"


def no_robot_text(endpoint: str) -> str:
    """Return a message that explains why no robot is visible at an endpoint."""
    if is_tls(endpoint):
        return (
            "no robot is visible. Over TLS, name the robots: --id robot1,robot2, or once in "
            "[fleet] robots. If that does not help, your certificate may have no role at any "
            "robot; `acsard doctor --id robot1` checks this"
        )
    return (
        f"no robot is visible at {endpoint}: no daemon is running there, and no daemon is "
        "connected to a router there; `acsard run` starts a daemon"
    )


def follow(session: zenoh.Session, ids: Sequence[str], name: str) -> Subscription:
    """Subscribe to the key `name`, such as `state`, of these robots ("*" for all).

    `robot_of` returns the robot's id of a sample's key. Raises `UsageError` if `name` is not a key.
    """
    if ALL_ROBOTS in ids:
        ids = (ALL_ROBOTS,)  # each sample once, also of the robots that are named besides
    topic = by_key(name)
    latched = topic is not None and topic.latched
    keys = [full_key(robot_id, name) for robot_id in ids]
    try:
        return Subscription(session, *keys, latched=latched, exact=False)
    except zenoh.ZError:
        raise UsageError(f"{name!r} is not a key; `acsard topics` lists them") from None


def robot_of(key: str) -> str:
    """Return the robot id in a full key, or "" for any other key and for one with a wildcard."""
    root, _, rest = key.partition("/")
    return rest.partition("/")[0] if root == ROOT_KEY and not set(key) & set("*$") else ""


MAX_NAMED = 5  # other robots in a message


class Presence(Struct, frozen=True):
    """The robots that a client sees on the bus."""

    linked: bool  # to the client's endpoint
    here: bool  # the requested robot is present
    # Visible robots if not `here`; over TLS only with `access.wildcards`.
    others: tuple[str, ...] = ()


def explain_silence(key: str, robot_id: str, endpoint: str, presence: Presence) -> str:
    """Return why no sample arrives on the key `key` of a robot, and how to fix this."""
    if not presence.linked:
        return (
            f"the connection to {endpoint} is lost: the daemon or router there has ended "
            "(`acsard run` starts a daemon), or the network is interrupted"
        )
    if presence.here:
        return f"robot {robot_id} is there, but {_silent(key)}"
    if presence.others:
        from difflib import get_close_matches

        # With a cutoff of 0.0, no robot is excluded, and the most similar ids come first.
        near = get_close_matches(robot_id, presence.others, len(presence.others), 0.0)
        named = listed(near, MAX_NAMED)
        return f"there is no robot {robot_id}. Robots here: {named}; use --id {near[0]}"
    if is_tls(endpoint):
        return (
            f"robot {robot_id} is not visible: no robot at {endpoint} has this robot.id, or your "
            f"certificate does not permit you to see the robot; `acsard doctor --id {robot_id}` "
            "shows the role of your certificate"
        )
    return no_robot_text(endpoint)


def _silent(key: str) -> str:
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None:
        return f"it has no such key ({key_hint(key)})"
    if row.direction == "in":
        return f"no program sends on the Zenoh key {key} now"
    if row.simulated:
        return f"only the simulator publishes {key}"
    if row.key == "battery":
        return NO_BATTERY
    return _unpublished(key, row)


NO_BATTERY = "battery has a value only while the board reports the battery's voltage or charge"


def _unpublished(key: str, row: Topic) -> str:
    match row.rate:
        case "on change":
            return (
                f"{key} is published only when it changes: `acsard get {row.key}` prints its "
                "last value"
            )
        case "every feedback" | "with odom":
            return (
                f"{key} is published only while the microcontroller answers: `acsard echo "
                "state -n 1 --short` shows whether it does"
            )
    return (
        f"{key} does not arrive: either your role lacks the permission to read it, or the daemon "
        "has a fault; `acsard doctor` shows your role and checks the daemon"
    )
