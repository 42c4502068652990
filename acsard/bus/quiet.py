"""Pure: why nothing comes on a key, in words; what can be seen, `bus/fleet.py` asks."""

from __future__ import annotations

from difflib import get_close_matches

from msgspec import Struct

from acsard.config.settings import TLS
from acsard.messages.topics import JSON_TREE, Topic, key_hint, row_of

MOST = 5
"""Robots that are named in place of one that is not there."""


class Around(Struct, frozen=True):
    """What can be seen from here."""

    linked: bool
    """Somebody is connected at the endpoint."""
    here: bool
    """The robot that is meant is there."""
    others: tuple[str, ...] = ()
    """The ids of the others; over TLS they cannot be seen."""


def why(key: str, robot_id: str, endpoint: str, around: Around) -> str:
    """Why nothing comes on a key below the id of a robot, and what to do about it."""
    if not around.linked:
        return (
            f"nobody is connected at {endpoint} any more: the daemon or router there has ended "
            "(`acsard run` starts a daemon), or the way to it is cut"
        )
    if around.here:
        return f"robot {robot_id} is there, but {_silent(key)}"
    if around.others:
        # All of them are told in the order of their likeness: none is too far from a typing error.
        near = get_close_matches(robot_id, around.others, MOST, 0.0)
        more = len(around.others) - len(near)
        named = ", ".join(near) + (f" and {more} more (`acsard fleet`)" if more else "")
        return f"no robot {robot_id} is there; there is {named}: --id {near[0]}"
    if endpoint.startswith(TLS):
        return (
            f"no robot {robot_id} is seen: none has this robot.id there, or your certificate may "
            f"not see it: `acsard whoami --id {robot_id}` tells"
        )
    return f"no robot is seen at {endpoint}: no daemon runs there, or behind that router"


def _silent(key: str) -> str:
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None:
        return f"has no such key ({key_hint(key)})"
    if row.direction == "in":
        return f"nobody sends on {key} now"
    if row.simulated:
        return f"only the simulator publishes {key}"
    return _late(key, row)


def _late(key: str, row: Topic) -> str:
    match row.rate:
        case "on change":
            return f"{key} comes on change only: `acsard get {row.key}` prints the last"
        case "every feedback" | "with odom":
            return (
                f"{key} comes with the answers of its microcontroller: `acsard echo state -n 1 "
                "--short` says what is heard of it"
            )
    return (
        f"{key} does not come: may you follow it (`acsard whoami`)? `acsard doctor` on the robot "
        "looks at the daemon"
    )
