"""What a request shows of who sends it, and the headers that keep other pages out of ours."""

from __future__ import annotations

import asyncio
import re
import socket
from urllib.parse import parse_qsl

import msgspec
from aiohttp import web

from acsard.web.files import File
from acsard.web.who import Asked, Reason, tokens_in, unmapped

HOST = re.compile(r"([A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(:[0-9]{1,5})?")
"""What a browser writes into `Host`; it is written back into a header."""

PROXIES = ("forwarded", "x-forwarded-", "x-real-ip", "via")
"""How the headers begin by which a proxy says that it hands on what another asked."""

NO_TOKEN = "a token is to be posted as a form, token=..., or as JSON, both in UTF-8"

STATUS: dict[Reason, int] = {
    "no_token": 401,
    "bad_token": 401,
    "too_fast": 429,
    "too_many": 503,
    "path": 404,
    "malformed": 400,
}
"""403 for all others."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Server": "acsard",
}
"""What every answer has."""

BODY_S = 5.0
"""For a body of a few hundred bytes; who keeps it keeps a place that others wait for."""

SEND_BUFFER = 65536
"""Of the kernel, for one client: what lies in it is old when it arrives."""


def asked_of(request: web.Request) -> Asked:
    """What is known of it before anything in it is believed."""
    hosts = request.headers.getall("Host", [])
    return Asked(
        peer_of(request),
        request.secure,
        hosts[0] if len(hosts) == 1 and HOST.fullmatch(hosts[0]) else "",
        request.headers.get("Origin"),
        request.headers.get("Sec-Fetch-Site"),
        any(name.lower().startswith(PROXIES) for name in request.headers),
    )


def peer_of(request: web.Request) -> str:
    """The address it comes from."""
    return unmapped(request.remote or "")


def problem(status: int, text: str) -> web.Response:
    """What was wrong, in words."""
    return web.json_response({"error": text}, status=status)


def own_address(request: web.Request) -> str:
    """The address of ours that the client has reached: no name that somebody points here."""
    return unmapped(_reached(request)[0].lower())


def own_port(request: web.Request) -> int:
    """The port of ours that it has reached."""
    return _reached(request)[1]


def _reached(request: web.Request) -> tuple[str, int]:
    at = None if request.transport is None else request.transport.get_extra_info("sockname")
    return (str(at[0]), int(at[1])) if at else ("", 0)


def tokens_shown(request: web.Request, robot: str) -> list[str]:
    """The token in the header of a program, or those in the cookies of a browser that may be for
    the page of this robot, the likeliest first."""
    kind, _, text = request.headers.get("Authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return [text.strip()]
    return tokens_in(request.cookies, robot, own_port(request))


async def body_of(request: web.Request) -> bytes:
    """All of it; raises `HTTPRequestTimeout` for who announces one and keeps it."""
    try:
        async with asyncio.timeout(BODY_S):
            return await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason=f"no body came within {BODY_S:g} s") from None


async def token_posted(request: web.Request) -> str:
    """The token in a form or in JSON, "" where there is none; raises `HTTPBadRequest`."""
    body = await body_of(request)
    try:
        text = body.decode(request.charset or "utf-8")
        if request.content_type == "application/json":
            return msgspec.json.decode(text, type=dict[str, str]).get("token", "")
        if request.content_type == "application/x-www-form-urlencoded":
            return dict(parse_qsl(text, errors="strict", max_num_fields=10)).get("token", "")
    except (msgspec.MsgspecError, ValueError, LookupError):
        pass
    raise web.HTTPBadRequest(reason=NO_TOKEN)


def sent(request: web.Request, file: File) -> web.Response:
    """A file of the page's, unless the browser has it; packed where it takes that."""
    headers = {"ETag": file.tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    body = file.body
    if file.packed is not None and takes_gzip(request):
        body, headers["Content-Encoding"] = file.packed, "gzip"
    return web.Response(body=body, headers=headers | {"Content-Type": file.kind})


def takes_gzip(request: web.Request) -> bool:
    """The client unpacks it by itself."""
    return "gzip" in request.headers.get("Accept-Encoding", "")


def keep_little(request: web.Request) -> None:
    """Let the kernel hold little for a client that does not read."""
    at = None if request.transport is None else request.transport.get_extra_info("socket")
    if at is not None:
        at.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)


async def secured(request: web.Request, response: web.StreamResponse) -> None:
    """The headers that every answer has."""
    host = request.headers.get("Host", "")
    # A browser of before 2022 does not take 'self' for ws too; a Host that is none of ours is
    # refused, and not written back.
    connect = f" ws://{host} wss://{host}" if response.status < 400 else ""
    policy = (
        f"default-src 'self'; connect-src 'self'{connect}; frame-ancestors 'none'; "
        "base-uri 'none'; form-action 'self'"
    )
    response.headers.update(HEADERS)
    response.headers.setdefault("Content-Security-Policy", policy)  # a report has its own
    response.headers.setdefault("Cache-Control", "no-store")
