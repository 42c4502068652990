"""Derives the permissions of each role from the table of keys in `keys_and_roles.py`.

The access rules of daemon, gateway and routers, the page and the tables of roles use them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal, get_args

from acsard.core.messages.keys_and_roles import JSON_TREE, VERBS, Topic, json_key, row_of
from acsard.core.messages.schema import SCHEMA_NAMES
from acsard.core.values import ROLES, Role, Verb

Use = Literal["publish", "subscribe", "query"]  # a call of a service is a query

USES: tuple[Use, ...] = get_args(Use)

# The permissions of a role in words, for error messages.
ROLE_TEXTS: dict[Role, str] = {
    "viewer": "this role may read data and stop the robot, but not drive it",
    "operator": "this role may stop the robot, clear a stop or a fault, and drive as a source that "
    "commands.sources lists",
    "maintainer": "this role has every permission",
}


def has(role: str, least: Role) -> bool:
    """Return whether a role includes the permissions of another one; unknown roles do not."""
    return role in ROLES and ROLES.index(role) >= ROLES.index(least)


def keys_for(role: Role, use: Use, rows: Iterable[Topic]) -> list[str]:
    """Return the keys for which `role` is the lowest role with the permission `use`.

    Local keys are left out, and command keys (`source_keys`, `COMMAND_ROLE`), whose sources the
    configuration names.
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
    for name in SCHEMA_NAMES if "<Type>" in row.key else ("",):
        yield row.key.replace("<Type>", name), least
    if use != "publish" and row.subscribe and row.query:
        yield json_key(row.key), least


def least_role(key: str) -> Role:
    """Return the lowest role that may put on a key, otherwise query it, otherwise subscribe.

    A `json/` is ignored, and a role's name at the end is the role. Without any permission the
    result is "maintainer". Raises `LookupError` for an unknown key, which no role may use.
    """
    row = row_of(key.removeprefix(JSON_TREE))
    if row is None or (row.query == "<role>" and key.rpartition("/")[2] not in ROLES):
        raise LookupError(f"the table of keys has no row for {key!r}")
    if row.query == "<role>":
        return next(role for role in ROLES if key.endswith(f"/{role}"))
    return row.publish or row.query or row.subscribe or ROLES[-1]


SERVICE_ROLES: dict[Verb, Role] = {verb: least_role(key) for key, verb in VERBS.items()}

COMMAND_ROLE = least_role("cmd/<source>/<certificate>")
