"""The rows of the table of routes: the meaning, the role, the input and the output of each path.

This module is pure. `app.ROUTES` is the table. Dispatch, admission, the request rate, the answers
404 and 405 and the OpenAPI document use it, so a path that is not in the table does not exist. The
rows of the robot's keys and services are made here from the bus's own tables.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, Literal

from msgspec import Struct

from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import SERVICES, TOPICS, VERBS, Topic
from acsard.core.messages.permissions import SERVICE_ROLES, least_role
from acsard.core.values import ROLES, Role
from acsard.host.rate_limits import Rate
from acsard.web.limits import REQUESTS, STOPS

Handler = Callable[[Any, Any], Awaitable[Any]]
"""Takes the page and the request, and returns the response."""

RECORDINGS: Role = "operator"
"""The least role that may fetch recordings and have them drawn."""

JSON, FORM = "application/json", "application/x-www-form-urlencoded"

PARAMETERS = {"type": "[A-Za-z0-9_]{1,80}"}
"""Patterns of path parameters. Any other parameter matches any text without a slash."""

_PARAMETER = re.compile(r"{(\w+)}")


class Which(Struct, frozen=True):
    """The robot to stop: the page's own, or another one of the same router."""

    robot: str = ""


class Problem(Struct, frozen=True):
    """Why a request was not fulfilled, in words."""

    error: str


class Body(Struct, frozen=True):
    """The body of an answer."""

    what: str
    """Description for the OpenAPI document."""
    kind: Any = ""
    """Type of the body, or the name of a message of the bus; "" for any value."""
    media: str = JSON
    """Media type of the body; "" for an answer without a body."""


class Route(Struct, frozen=True):
    """One row: a method on a path."""

    method: Literal["GET", "POST"]
    """GET includes HEAD."""
    path: str
    """The path as OpenAPI writes it: `{name}` is a parameter."""
    least: Role | None
    """Least role that may use the row; None opens it to everybody, without a token."""
    handler: Handler
    summary: str = ""
    """Description for the OpenAPI document; "" leaves the row out of it."""
    takes: type | str | None = None
    """Type of the request's body, or the name of a message of the bus; None without a body."""
    forms: tuple[str, ...] = (JSON,)
    """Media types of the request's body."""
    gives: Mapping[int, Body] = {}
    """The answers by HTTP status. Every error is a `Problem`."""
    rate: Rate = REQUESTS
    """Limit on the requests per token, shared by all rows that have this rate."""
    waits: bool = False
    """True makes a request beyond the rate wait instead of refusing it.

    A stop must always go through: it is sent at once, and its answer waits. A page that reconnects
    must not be kept out by another program that uses the same token elsewhere. So, if this is true,
    the rate applies to each token in each network separately.
    """

    @property
    def parameters(self) -> list[str]:
        """The names of the path's parameters."""
        return _PARAMETER.findall(self.path)

    @property
    def pattern(self) -> str:
        """The path with the pattern of each parameter, for the router."""
        patterns = {name: PARAMETERS.get(name, "[^{}/]+") for name in self.parameters}
        return _PARAMETER.sub(lambda found: f"{{{found[1]}:{patterns[found[1]]}}}", self.path)


def asked(topic: Topic) -> bool:
    """Return whether the topic has a last value that a program may query."""
    own = topic.direction in ("out", "query") and "<key>" not in topic.key
    return own and topic.query in ROLES


def values(handler: Handler) -> Iterator[Route]:
    """Yield the row of each key whose last value a program may query."""
    for topic in filter(asked, TOPICS):
        path = f"/api/{topic.key.replace('<Type>', '{type}')}"
        gives = {200: Body("The last value.", topic.type if topic.type in SCHEMAS else "")}
        yield Route("GET", path, least_role(topic.key), handler, topic.note, gives=gives)


def services(handler: Handler) -> Iterator[Route]:
    """Yield the row of each service."""
    notes = {topic.key: topic.note for topic in TOPICS}
    for key, verb in VERBS.items():
        # The daemon decodes the payload, so a refusal contains the daemon's message.
        takes = Which if verb == "stop" else SERVICES[verb].payload or None
        gives = {
            200: Body("It was done.", "ServiceReply"),
            409: Body("It was not done; the reason is in the answer.", "ServiceReply"),
        }
        yield Route(
            "POST", f"/api/{key}", SERVICE_ROLES[verb], handler, notes[key],
            takes=takes, gives=gives, rate=STOPS if verb == "stop" else REQUESTS,
            waits=verb == "stop",
        )  # fmt: skip
