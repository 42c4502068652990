"""Decides whether an HTTP request reaches its handler.

The module checks, in this order: the client's address and the requested host (`callers.py`), the
origin of the web page that sent the request, the token, the request rate, and the client's role.
A path that does not exist requires a token too, so a client without a token does not learn which
paths exist.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from functools import partial

from aiohttp import web
from msgspec.structs import replace

from acsard.core.config.settings import WebConfig
from acsard.host import clock
from acsard.host.rate_limits import Buckets, Rate
from acsard.host.threads import in_thread
from acsard.web.acceptor import Acceptor
from acsard.web.answers import READ_TIMEOUT_S, STATUS_CODES, TroubleError, problem, secured
from acsard.web.callers import (
    LOCAL_NAME,
    AdmittedClient,
    Reason,
    RequestFacts,
    RequestRefusedError,
    by_listed_page,
    network_of,
    place,
    require_own_origin,
    tokens_in,
    tokens_offered,
    unmapped,
)
from acsard.web.limits import GUESSES, GUESSES_OF_ONE, REFUSAL_DELAY_S, REQUEST_RATE, STRANGER_RATE
from acsard.web.metrics import Counts
from acsard.web.routes import Route
from acsard.web.socket_messages import MAX_MESSAGE_BYTES
from acsard.web.tasks import shared
from acsard.web.tokens import Token, Vault, owner_in

# Strict, because the server copies the host into the content security policy of an answer.
HOST = re.compile(r"([A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(:[0-9]{1,5})?")

# Reasons under which aiohttp's errors are counted; any other status counts as `malformed`.
STATUS_REASONS: dict[int, Reason] = {404: "path", 405: "path", 413: "too_big"}

STATUS_TEXTS = {
    404: "this address does not exist; GET /api lists all addresses",
    413: f"the request has more than {MAX_MESSAGE_BYTES} bytes: send less",
}

# Not in a request for a path that is open to every client.
IDENTITY_KEY: web.RequestKey[AdmittedClient] = web.RequestKey("who", AdmittedClient)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

# Each read starts a thread. Without this limit, a flood of requests delayed a stop by 200 ms.
MIN_READ_INTERVAL_S = 0.005


class Lookups:
    """Reads the token file. All requests that arrive before a read starts share its result."""

    def __init__(self, vault: Vault) -> None:
        self._vault, self._lock = vault, asyncio.Lock()
        self._next: asyncio.Task[Sequence[Token]] | None = None
        self._read_s = -MIN_READ_INTERVAL_S

    async def read(self) -> Sequence[Token]:
        """Return the tokens, with all changes before this call.

        Raises `TimeoutError` if the disk hangs.
        """
        if self._next is None:
            self._next = shared(self._later())
        return await asyncio.shield(self._next)

    async def _later(self) -> Sequence[Token]:
        loop = asyncio.get_running_loop()
        async with self._lock:
            await asyncio.sleep(self._read_s + MIN_READ_INTERVAL_S - loop.time())
            self._next, self._read_s = None, loop.time()
            return await in_thread(self._vault.all, READ_TIMEOUT_S)


class Admission:
    """Checks each HTTP request, and refuses it or passes it to the handler of its route."""

    def __init__(
        self,
        robot: str,
        names: AbstractSet[str],
        vault: Vault,
        acceptor: Acceptor,
        counts: Counts,
        rules: WebConfig,
    ) -> None:
        self._local = AdmittedClient(rules.local, LOCAL_NAME)
        self._origins = frozenset(rules.origins)
        self._robot, self._names, self._vault = robot, names, vault
        self._acceptor, self._counts = acceptor, counts
        self._guesses, self._strangers = Buckets(GUESSES_OF_ONE, GUESSES), Buckets(STRANGER_RATE)
        self._paces: dict[Rate, Buckets] = {}
        self._lookups = Lookups(vault)
        self._rows: dict[web.AbstractRoute, Route] = {}

    def application(self, rows: Iterable[Route], page: object) -> web.Application:
        """Return the application that serves the routes; each handler gets `page` first."""
        app = web.Application(middlewares=[self._serve], client_max_size=MAX_MESSAGE_BYTES)
        app.on_response_prepare.append(secured)
        app.on_response_prepare.append(self._shared)
        for row in rows:
            for method in ("GET", "HEAD") if row.method == "GET" else (row.method,):
                added = app.router.add_route(method, row.pattern, partial(row.handler, page))
                self._rows[added] = row
        return app

    async def owner(self, peer: str, texts: Sequence[str]) -> AdmittedClient:
        """Return the owner of the first valid token.

        Raises `RequestRefusedError` if no token is valid, and `TimeoutError` if the disk hangs.
        """
        if not any(texts):
            raise RequestRefusedError(
                "no_token", "a token is missing: run `acsard web --invite ROLE` on the robot"
            )
        tokens = await self._lookups.read()
        now_s = self._vault.now_s()
        identity = next(filter(None, (owner_in(tokens, text, now_s) for text in texts)), None)
        # A valid token is accepted even if too many wrong tokens have arrived. So the guesses of
        # one client cannot lock out another client.
        if identity is not None:
            return replace(identity, address=peer)
        if not self._guesses.take(network_of(peer), clock.mono_ns()):
            raise RequestRefusedError("too_fast", "too many wrong tokens: wait a minute")
        raise RequestRefusedError(
            "bad_token",
            "this token is not valid (expired, revoked, or for another robot): ask for a new one",
        )

    @web.middleware
    async def _serve(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        self._acceptor.spoke(request.transport, request.content)
        try:
            if request.method == "OPTIONS" and self._listed(request):
                await self._pace_stranger(request)
                return self._preflight(request)
            waits = await self._admit(request, self._rows.get(request.match_info.route))
            # For a POST, delay only the answer, so that the server sends a stop immediately.
            if waits and request.method != "POST":
                await asyncio.sleep(REFUSAL_DELAY_S)
            answer = await handler(request)
            if waits and request.method == "POST":
                await asyncio.sleep(REFUSAL_DELAY_S)
            return answer
        except RequestRefusedError as error:
            if error.reason == "too_fast":
                await asyncio.sleep(REFUSAL_DELAY_S)
            elif IDENTITY_KEY not in request:
                await self._pace_stranger(request)
            self._counts.refuse(error.reason, _origin(request))
            answer = problem(STATUS_CODES.get(error.reason, 403), str(error))
            if error.reason == "too_many":
                # Close the TCP connection too. A client that retries in a loop would keep it.
                answer.force_close()
            return answer
        except TimeoutError:
            return problem(503, "the disk of this page's server does not answer: try again")
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

    async def _pace_stranger(self, request: web.Request) -> None:
        if not self._strangers.take(network_of(peer_of(request)), clock.mono_ns()):
            await asyncio.sleep(REFUSAL_DELAY_S)

    async def _admit(self, request: web.Request, row: Route | None) -> bool:
        facts = request_facts(request)
        here = place(facts, self._names | {own_address(request)}) == "here"
        is_open = row is not None and row.least is None
        listed = by_listed_page(facts, self._origins)
        if request.method not in ("GET", "HEAD") if is_open else not listed:
            require_own_origin(facts)
        if is_open:
            # A browser loads the files of the page over several connections before it requests a
            # path that needs a token. If such a request already contains a valid token, record the
            # client's identity, so that other clients cannot displace this connection.
            tokens = [] if here else tokens_shown(request, self._robot)
            if identity := next(filter(None, map(self._vault.find_owner, tokens)), None):
                self._acceptor.admitted(request.transport, identity)
            elif not here:
                await self._pace_stranger(request)
            return False
        identity = replace(self._local, address=facts.peer)
        if not here:
            # Accept cookies only from the robot's own page. A page in `web.origins` must send a
            # token.
            tokens = tokens_sent(request) if listed else tokens_shown(request, self._robot)
            identity = await self.owner(facts.peer, tokens)
        request[IDENTITY_KEY] = identity
        self._acceptor.admitted(request.transport, identity)
        fast = self._too_fast(identity, row)
        if fast and not (row and row.waits):
            text = (
                f"more than {REQUEST_RATE.hz:g} requests a second with one token: use the "
                "WebSocket /ws, which sends each change"
            )
            raise RequestRefusedError("too_fast", text)
        if row is not None and row.least is not None:
            identity.require(row.least, f"{row.method} {row.path}")
        return fast

    def _too_fast(self, identity: AdmittedClient, row: Route | None) -> bool:
        if not identity.token:
            return False  # clients on the robot itself have no rate limit
        rate, name = row.rate if row else REQUEST_RATE, identity.token
        if row and row.waits:
            name += f" {network_of(identity.address)}"
        return not self._paces.setdefault(rate, Buckets(rate)).take(name, clock.mono_ns())

    def _listed(self, request: web.Request) -> bool:
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

    async def _shared(self, request: web.Request, response: web.StreamResponse) -> None:
        if self._origins:
            vary = response.headers.get("Vary", "")
            response.headers["Vary"] = f"{vary}, Origin" if vary else "Origin"
        if self._listed(request):
            response.headers["Access-Control-Allow-Origin"] = request.headers["Origin"]
            response.headers["Access-Control-Expose-Headers"] = "ETag, Age-Ms, Waited-Ms"


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
