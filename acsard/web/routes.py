"""Defines the type of the rows in `app.ROUTES`, the table of all paths of the page's server.

The router, the checks of `access.py` and the OpenAPI document use that table. This module also
creates the rows for the keys and services of the bus. The module is pure.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, Literal

from msgspec import Struct

from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import (
    ANY_SERVICE,
    SERVICE_NAME,
    SERVICES,
    TOPICS,
    VERBS,
    Topic,
)
from acsard.core.messages.permissions import least_role
from acsard.core.values import ROLES, Role

# Takes the `Page` and the request.
Handler = Callable[[Any, Any], Awaitable[Any]]

RECORDINGS_ROLE: Role = "operator"

JSON = "application/json"

# A path parameter with another name matches any text without a slash.
PARAMETERS = {"type": "[A-Za-z0-9_]{1,80}", "verb": SERVICE_NAME.pattern, "file": ".*"}

_PARAMETER = re.compile(r"{(\w+)}")


class Problem(Struct, frozen=True, omit_defaults=True):
    """Why a request was not fulfilled, in words."""

    error: str
    detail: str = ""  # for the person who sets up the robot, if it is more than a user needs


class Body(Struct, frozen=True):
    """Description of the body of an answer."""

    what: str  # for the OpenAPI document
    kind: Any = ""  # type, or name of a bus message in `SCHEMAS`; "" for any value
    media: str = JSON  # "" for an answer without a body


class Route(Struct, frozen=True):
    """A row of the table `app.ROUTES`: a path with an HTTP method, and the rules for its use."""

    method: Literal["GET", "POST"]  # "GET" also takes HEAD
    path: str  # in the notation of OpenAPI
    least: Role | None  # None: also without a token
    handler: Handler
    summary: str = ""  # "": not in the OpenAPI document
    takes: type | str | None = None  # type, or name of a bus message in `SCHEMAS`
    gives: Mapping[int, Body] = {}  # by HTTP status; any other one gives a `Problem`
    # A stop is answered even if its token has too many connections or requests.
    always: bool = False

    @property
    def parameters(self) -> list[str]:
        return _PARAMETER.findall(self.path)

    @property
    def pattern(self) -> str:
        """Path in the notation of aiohttp's router."""
        patterns = {name: PARAMETERS.get(name, "[^{}/]+") for name in self.parameters}
        return _PARAMETER.sub(lambda match: f"{{{match[1]}:{patterns[match[1]]}}}", self.path)


def is_queryable(topic: Topic) -> bool:
    """Return whether a program can query the last message of `topic` over HTTP."""
    own = topic.direction in ("out", "query") and "<key>" not in topic.key
    return own and topic.query in ROLES


def values(handler: Handler) -> Iterator[Route]:
    """Yield the route `GET /api/<key>` for each key whose last value a program may query."""
    for topic in filter(is_queryable, TOPICS):
        path = f"/api/{topic.key.replace('<Type>', '{type}')}"
        gives = {200: Body("The last value.", topic.type if topic.type in SCHEMAS else "")}
        yield Route("GET", path, least_role(topic.key), handler, topic.note, gives=gives)


def services(handler: Handler) -> Iterator[Route]:
    """Yield the route `POST /api/srv/<name>` for each service of the robot."""
    notes = {topic.key: topic.note for topic in TOPICS}
    # The row for unknown services comes last, because the first path that matches counts.
    for key, verb in (*VERBS.items(), (ANY_SERVICE, None)):
        # The daemon decodes the payload, so a refusal contains the daemon's message.
        takes = SERVICES[verb].payload or None if verb else None
        gives = {
            200: Body("The service call succeeded.", "ServiceReply"),
            409: Body("The service call failed; the reason is in the answer.", "ServiceReply"),
        }
        yield Route(
            "POST", f"/api/{key.replace('<verb>', '{verb}')}", least_role(key), handler, notes[key],
            takes=takes, gives=gives, always=verb == "stop",
        )  # fmt: skip
