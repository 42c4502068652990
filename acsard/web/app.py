"""The request handlers of the page's server, and the table of all its paths (`ROUTES`).

A handler raises `RequestRefusedError` if the request itself is wrong or forbidden, and
`TroubleError` if a permitted request cannot be fulfilled now.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from typing import Any

import msgspec
from aiohttp import web
from msgspec import UNSET, Struct, UnsetType, inspect

from acsard import __version__
from acsard.bus.zenoh_sessions import MAX_MESSAGE_BYTES
from acsard.core.config.live import WHEN_TEXTS, find_live_setting, flat
from acsard.core.config.settings import WebConfig
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.permissions import least_role
from acsard.core.ros.parameters import kind_of
from acsard.core.values import Role
from acsard.host import clock
from acsard.host.errors import MendableError, NoAnswerError
from acsard.web import metrics, openapi
from acsard.web.access import IDENTITY_KEY, Access, connection_of, own_port, peer_of
from acsard.web.answers import File, TroubleError, file_answer, page_files, reply
from acsard.web.callers import PROTOCOL, RequestRefusedError, cookie_name, tokens_offered
from acsard.web.camera import Camera
from acsard.web.connections import Connections
from acsard.web.manual import MISSING, manual_files
from acsard.web.recordings import BlackBox, Recording
from acsard.web.routes import JSON, RECORDINGS_ROLE, Body, Problem, Route, services, values
from acsard.web.streams import as_json
from acsard.web.tokens import ReadTokens
from acsard.web.viewer import PING_INTERVAL_S, Parts, Viewer

# Most bodies have a few hundred bytes.
BODY_TIMEOUT_S = 5.0


class TokenForm(Struct, frozen=True):
    """The token of an invitation, which the browser gets back as a cookie.

    If `replace` is true, this cookie may replace a cookie whose token has more permissions.
    """

    token: str
    replace: bool = False


class Caller(Struct, frozen=True):
    """The role and the name of the caller."""

    role: Role
    name: str


class Setting(Struct, frozen=True, omit_defaults=True):
    """One setting of the robot: its key, value, explanation and allowed values."""

    key: str
    value: Any
    what: str
    when: str
    unit: str = ""
    low: float | UnsetType = UNSET
    high: float | UnsetType = UNSET
    choices: list[str] | UnsetType = UNSET


class Page:
    """The request handlers of the robot's page, and the data that they share.

    `names` are the robot's host names and addresses, in lower case.
    """

    def __init__(
        self,
        parts: Parts,
        tokens: ReadTokens,
        names: AbstractSet[str],
        connections: Connections,
        rules: WebConfig,
    ) -> None:
        self._parts, self._tokens, self._connections = parts, tokens, connections
        self._robot, self._files, self._manual = parts.robot, page_files(), manual_files()
        self._box = BlackBox(parts.robot)
        self._camera = Camera(rules.camera)
        self._has_camera = bool(rules.camera)
        self._viewers: set[Viewer] = set()
        self._access = Access(parts.robot.id, names, tokens, connections, rules)
        self.app = self._access.application(ROUTES, self)

    def end_all(self, why: str) -> None:
        """End every WebSocket for a reason (120 characters at most), and the camera."""
        self._camera.close()
        for viewer in list(self._viewers):
            viewer.end(why)

    def tidy(self) -> None:
        """End the connections whose token is not valid any more. Call this once a second."""
        for token in self._connections.tokens():
            if not self._tokens.left_s(token):
                why = "your token has expired or was revoked: ask for a new one"
                self._connections.end(token, why)

    # The page and its files.

    async def index(self, request: web.Request) -> web.StreamResponse:
        return _send(request, self._files, "index.html")

    async def icon(self, request: web.Request) -> web.StreamResponse:
        return _send(request, self._files, "icon.svg")

    async def file(self, request: web.Request) -> web.StreamResponse:
        return _send(request, self._files, request.match_info["name"])

    async def manual_place(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPFound("/docs/")  # the links of a page are relative to its directory

    async def manual(self, request: web.Request) -> web.StreamResponse:
        if not self._manual:
            return web.Response(status=404, body=MISSING, content_type="text/html")
        name = request.match_info["file"] or "index.html"
        if f"{name}.html" in self._manual:
            raise web.HTTPFound(f"/docs/{name}.html")
        return _send(request, self._manual, name)

    async def token(self, request: web.Request) -> web.StreamResponse:
        """Return the token of the body in a cookie that no script can read.

        Raises `TroubleError` if the cookie would replace one with more permissions, unless
        `replace` is true.
        """
        form = await _token_posted(request)
        if not request.secure:
            raise RequestRefusedError(
                "plain", "over plain http, no token is needed: connect without one"
            )
        identity = await self._access.owner(peer_of(request), [form.token])
        cookie = cookie_name(self._robot.id, own_port(request))
        old_token = "" if form.replace else request.cookies.get(cookie, "")
        present = self._tokens.owner([old_token])
        if present is not None and not identity.may(present.role):
            raise TroubleError(
                409,
                f"this browser is already signed in as {present.name} ({present.role}); the link "
                f"would sign it in as {identity.name} ({identity.role}), with fewer permissions",
            )
        left_s = self._tokens.left_s(identity.token)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(
            cookie, form.token, max_age=left_s, path="/", secure=True, httponly=True,
            samesite="Strict",
        )  # fmt: skip
        return response

    async def socket(self, request: web.Request) -> web.StreamResponse:
        identity = request[IDENTITY_KEY]
        offered = request.headers.get("Sec-WebSocket-Protocol", "")
        if tokens_offered(offered) and PROTOCOL not in map(str.strip, offered.split(",")):
            # If aiohttp knew none of the offered names, it would log all of them, and so the token.
            raise RequestRefusedError(
                "malformed",
                f"the WebSocket must offer the subprotocol {PROTOCOL} besides the token",
            )
        served = web.WebSocketResponse(
            max_msg_size=MAX_MESSAGE_BYTES,
            heartbeat=PING_INTERVAL_S,
            compress=False,
            protocols=[PROTOCOL],
            autoping=False,  # `Viewer` limits the rate of pings too
        )
        await served.prepare(request)
        _limit_buffer(request)
        viewer = Viewer(served, request, identity, self._parts, camera=self._has_camera)
        connection_of(request).become_socket(viewer.end)
        self._viewers.add(viewer)
        try:
            await viewer.run()
        finally:
            self._viewers.discard(viewer)
        return served

    # The interface for programs.

    async def api(self, request: web.Request) -> web.StreamResponse:
        return web.Response(body=OPENAPI_DOCUMENT, content_type=JSON)

    async def metrics(self, request: web.Request) -> web.StreamResponse:
        robot, counts = self._robot, self._parts.counts
        body = metrics.text(
            robot.id, robot.about.version, robot.state, not robot.gone, len(self._viewers),
            counts.all(), counts.refused(),
        )  # fmt: skip
        return web.Response(body=body, headers={"Content-Type": metrics.CONTENT_TYPE})

    async def whoami(self, request: web.Request) -> web.StreamResponse:
        identity = request[IDENTITY_KEY]
        return reply(Caller(identity.role, identity.name))

    async def value(self, request: web.Request) -> web.StreamResponse:
        return reply(msgspec.Raw(await self._value(request.path.removeprefix("/api/"))))

    async def settings(self, request: web.Request) -> web.StreamResponse:
        return reply(settings_in(msgspec.json.decode(await self._value("config"))))

    async def service(self, request: web.Request) -> web.StreamResponse:
        """Call the robot's service of the path, with the JSON object of the body."""
        verb, call = request.path.removeprefix("/api/srv/"), self._parts.calls.call
        # A stop has no arguments, so it does not wait for a body.
        arguments = {} if verb == "stop" else await _arguments_in(request)
        answer = await call(request[IDENTITY_KEY], verb, arguments)
        return reply(answer, 200 if answer.success else 409)

    async def picture(self, request: web.Request) -> web.StreamResponse:
        """Return a picture that the client does not have, or 304 if none comes in time."""
        etag = request.headers.get("If-None-Match", "").strip('"')
        begun_ns = clock.steady_ns()
        number = int(etag) if etag.isdecimal() and len(etag) < 16 else 0
        picture = await self._camera.after(number)
        if picture is None:
            return web.Response(status=304)
        _limit_buffer(request)
        headers = {
            "Content-Type": "image/jpeg",
            "Content-Length": str(len(picture.body)),
            "ETag": f'"{picture.number}"',
            "Age-Ms": str((clock.steady_ns() - picture.at_ns) // 1_000_000),
            "Waited-Ms": str((clock.steady_ns() - begun_ns) // 1_000_000),
        }
        return web.Response(body=picture.pieces(), headers=headers)

    async def recordings(self, request: web.Request) -> web.StreamResponse:
        return reply(await self._box.rows())

    async def recording(self, request: web.Request) -> web.StreamResponse:
        path = await self._box.find(request.match_info["name"])
        disposition = {"Content-Disposition": f'attachment; filename="{path.name}"'}
        return web.FileResponse(
            path, headers=disposition | {"Content-Type": "application/octet-stream"}
        )

    async def _value(self, key: str) -> bytes:
        try:
            return as_json(*await self._parts.calls.get(key))
        except NoAnswerError as error:
            # Without a daemon, the reason why in a plain sentence.
            raise TroubleError(504, self._robot.gone or str(error)) from None
        except (MendableError, DecodeError, TimeoutError) as error:
            raise TroubleError(
                503, str(error) or "the robot did not answer in time: try again"
            ) from None


def _send(request: web.Request, files: Mapping[str, File], name: str) -> web.StreamResponse:
    file = files.get(name)
    if file is None:
        raise web.HTTPNotFound
    return file_answer(request, file)


def settings_in(config: Mapping[str, Any]) -> list[Setting]:
    """Return the settings that may change while the daemon runs."""
    return [
        Setting(key, value, setting.what, WHEN_TEXTS[setting.when], **_described(key))
        for key, value in flat(config)
        if (setting := find_live_setting(key)) is not None
    ]


def _described(key: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    kind = kind_of(key)
    if isinstance(kind, inspect.Metadata):
        found["unit"] = (kind.extra or {}).get("unit", "")
        kind = kind.type
    match kind:
        case inspect.FloatType(ge=float(low), le=float(high)):
            return found | {"low": low, "high": high}
        case inspect.LiteralType(values=choices):
            return found | {"choices": [str(choice) for choice in choices]}
    return found


async def _body_of(request: web.Request) -> bytes:
    try:
        async with asyncio.timeout(BODY_TIMEOUT_S):
            return await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout(
            reason=f"no body arrived within {BODY_TIMEOUT_S:g} s"
        ) from None
    except (web.RequestPayloadError, ConnectionError):
        raise RequestRefusedError(
            "malformed", "the body is not valid HTTP, or the connection ended before its end"
        ) from None


async def _arguments_in(request: web.Request) -> dict[str, Any]:
    body = await _body_of(request)
    try:
        return msgspec.json.decode(body, type=dict[str, Any]) if body.strip() else {}
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise RequestRefusedError("malformed", f"the body must be a JSON object: {error}") from None


async def _token_posted(request: web.Request) -> TokenForm:
    try:
        return msgspec.json.decode(await _body_of(request), type=TokenForm)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise RequestRefusedError("malformed", "send the token as JSON") from None


def _limit_buffer(request: web.Request) -> None:
    at = None if request.transport is None else request.transport.get_extra_info("socket")
    if at is not None:
        # In a larger send buffer of the kernel, data would wait until it is outdated.
        at.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)


ROUTES: tuple[Route, ...] = (
    Route("GET", "/", None, Page.index),
    Route("GET", "/favicon.ico", None, Page.icon),
    Route("GET", "/page/{name}", None, Page.file),
    Route("GET", "/docs", None, Page.manual_place),
    Route("GET", "/docs/{file}", None, Page.manual),
    Route("POST", "/token", None, Page.token,
        "exchanges a token for a cookie that no script can read; only over HTTPS",
        takes=TokenForm,
        gives={303: Body("The token is valid. The header `Location` leads to the page.", media=""),
               409: Body("The browser has a cookie with more permissions; `replace` overwrites it.",
                         Problem)}),
    Route("GET", "/ws", "viewer", Page.socket,
        "a WebSocket that carries JSON text both ways, to follow Zenoh keys, to drive and to stop",
        gives={101: Body("The WebSocket is open.", media="")}),
    Route("GET", "/api", "viewer", Page.api, "this document", gives={200: Body("OpenAPI 3.1.")}),
    Route("GET", "/api/whoami", "viewer", Page.whoami, "the caller's role and name",
        gives={200: Body("The caller.", Caller)}),
    Route("GET", "/api/settings", least_role("config"), Page.settings,
        "the settings that srv/set accepts: values, ranges, and whether each may change while the "
        "robot moves",
        gives={200: Body("A list.", list[Setting])}),
    Route("GET", "/api/camera", "viewer", Page.picture,
        "the newest picture of the camera; the headers give its age (`Age-Ms`) and how long the "
        "request waited here (`Waited-Ms`), in ms; a request that has the last picture's `ETag` "
        "as `If-None-Match` waits up to a second for a newer picture",
        gives={200: Body("A picture.", str, "image/jpeg"),
               304: Body("There is no newer picture.", media="")}),
    Route("GET", "/api/recordings", "viewer", Page.recordings,
        "the recordings of the black box, oldest first",
        gives={200: Body("A list.", list[Recording])}),
    Route("GET", "/api/recordings/{name}", RECORDINGS_ROLE, Page.recording,
        "one recording as a file",
        gives={200: Body("A file.", media="application/octet-stream")}),
    *values(Page.value),
    *services(Page.service),
    Route("GET", "/metrics", "viewer", Page.metrics,
        "the robot's state, counters and latencies as metrics for Prometheus",
        gives={200: Body("Text.", str, "text/plain")}),
)  # fmt: skip

OPENAPI_DOCUMENT = msgspec.json.encode(openapi.document(__version__, ROUTES))
