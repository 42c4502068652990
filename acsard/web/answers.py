"""The answers of the page's server: JSON, files, problems, and the headers of all of them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

import msgspec
from aiohttp import web

from acsard.core.values import AcsardError
from acsard.web.callers import Reason
from acsard.web.files import File
from acsard.web.routes import JSON, Problem

READ_S = 10.0
"""Time limit for reading from a disk."""

PIECE = 32768
"""Bytes that are handed to the network at once."""

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


POLICY = (
    "default-src 'self'; connect-src 'self'{connect}; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'self'"
)
"""Content security policy. A refused request may have a foreign Host, which must not be echoed."""


class TroubleError(AcsardError):
    """A request that cannot be fulfilled now or here, with its HTTP status and an explanation."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def reply(body: object, status: int = 200) -> web.Response:
    """Return an answer in JSON."""
    return web.Response(body=msgspec.json.encode(body), content_type=JSON, status=status)


def problem(status: int, text: str) -> web.Response:
    """Return an error response with an explanation."""
    return reply(Problem(text), status)


def sent(request: web.Request, file: File) -> web.Response:
    """Return a page file, or 304 if the browser has it. Compress it if the client supports gzip."""
    headers = {"ETag": file.tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    # Also with 304, because the browser then replaces the policy that it has kept with the file.
    headers["Content-Security-Policy"] = _policy(request, file.policy)
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    body = file.body
    if file.packed is not None and takes_gzip(request):
        body, headers["Content-Encoding"] = file.packed, "gzip"
    return web.Response(body=body, headers=headers | {"Content-Type": file.kind})


async def sent_in_pieces(
    request: web.Request, body: bytes, headers: Mapping[str, str], within: float
) -> web.StreamResponse:
    """Send a large body without a copy of it; cut the connection after `within` s."""
    if request.method == "HEAD":
        return web.Response(body=body, headers=headers)
    answer = web.StreamResponse(headers=headers)
    answer.content_length = len(body)
    try:
        async with asyncio.timeout(within):
            await answer.prepare(request)
            for begin in range(0, len(body), PIECE):
                await answer.write(memoryview(body)[begin : begin + PIECE])
    except TimeoutError:
        if request.transport is not None:
            request.transport.abort()
    except ConnectionError:
        pass  # the client has gone; aiohttp notices
    return answer


def takes_gzip(request: web.Request) -> bool:
    """Return whether the client accepts gzip."""
    return "gzip" in request.headers.get("Accept-Encoding", "")


async def secured(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to an answer. A file and a report have their own policy."""
    response.headers.update(HEADERS)
    policy = _policy(request) if response.status < 400 else POLICY.format(connect="")
    response.headers.setdefault("Content-Security-Policy", policy)
    response.headers.setdefault("Cache-Control", "no-store")


def _policy(request: web.Request, more: str = "") -> str:
    """Return the policy for an admitted request, with the directives `more`.

    Browsers before 2022 do not apply 'self' to ws:// URLs, so the host is written out.
    """
    host = request.headers.get("Host", "")
    return POLICY.format(connect=f" ws://{host} wss://{host}") + more
