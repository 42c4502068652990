"""Defines `Route`, a row of the table of paths `app.ROUTES`. This module is pure.

The router, the admission of requests, the rate limits and the OpenAPI document use that table. The
rows for the keys and services of the bus are created in this module.
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
"""Function that takes the page and the request, and returns the response."""

RECORDINGS: Role = "operator"
"""The least role that may fetch recordings, and reports of recordings."""

JSON, FORM = "application/json", "application/x-www-form-urlencoded"

PARAMETERS = {"type": "[A-Za-z0-9_]{1,80}"}
"""Regular expressions of path parameters, by name. A parameter that is not listed matches any text
without a slash."""

_PARAMETER = re.compile(r"{(\w+)}")


class Which(Struct, frozen=True):
    """The robot to stop, by its id; "" is the page's own robot."""

    robot: str = ""


class Problem(Struct, frozen=True):
    """Why a request was not fulfilled, in words."""

    error: str


class Body(Struct, frozen=True):
    """Description of the body of an answer."""

    what: str
    """Description for the OpenAPI document."""
    kind: Any = ""
    """Type of the body, or the name of a bus message in `SCHEMAS`; "" for any value."""
    media: str = JSON
    """Media type of the body; "" for an answer without a body."""


class Route(Struct, frozen=True):
    """One row of the table of routes: an HTTP method on a path."""

    method: Literal["GET", "POST"]
    """HTTP method. A route for "GET" also accepts HEAD."""
    path: str
    """The path as OpenAPI writes it: `{name}` is a parameter."""
    least: Role | None
    """Least role that may use the path; None opens it to every client, without a token."""
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
    rate: Rate = REQUESTS
    """Limit on the requests of each token, as a rate. All routes with the same rate share one
    limit."""
    waits: bool = False
    """True if a request beyond `rate` is delayed; False if it is refused. If true, the server
    carries out a POST immediately and delays only the answer. `rate` then applies to each token in
    each network separately, so a program cannot use up the limit of a page that uses the same token
    in another network."""

    @property
    def parameters(self) -> list[str]:
        return _PARAMETER.findall(self.path)

    @property
    def pattern(self) -> str:
        """The path as aiohttp's router needs it, with a regular expression for each parameter."""
        patterns = {name: PARAMETERS.get(name, "[^{}/]+") for name in self.parameters}
        return _PARAMETER.sub(lambda found: f"{{{found[1]}:{patterns[found[1]]}}}", self.path)


def asked(topic: Topic) -> bool:
    """Return whether a program may query the last value of the key that `topic` describes."""
    own = topic.direction in ("out", "query") and "<key>" not in topic.key
    return own and topic.query in ROLES


def values(handler: Handler) -> Iterator[Route]:
    """Yield a route `GET /api/<key>` for each key whose last value a program may query.

    `handler` answers the requests.
    """
    for topic in filter(asked, TOPICS):
        path = f"/api/{topic.key.replace('<Type>', '{type}')}"
        gives = {200: Body("The last value.", topic.type if topic.type in SCHEMAS else "")}
        yield Route("GET", path, least_role(topic.key), handler, topic.note, gives=gives)


def services(handler: Handler) -> Iterator[Route]:
    """Yield a route `POST /api/srv/<name>` for each service of the robot.

    `handler` answers the requests.
    """
    notes = {topic.key: topic.note for topic in TOPICS}
    for key, verb in VERBS.items():
        # The daemon decodes the payload, so a refusal contains the daemon's message.
        takes = Which if verb == "stop" else SERVICES[verb].payload or None
        gives = {
            200: Body("The service call succeeded.", "ServiceReply"),
            409: Body("The service call failed; the reason is in the answer.", "ServiceReply"),
        }
        yield Route(
            "POST", f"/api/{key}", SERVICE_ROLES[verb], handler, notes[key],
            takes=takes, gives=gives, rate=STOPS if verb == "stop" else REQUESTS,
            waits=verb == "stop",
        )  # fmt: skip
