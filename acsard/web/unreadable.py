"""What comes on a connection and is no request at all: refused in words and counted, like the rest.

Nothing of ours sees it, since there is nothing to hand on: aiohttp would answer with a bare line,
and write a traceback for each into the log.
"""

from __future__ import annotations

from typing import Any

from aiohttp import web
from aiohttp.web_protocol import RequestHandler

from acsard.web.counts import Counts
from acsard.web.requests import HEADERS, problem
from acsard.web.who import unmapped

NO_HOST = "there is no `Host` in it: which name of this robot do you ask?"

NO_REQUEST = "that is no HTTP request"

MISSING = "Missing 'Host'"
"""So aiohttp says it."""


class Reader(RequestHandler):
    """Reads one connection."""

    def __init__(self, counts: Counts, server: Any) -> None:
        """`server` is that of the application's runner."""
        super().__init__(server, loop=server._loop, **server._kwargs)
        self._counted = counts

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """The answer to what could not be read; what went wrong here is aiohttp's to tell."""
        if status >= 500:
            return super().handle_error(request, status, exc, message)
        nameless = (message or "").startswith(MISSING)
        peer = unmapped(request.remote or "")
        self._counted.refuse("host" if nameless else "malformed", peer)
        response = problem(status, NO_HOST if nameless else NO_REQUEST)
        response.headers.update(HEADERS)
        response.force_close()
        return response
