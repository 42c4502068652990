"""Sends the files of the built manual, which are in one zip file of the package.

Deflated data of a zip file is gzip with another head and another end. So the server sends it as it
is, in pieces, and unpacks it only for a client that takes no gzip.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import os
import re
import struct
import zlib
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

from aiohttp import web
from msgspec import Struct

from acsard.web.answers import CONTENT_TYPES, file_headers

MANUAL = Path(__file__).parents[1] / "manual.zip"

PIECE_BYTES = 65536

GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"

MISSING = b"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Manual</title>
<h1>This installation has no manual</h1>
<p>The packages of a release contain the manual of their version. In a clone, this command makes it
for the next start of the page:
<pre>.venv/bin/python deploy/manual/build.py acsard/manual.zip</pre>
<p>The same pages are Markdown in the source, in <code>deploy/manual/pages</code>.
"""


class Entry(Struct, frozen=True):
    """One file of the manual: its place in the zip file, and what `gzip` wants to know of it."""

    kind: str
    start: int
    packed: int
    size: int
    crc: int


class Manual:
    """The manual of this version, or none.

    The zip file stays open, so an upgrade does not change the manual of this server.
    """

    def __init__(self, path: Path = MANUAL) -> None:
        self._entries: dict[str, Entry] = {}
        self._policy = ""
        try:
            with ZipFile(path) as archive:
                self._file = path.open("rb", buffering=0)
                self._read_contents(archive)
        except (OSError, BadZipFile):
            self._entries = {}

    def _read_contents(self, archive: ZipFile) -> None:
        digests = set[str]()
        for info in archive.infolist():
            kind = CONTENT_TYPES.get(PurePosixPath(info.filename).suffix)
            if kind is None or info.compress_type != ZIP_DEFLATED:
                continue
            # The head of a file has two fields of any length before the data.
            lengths = os.pread(self._file.fileno(), 4, info.header_offset + 26)
            start = info.header_offset + 30 + sum(struct.unpack("<HH", lengths))
            self._entries[info.filename] = Entry(
                kind, start, info.compress_size, info.file_size, info.CRC
            )
            if info.filename.endswith(".html"):
                for source in re.findall(rb"<script>(.*?)</script>", archive.read(info), re.DOTALL):
                    digests.add(base64.b64encode(hashlib.sha256(source).digest()).decode())
        scripts = " ".join(f"'sha256-{digest}'" for digest in sorted(digests))
        self._policy = (
            f"; script-src 'self' {scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
        )

    async def answer(self, request: web.Request, name: str) -> web.StreamResponse:
        """Return a file of the manual, or a page that says how to get one."""
        if not self._entries:
            return web.Response(
                status=404, body=MISSING, headers={"Content-Type": CONTENT_TYPES[".html"]}
            )
        entry = self._entries.get(name or "index.html")
        if entry is None:
            raise web.HTTPNotFound
        headers = file_headers(request, f'"{entry.crc:08x}-{entry.size}"', self._policy)
        if request.headers.get("If-None-Match") == headers["ETag"]:
            return web.Response(status=304, headers=headers)
        gzips = "gzip" in request.headers.get("Accept-Encoding", "")
        if gzips:
            headers["Content-Encoding"] = "gzip"
        answer = web.StreamResponse(headers=headers | {"Content-Type": entry.kind})
        answer.content_length = len(GZIP_HEAD) + entry.packed + 8 if gzips else entry.size
        await answer.prepare(request)
        if request.method != "HEAD":
            with suppress(ConnectionError):  # the client may leave at any time
                async for piece in self._gzip(entry) if gzips else self._plain(entry):
                    await answer.write(piece)
        return answer

    async def _gzip(self, entry: Entry) -> AsyncIterator[bytes]:
        yield GZIP_HEAD
        async for piece in self._pieces(entry):
            yield piece
        yield struct.pack("<II", entry.crc, entry.size)

    async def _plain(self, entry: Entry) -> AsyncIterator[bytes]:
        inflating = zlib.decompressobj(-zlib.MAX_WBITS)
        async for piece in self._pieces(entry):
            while piece:
                yield inflating.decompress(piece, PIECE_BYTES)
                piece = inflating.unconsumed_tail
        yield inflating.flush()

    async def _pieces(self, entry: Entry) -> AsyncIterator[bytes]:
        end = entry.start + entry.packed
        for start in range(entry.start, end, PIECE_BYTES):
            size = min(PIECE_BYTES, end - start)
            # A disk may hang, and the server must go on.
            yield await asyncio.to_thread(os.pread, self._file.fileno(), size, start)
