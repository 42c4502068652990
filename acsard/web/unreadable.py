"""Answers bytes on a connection that are not an HTTP request: refused with words and counted.

No handler of the application sees such bytes. Without this class aiohttp would answer with a bare
line and log a traceback for each.
"""

from __future__ import annotations

from typing import Any

from aiohttp import web
from aiohttp.web_protocol import RequestHandler

from acsard.web.answers import HEADERS, problem
from acsard.web.counts import Counts
from acsard.web.who import unmapped

NO_HOST = "there is no `Host` in it: which name of this robot do you ask?"

NO_REQUEST = "that is no HTTP request"

MISSING = "Missing 'Host'"
"""Start of aiohttp's message for a missing `Host` header."""


class Reader(RequestHandler):
    """Protocol handler of one connection."""

    def __init__(self, counts: Counts, server: Any) -> None:
        """Create a handler for `server`, which is the server of the application's runner."""
        super().__init__(server, loop=server._loop, **server._kwargs)
        self._counted = counts

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Answer unreadable bytes.

        Errors of the application (status 500 and above) stay with aiohttp.
        """
        if status >= 500:
            return super().handle_error(request, status, exc, message)
        nameless = (message or "").startswith(MISSING)
        peer = unmapped(request.remote or "")
        self._counted.refuse("host" if nameless else "malformed", peer)
        response = problem(status, NO_HOST if nameless else NO_REQUEST)
        response.headers.update(HEADERS)
        response.force_close()
        return response
