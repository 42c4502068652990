"""Defines the type of the rows in `app.ROUTES`, the table of all paths of the page's server.

The router, the admission of requests, the rate limits and the OpenAPI document use that table. This
module also creates the rows for the keys and services of the bus. The module is pure.
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
from acsard.web.limits import REQUEST_RATE, STOPS

Handler = Callable[[Any, Any], Awaitable[Any]]
"""Coroutine function that takes the `Page` and the request, and returns the answer."""

RECORDINGS_ROLE: Role = "operator"
"""Lowest role that may download recordings."""

JSON, FORM = "application/json", "application/x-www-form-urlencoded"

PARAMETERS = {"type": "[A-Za-z0-9_]{1,80}"}
"""Regular expression of a path parameter, by the parameter's name. A parameter with any other name
matches any text without a slash."""

_PARAMETER = re.compile(r"{(\w+)}")


class Problem(Struct, frozen=True):
    """Why a request was not fulfilled, in words."""

    error: str


class Body(Struct, frozen=True):
    """Description of the body of an answer."""

    what: str
    """Description for the OpenAPI document."""
    kind: Any = ""
    """Type of the body, or the name of a bus message in `SCHEMAS`; "" if it may be any value."""
    media: str = JSON
    """Media type of the body; "" for an answer without a body."""


class Route(Struct, frozen=True):
    """A row of the table `app.ROUTES`: a path with an HTTP method, and the rules for its use."""

    method: Literal["GET", "POST"]
    """HTTP method. A route for "GET" also accepts HEAD."""
    path: str
    """Path in the notation of OpenAPI, in which `{name}` is a parameter."""
    least: Role | None
    """Lowest role that may use the path. If it is None, every client may use the path, even without
    a token."""
    handler: Handler
    summary: str = ""
    """Description for the OpenAPI document. If it is "", the document leaves the route out."""
    takes: type | str | None = None
    """Type of the request's body, or the name of a bus message in `SCHEMAS`; None if there is no
    body."""
    forms: tuple[str, ...] = (JSON,)
    """Media types of the request's body."""
    gives: Mapping[int, Body] = {}
    """Maps an HTTP status to the body of the answer. An answer with any other status contains a
    `Problem`."""
    rate: Rate = REQUEST_RATE
    """Limit on the requests with one token. All routes with the same rate share one limit."""
    waits: bool = False
    """True if the server delays a request beyond `rate`; False if it refuses the request.

    If it is True, the server performs a POST immediately and delays only the answer. `rate` then
    applies to each token in each network separately. So a program cannot use up the limit of a page
    that uses the same token in another network.
    """

    @property
    def parameters(self) -> list[str]:
        return _PARAMETER.findall(self.path)

    @property
    def pattern(self) -> str:
        """Path in the notation of aiohttp's router, with a regular expression per parameter."""
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
    for key, verb in VERBS.items():
        # The daemon decodes the payload, so a refusal contains the daemon's message.
        takes = SERVICES[verb].payload or None
        gives = {
            200: Body("The service call succeeded.", "ServiceReply"),
            409: Body("The service call failed; the reason is in the answer.", "ServiceReply"),
        }
        yield Route(
            "POST", f"/api/{key}", SERVICE_ROLES[verb], handler, notes[key],
            takes=takes, gives=gives, rate=STOPS if verb == "stop" else REQUEST_RATE,
            waits=verb == "stop",
        )  # fmt: skip
