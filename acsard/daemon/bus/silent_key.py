"""Explains to a user why no sample arrives on a key.

This module is pure. `robot_discovery.presence` asks the bus which robots are there.
"""

from __future__ import annotations

from difflib import get_close_matches

from msgspec import Struct

from acsard.core.config.settings import TLS
from acsard.core.messages.topics import JSON_TREE, Topic, key_hint, row_of

MAX_NAMED = 5
"""Largest number of other robots that the message names if the requested robot is absent."""


class Presence(Struct, frozen=True):
    """The robots that a client sees on the bus."""

    linked: bool
    """True if the client is connected to its endpoint."""
    here: bool
    """True if the requested robot is present."""
    others: tuple[str, ...] = ()
    """The ids of the other robots. Over TLS they are not visible."""


def explain_silence(key: str, robot_id: str, endpoint: str, presence: Presence) -> str:
    """Return why no sample arrives on a key of a robot, and how to fix it.

    `key` is the key below the robot's id, and `endpoint` the endpoint of the client.
    """
    if not presence.linked:
        return (
            f"the endpoint {endpoint} has no connection any more: the daemon or router there has "
            "ended (`acsard run` starts a daemon), or the network is interrupted"
        )
    if presence.here:
        return f"robot {robot_id} is there, but {_silent(key)}"
    if presence.others:
        # With a cutoff of 0.0 the list has every robot, the most similar id first.
        near = get_close_matches(robot_id, presence.others, MAX_NAMED, 0.0)
        more = len(presence.others) - len(near)
        named = ", ".join(near) + (f" and {more} more (`acsard fleet`)" if more else "")
        return f"there is no robot {robot_id}, but there is {named}: choose one, --id {near[0]}"
    if endpoint.startswith(TLS):
        return (
            f"robot {robot_id} is not visible: no robot at {endpoint} has this robot.id, or your "
            f"certificate does not permit it; `acsard whoami --id {robot_id}` shows the role of "
            "your certificate"
        )
    return (
        f"no robot is visible at {endpoint}: no daemon runs there or behind that router; "
        "`acsard run` starts a daemon"
    )


def _silent(key: str) -> str:
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None:
        return f"it has no such key ({key_hint(key)})"
    if row.direction == "in":
        return f"no program sends on {key} now"
    if row.simulated:
        return f"only the simulator publishes {key}"
    return _unpublished(key, row)


def _unpublished(key: str, row: Topic) -> str:
    """Return why a key that the daemon publishes has no samples now."""
    match row.rate:
        case "on change":
            return (
                f"{key} is published only when it changes: `acsard get {row.key}` prints its "
                "last value"
            )
        case "every feedback" | "with odom":
            return (
                f"{key} is published only with answers of the microcontroller: `acsard echo "
                "state -n 1 --short` says whether the microcontroller answers"
            )
    return (
        f"{key} does not arrive: may you follow it (`acsard whoami` shows your role)? On the "
        "robot, `acsard doctor` checks the daemon"
    )
