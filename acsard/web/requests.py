"""Reads a request's address, host and token, and sets the security headers of every answer."""

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
"""Pattern of a valid `Host` header. It is strict because the value is copied into a response
header."""

PROXIES = ("forwarded", "x-forwarded-", "x-real-ip", "via")
"""Prefixes of the headers that a proxy adds when it forwards a request."""

NO_TOKEN = "a token is to be posted as a form, token=..., or as JSON, both in UTF-8"

STATUS: dict[Reason, int] = {
    "no_token": 401,
    "bad_token": 401,
    "too_fast": 429,
    "too_many": 503,
    "path": 404,
    "malformed": 400,
}
"""HTTP status for each refusal reason; every other reason gives 403."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Server": "acsard",
}
"""Headers of every answer."""

BODY_S = 5.0
"""Time limit for a body of a few hundred bytes. A client that withholds its body occupies a
connection."""

SEND_BUFFER = 65536
"""Size of the kernel's send buffer for one client. A larger buffer would deliver stale data."""


def asked_of(request: web.Request) -> Asked:
    """Return the facts of a request that decide about its admission, none of them trusted yet."""
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
    """Return the address of the client."""
    return unmapped(request.remote or "")


def problem(status: int, text: str) -> web.Response:
    """Return an error response with an explanation."""
    return web.json_response({"error": text}, status=status)


def own_address(request: web.Request) -> str:
    """Return the local address that the client connected to.

    Unlike a host name, it cannot be forged.
    """
    return unmapped(_reached(request)[0].lower())


def own_port(request: web.Request) -> int:
    """Return the local port that the client connected to."""
    return _reached(request)[1]


def _reached(request: web.Request) -> tuple[str, int]:
    at = None if request.transport is None else request.transport.get_extra_info("sockname")
    return (str(at[0]), int(at[1])) if at else ("", 0)


def tokens_shown(request: web.Request, robot: str) -> list[str]:
    """Return a program's bearer token, or a browser's cookie tokens, the likeliest first."""
    kind, _, text = request.headers.get("Authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return [text.strip()]
    return tokens_in(request.cookies, robot, own_port(request))


async def body_of(request: web.Request) -> bytes:
    """Return the whole body; raise `HTTPRequestTimeout` if it does not arrive within `BODY_S`."""
    try:
        async with asyncio.timeout(BODY_S):
            return await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason=f"no body came within {BODY_S:g} s") from None


async def token_posted(request: web.Request) -> str:
    """Return the token in a form or in JSON, or "" if it is missing; raises `HTTPBadRequest`."""
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
    """Return a page file, or 304 if the browser has it. Compress it if the client supports gzip."""
    headers = {"ETag": file.tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    body = file.body
    if file.packed is not None and takes_gzip(request):
        body, headers["Content-Encoding"] = file.packed, "gzip"
    return web.Response(body=body, headers=headers | {"Content-Type": file.kind})


def takes_gzip(request: web.Request) -> bool:
    """Return whether the client accepts gzip."""
    return "gzip" in request.headers.get("Accept-Encoding", "")


def keep_little(request: web.Request) -> None:
    """Limit the kernel's send buffer of this connection."""
    at = None if request.transport is None else request.transport.get_extra_info("socket")
    if at is not None:
        at.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)


async def secured(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to an answer."""
    host = request.headers.get("Host", "")
    # Browsers before 2022 do not apply 'self' to ws:// URLs, so the host is written out. A refused
    # request may have a foreign Host, which must not be echoed.
    connect = f" ws://{host} wss://{host}" if response.status < 400 else ""
    policy = (
        f"default-src 'self'; connect-src 'self'{connect}; frame-ancestors 'none'; "
        "base-uri 'none'; form-action 'self'"
    )
    response.headers.update(HEADERS)
    response.headers.setdefault("Content-Security-Policy", policy)  # a report sets its own
    response.headers.setdefault("Cache-Control", "no-store")
