"""Fetches the newest picture of a camera's MJPEG stream for the clients of the page.

Another program (ustreamer, go2rtc, mjpg-streamer) serves the stream. While clients request
pictures, this module reads the stream over one connection. It keeps only the newest picture, so a
client with a slow network gets fewer pictures, and no old ones. Some servers repeat the last
picture when their camera is lost, so a picture with the same bytes as the previous picture does not
count as new.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from email.message import Message

import aiohttp
from aiohttp.http import HttpProcessingError
from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock
from acsard.web.answers import TroubleError

# For a new picture of the camera.
PICTURE_TIMEOUT_S = 1.0

# For connecting to the camera's server, and for each wait for its data.
CONNECT_S, SILENT_S = 3.0, 3.0

# A full HD picture has a few hundred kB.
MAX_PICTURE, READ_BYTES = 1_000_000, 65536

# Of a connection, and of aiohttp's parser for a stream that is damaged or is not MJPEG.
STREAM_ERRORS = (aiohttp.ClientError, HttpProcessingError, OSError, ValueError)


class Picture(Struct, frozen=True):
    """One JPEG picture, its number, and its arrival on the clock `steady_ns`."""

    body: bytes
    number: int
    at_ns: Ns

    async def pieces(self) -> AsyncIterator[bytes]:
        """Yield the picture in pieces, so that clients that read slowly share one copy of it."""
        for begin in range(0, len(self.body), READ_BYTES):
            yield self.body[begin : begin + READ_BYTES]


async def pictures(content_type: str, stream: aiohttp.StreamReader) -> AsyncIterator[bytes]:
    """Yield the pictures of an MJPEG stream. Raises `ValueError` if it is not one."""
    kind = Message()
    kind["Content-Type"] = content_type
    # Some programs write the dashes before a boundary into the content type, too.
    boundary = (kind.get_boundary() or "").removeprefix("--")
    if not boundary:
        raise ValueError(f"the camera sends {content_type!r}, not an MJPEG stream")
    parts = aiohttp.MultipartReader(
        {"Content-Type": f'multipart/x-mixed-replace; boundary="{boundary}"'}, stream
    )
    while isinstance(part := await parts.next(), aiohttp.BodyPartReader):
        picture = bytearray()
        while chunk := await part.read_chunk(READ_BYTES):
            picture += chunk
            if len(picture) > MAX_PICTURE:
                raise ValueError(f"a picture has more than {MAX_PICTURE} bytes")
        yield bytes(picture)


class Camera:
    """Reads the MJPEG stream of a camera while clients ask for pictures."""

    def __init__(self, url: str) -> None:
        self._url = url
        # None after a failure, and 5 s after a client's last request
        self.newest: Picture | None = None
        self._number = 0
        self._trouble = ("the camera's stream has no picture yet", "")  # and its detail
        self._asked_ns = 0
        self._changed = asyncio.Event()
        self._reading: asyncio.Task[None] | None = None

    async def after(self, number: int) -> Picture | None:
        """Return a picture newer than `number`, or None if none comes in time.

        Raises `TroubleError` if there is no camera, no readable stream or no picture yet.
        """
        if not self._url:
            raise TroubleError(
                404,
                "no camera is configured",
                "to show one, set web.camera to the address of its stream",
            )
        self._asked_ns = clock.steady_ns()
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._read_again_and_again())
        with suppress(TimeoutError):
            async with asyncio.timeout(PICTURE_TIMEOUT_S):
                while self.newest is None or self.newest.number == number:
                    await self._changed.wait()
        newest = self.newest
        if newest is None:
            raise TroubleError(503, *self._trouble)
        return None if newest.number == number else newest

    def close(self) -> None:
        if self._reading is not None:
            self._reading.cancel()

    async def _read_again_and_again(self) -> None:
        limits = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=SILENT_S)
        async with aiohttp.ClientSession(timeout=limits) as session:
            while not self._idle():
                try:
                    await self._read(session)
                except STREAM_ERRORS as error:
                    detail = str(error) or "no answer"
                    self._trouble = ("the camera's stream cannot be read", detail)
                    self.newest = None  # clients get the reason instead of an old picture
                await asyncio.sleep(0.5)
        self.newest = None  # the next client must not get this old picture

    async def _read(self, session: aiohttp.ClientSession) -> None:
        async with session.get(self._url, allow_redirects=False) as answer:
            if answer.status != 200:
                raise ValueError(f"the camera answered {answer.status}: correct web.camera")
            content_type = answer.headers.get("Content-Type", "")
            async for picture in pictures(content_type, answer.content):
                if self._idle():
                    return
                self._take(picture)

    def _take(self, body: bytes) -> None:
        if self.newest is not None and body == self.newest.body:
            return
        self._number += 1
        self.newest = Picture(body, self._number, clock.steady_ns())
        self._changed.set()
        self._changed.clear()

    def _idle(self) -> bool:
        return clock.steady_ns() - self._asked_ns > 5.0 * NS_PER_S
