"""Decides who may do what: finds the client of each HTTP request, and refuses it or serves it.

The checks come in this order: the client's address and the requested host (`callers.py`), the
origin of the web page that sent the request, the token, the token's connections and request rate,
and the client's role. A path that does not exist requires a token too, so a client without a token
does not learn which paths exist. No check waits for a disk: the tokens are those of the last
reading of the file, which `page_server.py` repeats each second.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from functools import partial

from aiohttp import web
from msgspec.structs import replace

from acsard.bus.zenoh_sessions import MAX_MESSAGE_BYTES
from acsard.core.config.settings import WebConfig
from acsard.core.throttle import Rate, Throttle
from acsard.host import clock
from acsard.web.answers import STATUS_CODES, TroubleError, problem, secured
from acsard.web.callers import (
    LOCAL_NAME,
    AdmittedClient,
    Reason,
    RequestFacts,
    RequestRefusedError,
    by_listed_page,
    place,
    require_own_origin,
    tokens_in,
    tokens_offered,
    unmapped,
)
from acsard.web.connections import MAX_OF_TOKEN, Connections, HttpConnection
from acsard.web.routes import Route
from acsard.web.tokens import ReadTokens

# Requests of one token, and messages of one WebSocket. A page asks for 20 pictures a second, and
# sends 20 commands a second. The daemon takes 1000 commands a second from this server.
REQUEST_RATE = Rate(100.0, 100.0)

FLOOD_TEXT = f"more than {REQUEST_RATE.hz:g} a second: send fewer"

# Strict, because the server copies the host into the content security policy of an answer.
HOST = re.compile(r"([A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(:[0-9]{1,5})?")

# Reasons under which aiohttp's errors are counted; any other status counts as `malformed`.
STATUS_REASONS: dict[int, Reason] = {404: "path", 405: "path", 413: "too_big"}

STATUS_TEXTS = {
    400: "this address is a WebSocket: connect to it with ws:// or wss://",
    404: "this address does not exist; GET /api lists all addresses",
    413: f"the request has more than {MAX_MESSAGE_BYTES} bytes: send less",
}

# Not in a request for a path that is open to every client.
IDENTITY_KEY: web.RequestKey[AdmittedClient] = web.RequestKey("who", AdmittedClient)

# Whether the connection of this request ends after the answer.
LAST_KEY: web.RequestKey[bool] = web.RequestKey("last", bool)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Access:
    """Checks each HTTP request, and refuses it or passes it to the handler of its route."""

    def __init__(
        self,
        robot: str,
        names: AbstractSet[str],
        tokens: ReadTokens,
        connections: Connections,
        rules: WebConfig,
    ) -> None:
        self._local = AdmittedClient(rules.local, LOCAL_NAME)
        self._origins = frozenset(rules.origins)
        self._robot, self._names, self._tokens = robot, names, tokens
        self._connections, self._counts = connections, connections.counts
        self._rates = Throttle()
        self._rows: dict[web.AbstractRoute, Route] = {}

    def application(self, rows: Iterable[Route], page: object) -> web.Application:
        """Return the application that serves the routes; each handler gets `page` first."""
        app = web.Application(middlewares=[self._serve], client_max_size=MAX_MESSAGE_BYTES)
        app.on_response_prepare.append(secured)
        app.on_response_prepare.append(self._share)
        for row in rows:
            for method in ("GET", "HEAD") if row.method == "GET" else (row.method,):
                added = app.router.add_route(method, row.pattern, partial(row.handler, page))
                self._rows[added] = row
        return app

    async def owner(self, peer: str, texts: Sequence[str]) -> AdmittedClient:
        """Return the owner of the first valid token. Raises `RequestRefusedError` without one."""
        if not any(texts):
            raise RequestRefusedError(
                "no_token", "a token is missing: run `acsard web invite ROLE` on the robot"
            )
        if (identity := self._tokens.owner(texts)) is None:
            # The token may be newer than the last reading of the file.
            await self._tokens.next_reading()
            identity = self._tokens.owner(texts)
        if identity is None:
            raise RequestRefusedError(
                "bad_token",
                "this token is not valid (expired, revoked, or for another robot): ask for a new "
                "one",
            )
        return replace(identity, address=peer)

    @web.middleware
    async def _serve(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        with connection_of(request).serving(request.content):
            answer = await self._answer(request, handler)
        if request.get(LAST_KEY):
            answer.force_close()
        return answer

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            if request.method == "OPTIONS" and self._is_shared(request):
                return self._preflight(request)
            await self._admit(request, self._rows.get(request.match_info.route))
            return await handler(request)
        except RequestRefusedError as error:
            self._counts.refuse(error.reason, _origin(request))
            return problem(STATUS_CODES.get(error.reason, 403), str(error))
        except TroubleError as trouble:
            return problem(trouble.status, str(trouble), trouble.detail)
        except web.HTTPException as error:
            if error.status < 400:
                raise
            self._counts.refuse(STATUS_REASONS.get(error.status, "malformed"), _origin(request))
            if (methods := error.headers.get("Allow")) is not None:
                answer = problem(error.status, f"this path accepts only {methods}")
                answer.headers["Allow"] = methods
                return answer
            return problem(error.status, STATUS_TEXTS.get(error.status, error.reason))

    async def _admit(self, request: web.Request, row: Route | None) -> None:
        facts = request_facts(request)
        here = place(facts, self._names | {own_address(request)}) == "here"
        is_open = row is not None and row.least is None
        listed = by_listed_page(facts, self._origins)
        if request.method not in ("GET", "HEAD") if is_open else not listed:
            require_own_origin(facts)
        if is_open:
            return
        identity = replace(self._local, address=facts.peer)
        if not here:
            # Accept cookies only from the robot's own page. A page in `web.origins` must send a
            # token.
            tokens = tokens_sent(request) if listed else tokens_shown(request, self._robot)
            identity = await self.owner(facts.peer, tokens)
        request[IDENTITY_KEY] = identity
        if not here:
            self._limit(request, identity, row)
        if row is not None and row.least is not None:
            identity.require(row.least, f"{row.method} {row.path}")

    def _limit(self, request: web.Request, identity: AdmittedClient, row: Route | None) -> None:
        connection, refusal = connection_of(request), None
        if not self._connections.claim(connection, identity.token):
            refusal = RequestRefusedError(
                "too_many",
                f"{MAX_OF_TOKEN} connections with this token are open already: close some pages, "
                "or ask for a token of your own",
            )
        elif not self._rates.take(clock.mono_ns(), REQUEST_RATE, identity.token):
            self._connections.end(identity.token, FLOOD_TEXT, but=connection)
            refusal = RequestRefusedError("too_fast", f"requests with this token: {FLOOD_TEXT}")
        if refusal is not None:
            request[LAST_KEY] = True
            if row is None or not row.always:
                raise refusal

    def _is_shared(self, request: web.Request) -> bool:
        return by_listed_page(request_facts(request), self._origins)

    def _preflight(self, request: web.Request) -> web.Response:
        place(request_facts(request), self._names | {own_address(request)})
        return web.Response(
            status=204,
            headers={
                "Access-Control-Allow-Methods": "GET, HEAD, POST",
                "Access-Control-Allow-Headers": "Authorization, Content-Type, If-None-Match",
                "Access-Control-Max-Age": "600",
            },
        )

    async def _share(self, request: web.Request, response: web.StreamResponse) -> None:
        if self._origins:
            vary = response.headers.get("Vary", "")
            response.headers["Vary"] = f"{vary}, Origin" if vary else "Origin"
        if self._is_shared(request):
            response.headers["Access-Control-Allow-Origin"] = request.headers["Origin"]
            response.headers["Access-Control-Expose-Headers"] = "ETag, Age-Ms, Waited-Ms"


def connection_of(request: web.Request) -> HttpConnection:
    connection = request.protocol
    assert isinstance(connection, HttpConnection)
    return connection


def request_facts(request: web.Request) -> RequestFacts:
    hosts = request.headers.getall("Host", [])
    return RequestFacts(
        peer_of(request),
        request.secure,
        hosts[0] if len(hosts) == 1 and HOST.fullmatch(hosts[0]) else "",
        request.headers.get("Origin"),
        request.headers.get("Sec-Fetch-Site"),
        # A proxy adds these headers when it forwards a request.
        any(
            name.lower().startswith(("forwarded", "x-forwarded-", "x-real-ip", "via"))
            for name in request.headers
        ),
    )


def peer_of(request: web.Request) -> str:
    return unmapped(request.remote or "")


def own_address(request: web.Request) -> str:
    """Return this machine's IP address of the connection, which a client cannot forge."""
    return unmapped(_reached(request)[0].lower())


def own_port(request: web.Request) -> int:
    return _reached(request)[1]


def tokens_shown(request: web.Request, robot: str) -> list[str]:
    """Return the tokens in the headers of a request or, if there are none, in its cookies."""
    return tokens_sent(request) or tokens_in(request.cookies, robot, own_port(request))


def tokens_sent(request: web.Request) -> list[str]:
    """Return the bearer token of a request, or else those in `Sec-WebSocket-Protocol`."""
    kind, _, text = request.headers.get("Authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return [text.strip()]
    return tokens_offered(request.headers.get("Sec-WebSocket-Protocol", ""))


def _reached(request: web.Request) -> tuple[str, int]:
    at = None if request.transport is None else request.transport.get_extra_info("sockname")
    return (str(at[0]), int(at[1])) if at else ("", 0)


def _origin(request: web.Request) -> str:
    identity = request.get(IDENTITY_KEY)
    return peer_of(request) if identity is None else identity.origin
