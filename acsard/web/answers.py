"""The HTTP answers of the page's server: JSON, files, errors, and the headers of all answers.

The script of the STOP button and the style sheet are sent inside `index.html`, so STOP works even
if another file is late or never arrives.
"""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from aiohttp import web
from msgspec import Struct

from acsard.core.values import AcsardError
from acsard.web.callers import Reason
from acsard.web.routes import JSON, Problem

READ_TIMEOUT_S = 10.0
"""Time limit for reading from a disk, s."""

PIECE_BYTES = 32768
"""Size of the pieces in which a large body is written to the network, bytes."""

STATUS_CODES: dict[Reason, int] = {
    "no_token": 401,
    "bad_token": 401,
    "too_fast": 429,
    "too_many": 503,
    "path": 404,
    "malformed": 400,
}
"""HTTP status of the answer to a refused request, by the reason of the refusal. The status is 403
for any other reason."""

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
"""Content security policy of every answer. The server replaces `{connect}` with the
page's WebSocket URLs. The policy of an error answer does not contain these URLs, so the server
never copies a forged `Host` header into an answer."""


class TroubleError(AcsardError):
    """A permitted request cannot be fulfilled now. `status` is the HTTP status of the answer."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def reply(body: object, status: int = 200) -> web.Response:
    """Return an HTTP answer with `body` as JSON."""
    return web.Response(body=msgspec.json.encode(body), content_type=JSON, status=status)


def problem(status: int, text: str) -> web.Response:
    return reply(Problem(text), status)


def file_answer(request: web.Request, file: File) -> web.Response:
    """Return the answer that contains a file of the page, compressed if the client accepts gzip.

    If the client already has this version of the file, return an answer with the status 304.
    """
    headers = {"ETag": file.tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    # An answer with the status 304 contains the policy too, because the browser uses it in place of
    # the policy that it has stored with the file.
    headers["Content-Security-Policy"] = _policy(request, file.policy)
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    body = file.body
    if file.packed is not None and "gzip" in request.headers.get("Accept-Encoding", ""):
        body, headers["Content-Encoding"] = file.packed, "gzip"
    return web.Response(body=body, headers=headers | {"Content-Type": file.kind})


async def sent_in_pieces(
    request: web.Request, body: bytes, headers: Mapping[str, str], within: float
) -> web.StreamResponse:
    """Send a large body in pieces, without copying it, and return the answer.

    If sending takes longer than `within` s, cut the connection. For a HEAD request, send no body.
    """
    if request.method == "HEAD":
        return web.Response(body=body, headers=headers)
    answer = web.StreamResponse(headers=headers)
    answer.content_length = len(body)
    try:
        async with asyncio.timeout(within):
            await answer.prepare(request)
            for begin in range(0, len(body), PIECE_BYTES):
                await answer.write(memoryview(body)[begin : begin + PIECE_BYTES])
    except TimeoutError:
        cut(request.transport)
    except ConnectionError:
        pass  # the client has gone; aiohttp notices
    return answer


def cut(transport: asyncio.BaseTransport | None) -> None:
    """Abort a connection without waiting for the client. Do nothing if `transport` is None.

    On Python 3.11.2, a TLS connection that was closed twice cannot be aborted. Such a connection
    ends at the time limit of its TLS shutdown.
    """
    if transport is None:
        return
    try:
        transport.abort()  # type: ignore[attr-defined]
    except AttributeError:
        # After a second close, the transport has lost its TLS protocol. Python 3.11.2 then raises
        # this error. Later versions do nothing.
        if not transport.is_closing():
            raise


async def secured(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to an answer.

    An answer that has a content security policy already, such as a file, keeps it.
    """
    response.headers.update(HEADERS)
    policy = _policy(request) if response.status < 400 else POLICY.format(connect="")
    response.headers.setdefault("Content-Security-Policy", policy)
    response.headers.setdefault("Cache-Control", "no-store")


def _policy(request: web.Request, more: str = "") -> str:
    # Browsers before 2022 do not apply 'self' to ws:// URLs, so the host is written out.
    host = request.headers.get("Host", "")
    return POLICY.format(connect=f" ws://{host} wss://{host}") + more


PAGE_DIRECTORY = Path(__file__).parent / "page"

CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
}
"""Content type of a page file, by file suffix. The server sends no file with any other suffix."""

INLINED = {
    "index.html": {
        "stop.js": (b'<script src="page/stop.js"></script>', "script"),
        "style.css": (b'<link rel="stylesheet" href="page/style.css">', "style"),
    }
}
"""Maps the name of a page file to the files whose text the server inserts into it.

The inner dict maps the name of each inserted file to a pair: the HTML element that loads the file,
and the tag of the HTML element with the text of the file. The server replaces the first element
with the second.
"""


class File(Struct, frozen=True):
    """A file of the page in the form in which it is sent."""

    kind: str
    body: bytes
    packed: bytes | None
    """The body in gzip form, or None if gzip does not make it shorter."""
    tag: str
    policy: str
    """Directives that are appended to the content security policy `POLICY`. They allow the scripts
    and styles of the files that are included in this file (see `INLINED`)."""
    stamp: tuple[tuple[int, int], ...]
    """Pairs of modification time, ns, and size, bytes. The first pair belongs to this file, and the
    others to the files that are included in it."""


class Files:
    """Cache of the page's files. A file is read again when it has changed on the disk."""

    def __init__(self, directory: Path = PAGE_DIRECTORY) -> None:
        self._directory = directory
        self._files: dict[str, File] = {}

    def get(self, name: str) -> File | None:
        """Return the file `name`, or None if it does not exist, is unreadable or may not be sent.

        A file may be sent if its suffix is in `CONTENT_TYPES`, its name does not begin with a dot
        and contains no directory, and the file is not a symbolic link.
        """
        kind = CONTENT_TYPES.get(Path(name).suffix)
        if kind is None or "/" in name or name.startswith("."):
            return None
        paths = [self._directory / entry for entry in (name, *INLINED.get(name, ()))]
        try:
            if any(path.is_symlink() or not path.is_file() for path in paths):
                return None
            stats = [path.stat() for path in paths]
            stamp = tuple((entry.st_mtime_ns, entry.st_size) for entry in stats)
            known = self._files.get(name)
            if known is None or known.stamp != stamp:
                known = self._files[name] = _load_file(paths, kind, stamp)
        except (OSError, ValueError):
            return None
        return known


def _load_file(paths: Sequence[Path], kind: str, stamp: tuple[tuple[int, int], ...]) -> File:
    """Read a file of the page, and insert the files that `INLINED` lists for it.

    The first path belongs to the file itself, and the other paths to the inserted files.
    """
    whole, *parts = paths
    body, policy = whole.read_bytes(), ""
    for part in parts:
        source, (loads, element) = part.read_bytes(), INLINED[whole.name][part.name]
        body = body.replace(loads, f"<{element}>".encode() + source + f"</{element}>".encode())
        digest = base64.b64encode(hashlib.sha256(source).digest()).decode()
        policy += f"; {element}-src 'self' 'sha256-{digest}'"
    # Compression does not pay for a small file.
    packed = gzip.compress(body, mtime=0) if len(body) >= 1000 else body
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    return File(kind, body, packed if len(packed) < len(body) else None, tag, policy, stamp)
