"""Derives the permissions of each role from the table of keys in `keys_and_roles.py`.

These functions supply the access rules of the daemon, of the TLS gateway and of a fleet's router.
They also supply the permissions of the page and the tables of roles in the documentation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal, get_args

from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import JSON_TREE, VERBS, Topic, json_key, row_of
from acsard.core.values import ROLES, Role, Verb

Use = Literal["publish", "subscribe", "query"]
"""Action of a client on a key. A call of a service is a query."""

USES: tuple[Use, ...] = get_args(Use)

ROLE_TEXTS: dict[Role, str] = {
    "viewer": "this role may read data and stop the robot, but not drive it",
    "operator": "this role may stop the robot, clear a stop or a fault, and drive as a source that "
    "commands.sources lists",
    "maintainer": "this role has every permission",
}
"""The permissions of each role in words, for error messages."""


def has(role: str, least: Role) -> bool:
    """Return whether the role `role` includes all permissions of the role `least`.

    If `role` is "" or unknown, the result is False.
    """
    return role in ROLES and ROLES.index(role) >= ROLES.index(least)


def keys_for(role: Role, use: Use, rows: Iterable[Topic]) -> list[str]:
    """Return the keys of `rows` for which `role` is the lowest role with the permission `use`.

    These keys are left out:

    - Command keys, because only the configuration defines the names of the sources in these keys.
      `source_keys` returns the command keys, and `COMMAND_ROLE` is their lowest role.
    - Keys that only programs on the robot's own machine may use.
    """
    exact = (pair for row in rows if not row.local for pair in _exact(row, use))
    return [key for key, least in exact if least == role and "<" not in key]


def _exact(row: Topic, use: Use) -> Iterator[tuple[str, Role]]:
    least = {"publish": row.publish, "subscribe": row.subscribe, "query": row.query}[use]
    if least == "<role>":
        yield from ((row.key.replace("<role>", role), role) for role in ROLES)
        return
    if least is None:
        return
    for name in SCHEMAS if "<Type>" in row.key else ("",):
        yield row.key.replace("<Type>", name), least
    if use != "publish" and row.subscribe and row.query:
        yield json_key(row.key), least


def least_role(key: str) -> Role:
    """Return the lowest role that has the main permission for a Zenoh key.

    The main permission is the first of these that the table of keys gives to at least one role: to
    put on the key, to query the key, to subscribe to the key. For example, the result for `imu` is
    "maintainer", because only a maintainer may put on this key, although a viewer may query it. If
    no role has any of these permissions, the result is "maintainer". If the key ends with the name
    of a role, the result is this role.

    Args:
        key: the part of the key after the robot's id, such as `state`. A `json/` in front of it is
            ignored. If the table does not contain the key, the function returns the placeholder
            "viewer". This does not mean that a viewer may use the key.
    """
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None:
        return "viewer"
    if row.query == "<role>":
        return next((role for role in ROLES if key.endswith(f"/{role}")), ROLES[0])
    return row.publish or row.query or row.subscribe or ROLES[-1]


SERVICE_ROLES: dict[Verb, Role] = {verb: least_role(key) for key, verb in VERBS.items()}

COMMAND_ROLE = least_role("cmd/<source>/<certificate>")
