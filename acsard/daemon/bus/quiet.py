"""Explains why no sample arrives on a key.

Pure: `robot_discovery.around` looks and this module interprets.
"""

from __future__ import annotations

from difflib import get_close_matches

from msgspec import Struct

from acsard.core.config.settings import TLS
from acsard.core.messages.topics import JSON_TREE, Topic, key_hint, row_of

MOST = 5
"""Robots that the message names at most when the requested one is not there."""


class Around(Struct, frozen=True):
    """The result of a look at the bus from this client."""

    linked: bool
    """Whether the endpoint has a link."""
    here: bool
    """Whether the requested robot is present."""
    others: tuple[str, ...] = ()
    """The ids of the other robots. Over TLS they are not visible."""


def why(key: str, robot_id: str, endpoint: str, around: Around) -> str:
    """Return why no sample arrives on a key of a robot, and how to fix it."""
    if not around.linked:
        return (
            f"the endpoint {endpoint} has no connection any more: the daemon or router there has "
            "ended (`acsard run` starts a daemon), or the network is interrupted"
        )
    if around.here:
        return f"robot {robot_id} is there, but {_silent(key)}"
    if around.others:
        # A cutoff of 0.0 lists every robot, the most similar id first, however unlike the typed
        # one.
        near = get_close_matches(robot_id, around.others, MOST, 0.0)
        more = len(around.others) - len(near)
        named = ", ".join(near) + (f" and {more} more (`acsard fleet`)" if more else "")
        return f"there is no robot {robot_id}, but there is {named}: --id {near[0]}"
    if endpoint.startswith(TLS):
        return (
            f"robot {robot_id} is not visible: no robot there has this robot.id, or your "
            f"certificate does not permit it: `acsard whoami --id {robot_id}` tells which"
        )
    return f"no robot is visible at {endpoint}: no daemon runs there, or behind that router"


def _silent(key: str) -> str:
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None:
        return f"it has no such key ({key_hint(key)})"
    if row.direction == "in":
        return f"no program sends on {key} now"
    if row.simulated:
        return f"only the simulator publishes {key}"
    return _late(key, row)


def _late(key: str, row: Topic) -> str:
    match row.rate:
        case "on change":
            return (
                f"{key} is published only when it changes: `acsard get {row.key}` prints its "
                "last value"
            )
        case "every feedback" | "with odom":
            return (
                f"{key} is published only with answers of the microcontroller: `acsard echo "
                "state -n 1 --short` says whether they come"
            )
    return (
        f"{key} does not arrive: may you follow it (`acsard whoami`)? On the robot, `acsard "
        "doctor` checks the daemon"
    )
