"""The page's server as an aiohttp application: admission, routes and response headers.

Every request passes `_admit` first. `_admit` attaches the caller's identity (a `Who`) to the
request before a handler sees it. Only the paths in `OPEN` and the page's own files are served
without an identity, to any client that addresses the robot by one of its names.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

from aiohttp import web
from msgspec.structs import replace

from acsard.host import clock
from acsard.host.threads import in_thread
from acsard.web.calls import Calls
from acsard.web.commands import Hand
from acsard.web.counts import Counts
from acsard.web.files import PAGE, Files
from acsard.web.fleet import Fleet
from acsard.web.frames import MAX_BYTES
from acsard.web.gate import Gate
from acsard.web.guide import Guide
from acsard.web.limits import GUESSES, GUESSES_OF_ONE, REQUESTS, Buckets, Seats
from acsard.web.programs import READ_S, Programs, TroubleError
from acsard.web.reports import Reports
from acsard.web.requests import (
    STATUS,
    asked_of,
    body_of,
    keep_little,
    own_address,
    own_port,
    peer_of,
    problem,
    secured,
    sent,
    takes_gzip,
    token_posted,
    tokens_shown,
)
from acsard.web.robots import Robots
from acsard.web.tokens import Vault
from acsard.web.viewer import HEARTBEAT_S, Viewer
from acsard.web.who import MAINTAINER, Reason, Refusal, Who, cookie_name, foreign, place

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

OPEN = ("/", "/token", "/favicon.ico")
"""Paths that are served without a token: a browser must load the page before it can send one."""

UNHURRIED = ("/api/srv/stop", "/api/whoami", "/ws")
"""Paths that are exempt from the request rate limit.

A stop must always go through. A page that reconnects must not be kept out by another program that
uses the same token; `Seats` limits the number of connections instead.
"""

REASONS: dict[int, Reason] = {404: "path", 405: "path", 413: "too_big"}
"""Refusal reason per HTTP status that aiohttp raises by itself. Every other status counts as
`malformed`."""

WHO: web.RequestKey[Who | None] = web.RequestKey("who", object)  # type: ignore[arg-type]


class Page:
    """The application and the state that its request handlers share."""

    def __init__(
        self,
        robots: Robots,
        hand: Hand,
        calls: Calls,
        fleet: Fleet,
        counts: Counts,
        vault: Vault,
        names: frozenset[str],
        gate: Gate,
        guide: Guide,
        page: Path = PAGE,
    ) -> None:
        """Build the routes.

        `names` are the host names and addresses, in lower case, by which other machines reach the
        robot.
        """
        self._robots, self._hand, self._calls, self._fleet = robots, hand, calls, fleet
        self._guide = guide
        self._counts, self._vault, self._names, self._gate = counts, vault, names, gate
        self._files, self._reports = Files(page), Reports()
        self._programs = Programs(robots, calls, counts, self._reports)
        self._guesses, self._paces = Buckets(GUESSES_OF_ONE, GUESSES), Buckets(REQUESTS)
        self._seats = Seats()
        self._viewers: set[Viewer] = set()
        self.app = web.Application(middlewares=[self._admit], client_max_size=MAX_BYTES)
        self.app.on_response_prepare.append(secured)
        self.app.add_routes(
            [
                web.get("/", self._index),
                web.get("/favicon.ico", self._icon),
                web.get("/page/{name}", self._file),
                web.get("/ws", self._socket),
                web.post("/token", self._token),
                web.get("/api", self._api),
                web.get("/api/recordings", self._recordings),
                web.get("/api/recordings/{name}", self._recording),
                web.post("/api/recordings/{name}/report", self._draw),
                web.get("/report/{name}", self._report),
                web.get("/api/whoami", self._whoami),
                web.get("/api/settings", self._settings),
                web.get("/api/guide", self._guided),
                web.post("/api/srv/{verb}", self._service),
                web.get("/api/{key:.+}", self._value),
                web.get("/metrics", self._metrics),
            ]
        )

    @property
    def viewers(self) -> int:
        """Number of open WebSocket connections."""
        return len(self._viewers)

    def end_all(self, why: str) -> None:
        """End the report and every connection; `Viewer.end` also stops a robot that a viewer is
        driving.

        `why` is sent as the close reason, at most 120 characters.
        """
        self._reports.end()
        for viewer in list(self._viewers):
            viewer.end(why)

    async def tidy(self) -> None:
        """Drop expired work; the server calls this once a second.

        This ends the connection of each viewer whose token has expired, was revoked or cannot be
        looked up on disk within `READ_S`, and gives up a report that no client waits for.
        """
        self._reports.tidy()
        try:
            counting = await in_thread(self._vault.counting, READ_S)
        except TimeoutError:
            counting = frozenset()
        for viewer in list(self._viewers):
            if viewer.who.token and viewer.who.token not in counting:
                viewer.end("your token has ended")

    # Admission of requests.

    @web.middleware
    async def _admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        self._gate.spoke(request.transport)
        asked = asked_of(request)
        spot = place(asked, self._names | {own_address(request)})
        if isinstance(spot, Refusal):
            return self.refused(spot, asked.peer)
        acts = request.method not in ("GET", "HEAD") or request.path == "/ws"
        if acts or request.path.startswith(("/api", "/metrics", "/report")):
            strange = foreign(asked)
            if strange is not None:
                return self.refused(strange, asked.peer)
        here = replace(MAINTAINER, address=asked.peer)
        try:
            if request.path in OPEN or request.path.startswith("/page/"):
                request[WHO] = here if spot == "here" else None
            else:
                shown = tokens_shown(request, self._robots.id)
                who = here if spot == "here" else await self._known(asked.peer, shown)
                if isinstance(who, Refusal):
                    return self.refused(who, asked.peer)
                if self._hurries(request, who):
                    text = f"over {REQUESTS.hz:g} requests a second: /ws tells what changes"
                    return self.refused(Refusal("too_fast", text), who.origin)
                request[WHO] = who
            return await handler(request)
        except TimeoutError:
            return problem(503, "the disk does not answer")
        except TroubleError as trouble:
            return problem(trouble.status, str(trouble))
        except web.HTTPException as error:
            if error.status < 400:
                raise
            known = request.get(WHO)
            origin = asked.peer if known is None else known.origin
            self._counts.refuse(REASONS.get(error.status, "malformed"), origin)
            return problem(error.status, _WORDS.get(error.status, error.reason))

    def _hurries(self, request: web.Request, who: Who) -> bool:
        """Return whether the client exceeds its request rate.

        Clients on the robot itself are exempt.
        """
        if not who.token or request.path in UNHURRIED:
            return False
        return not self._paces.take(who.token, clock.mono_ns())

    async def _known(self, peer: str, shown: Sequence[str]) -> Who | Refusal:
        """Return the owner of the first valid token in `shown`, or a refusal.

        Raises `TimeoutError` if the disk does not answer within `READ_S`.
        """
        if not any(shown):
            return Refusal("no_token", "who are you? `acsard web --invite ROLE` at the robot")
        who = await in_thread(lambda: next(filter(None, map(self._vault.who, shown)), None), READ_S)
        # A valid token is accepted even while guessing is throttled, so another client's wrong
        # guesses lock nobody out.
        if who is not None:
            return replace(who, address=peer)
        if not self._guesses.take(peer, clock.mono_ns()):
            return Refusal("too_fast", "too many wrong tokens: wait a minute")
        return Refusal(
            "bad_token", "this token has ended, was revoked, is another robot's, or never was one"
        )

    def refused(self, why: Refusal, origin: str) -> web.Response:
        """Count the refusal, log it under `origin`, and return the error response."""
        self._counts.refuse(why.reason, origin)
        return problem(STATUS.get(why.reason, 403), why.text)

    async def _token(self, request: web.Request) -> web.StreamResponse:
        """Exchange a posted token for an `HttpOnly` cookie, which scripts cannot read."""
        text, peer = await token_posted(request), peer_of(request)
        if not request.secure:
            return self.refused(Refusal("plain", "here you need no token"), peer)
        who = await self._known(peer, [text])
        if isinstance(who, Refusal):
            return self.refused(who, peer)
        left_s = await in_thread(lambda: self._vault.left_s(who.token), READ_S)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(
            cookie_name(self._robots.id, own_port(request)), text, max_age=left_s, path="/",
            secure=True, httponly=True, samesite="Strict",
        )  # fmt: skip
        return response

    # The page and its files.

    async def _index(self, request: web.Request) -> web.StreamResponse:
        return await self._send(request, "index.html")

    async def _icon(self, request: web.Request) -> web.StreamResponse:
        return await self._send(request, "icon.svg")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        return await self._send(request, request.match_info["name"])

    async def _send(self, request: web.Request, name: str) -> web.StreamResponse:
        file = await in_thread(lambda: self._files.get(name), READ_S)
        if file is None:
            raise web.HTTPNotFound
        return sent(request, file)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        who, peer = _who(request), peer_of(request)
        if full := self._seats.enter(peer, who.token):
            answer = self.refused(Refusal("too_many", full), who.origin)
            # A client that retries in a loop must not keep its TCP connection either.
            answer.force_close()
            return answer
        try:
            served = web.WebSocketResponse(
                max_msg_size=MAX_BYTES, heartbeat=HEARTBEAT_S, compress=False
            )
            await served.prepare(request)
            keep_little(request)
            viewer = Viewer(
                served, request, who, self._robots, self._hand, self._calls, self._fleet,
                self._guide, self._counts,
            )  # fmt: skip
            self._viewers.add(viewer)
            try:
                await viewer.run()
            finally:
                self._viewers.discard(viewer)
        finally:
            self._seats.leave(peer, who.token)
        return served

    # The interface for programs.

    async def _api(self, request: web.Request) -> web.StreamResponse:
        return self._programs.described()

    async def _metrics(self, request: web.Request) -> web.StreamResponse:
        return self._programs.metrics(self.viewers)

    async def _whoami(self, request: web.Request) -> web.StreamResponse:
        who = _who(request)
        # A browser does not report to its page why a WebSocket was refused, so `full` reports it
        # here.
        full = self._seats.missing(peer_of(request), who.token)
        return web.json_response({"role": who.role, "name": who.name, "full": full})

    async def _settings(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.settings(_who(request))

    async def _guided(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.guide(_who(request), self._guide)

    async def _value(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.value(_who(request), request.match_info["key"])

    async def _service(self, request: web.Request) -> web.StreamResponse:
        body = await body_of(request)
        return await self._programs.call(_who(request), request.match_info["verb"], body)

    async def _recordings(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.listed()

    async def _recording(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.recording(_who(request), request.match_info["name"])

    async def _draw(self, request: web.Request) -> web.StreamResponse:
        return await self._programs.draw(_who(request), request.match_info["name"])

    async def _report(self, request: web.Request) -> web.StreamResponse:
        name, packed = request.match_info["name"], takes_gzip(request)
        return await self._programs.report(_who(request), name, packed)


def _who(request: web.Request) -> Who:
    who = request[WHO]
    assert who is not None, "it is not open to all"
    return who


_WORDS = {
    404: "there is no such thing here; GET /api lists what there is",
    413: f"over {MAX_BYTES} bytes",
}
