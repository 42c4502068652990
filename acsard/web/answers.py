"""The HTTP answers of the page's server: JSON, files, errors, and the headers of all answers.

The script of the STOP button and the style sheet are sent inside `index.html`, so STOP works even
if another file is late or never arrives.
"""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
from contextlib import suppress
from pathlib import Path

import msgspec
from aiohttp import web
from msgspec import Struct

from acsard.core.values import AcsardError
from acsard.web.callers import Reason
from acsard.web.routes import JSON, Problem

# By the reason of a refusal; 403 for any other one.
STATUS_CODES: dict[Reason, int] = {
    "no_token": 401,
    "bad_token": 401,
    "too_fast": 429,
    "too_many": 503,
    "path": 404,
    "malformed": 400,
}

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Server": "acsard",
}


# `{connect}` becomes the page's WebSocket URLs, but not in an error answer, so the server never
# copies a forged `Host` header.
POLICY = (
    "default-src 'self'; connect-src 'self'{connect}; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'self'"
)


class TroubleError(AcsardError):
    """A permitted request cannot be fulfilled now. `status` is the HTTP status of the answer."""

    def __init__(self, status: int, text: str, detail: str = "") -> None:
        super().__init__(text)
        self.status, self.detail = status, detail


def reply(body: object, status: int = 200) -> web.Response:
    return web.Response(body=msgspec.json.encode(body), content_type=JSON, status=status)


def problem(status: int, text: str, detail: str = "") -> web.Response:
    return reply(Problem(text, detail), status)


def file_answer(request: web.Request, file: File) -> web.Response:
    """Return a file, as gzip if the client takes it, or 304 if it has this version.

    The latter contains the policy too, because the browser uses it in place of the policy that it
    has stored with the file.
    """
    headers = {
        "ETag": file.tag,
        "Cache-Control": "no-cache",
        "Vary": "Accept-Encoding",
        "Content-Security-Policy": _policy(request, file.policy),
    }
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        body, headers["Content-Encoding"] = file.packed, "gzip"
    else:
        body = gzip.decompress(file.packed)
    return web.Response(body=body, headers=headers | {"Content-Type": file.kind})


def cut(transport: asyncio.BaseTransport | None) -> None:
    """Abort a connection without waiting for the client.

    On Python 3.11.2, a TLS connection that was closed twice ends only at the time limit of its TLS
    shutdown.
    """
    # After a second close, the transport has lost its TLS protocol. Python 3.11.2 then raises this
    # error. Later versions do nothing.
    with suppress(AttributeError):
        if transport is not None:
            transport.abort()  # type: ignore[attr-defined]


def unsent_bytes(transport: asyncio.BaseTransport | None) -> int:
    """Return how many bytes wait for the client; 0 for a TLS connection that was closed twice."""
    with suppress(AttributeError):  # as in `cut`, on all versions of Python
        if transport is not None:
            return int(transport.get_write_buffer_size())  # type: ignore[attr-defined]
    return 0


async def secured(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to an answer; a file keeps its own content security policy."""
    response.headers.update(HEADERS)
    policy = _policy(request) if response.status < 400 else POLICY.format(connect="")
    response.headers.setdefault("Content-Security-Policy", policy)
    response.headers.setdefault("Cache-Control", "no-store")


def _policy(request: web.Request, more: str = "") -> str:
    # Browsers before 2022 do not apply 'self' to ws:// URLs, so the host is written out.
    host = request.headers.get("Host", "")
    return POLICY.format(connect=f" ws://{host} wss://{host}") + more


PAGE_DIRECTORY = Path(__file__).parent / "page"

# The server sends no file with another suffix.
CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
}

# Files whose text is inserted into a file: the element that loads each, and the tag to put in its
# place.
INLINED = {
    "index.html": {
        "stop.js": (b'<script src="page/stop.js"></script>', "script"),
        "style.css": (b'<link rel="stylesheet" href="page/style.css">', "style"),
    }
}


class File(Struct, frozen=True):
    """A file of the page or the manual in the form in which it is sent."""

    kind: str
    packed: bytes  # gzip
    tag: str
    policy: str  # Appended to `POLICY`: allows the inserted scripts and styles.


def page_files(directory: Path = PAGE_DIRECTORY) -> dict[str, File]:
    """Return the files of the page by name, without hidden ones and symbolic links.

    The server reads them once: a version that is installed later may not fit this server.
    """
    files = [path for path in directory.iterdir() if path.is_file() and not path.is_symlink()]
    return {
        path.name: _load_file(path, CONTENT_TYPES[path.suffix])
        for path in files
        if path.suffix in CONTENT_TYPES and not path.name.startswith(".")
    }


def _load_file(path: Path, kind: str) -> File:
    body, policy = path.read_bytes(), ""
    for name, (loads, element) in INLINED.get(path.name, {}).items():
        source = path.with_name(name).read_bytes()
        body = body.replace(loads, f"<{element}>".encode() + source + f"</{element}>".encode())
        digest = base64.b64encode(hashlib.sha256(source).digest()).decode()
        policy += f"; {element}-src 'self' 'sha256-{digest}'"
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    return File(kind, gzip.compress(body, mtime=0), tag, policy)
