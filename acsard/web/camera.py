"""Fetches the newest picture of a camera's MJPEG stream for the clients of the page.

Another program (ustreamer, go2rtc, mjpg-streamer) serves the stream. While clients request
pictures, this module reads the stream over one connection. It keeps only the newest picture, so a
client with a slow network gets fewer pictures, and no old ones. Some servers repeat the last
picture when their camera is lost, so a picture with the same bytes as the previous picture does not
count as new.
"""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from email.message import Message

import aiohttp
from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock
from acsard.web.answers import TroubleError

# For a new picture of the camera.
PICTURE_TIMEOUT_S = 1.0

# For connecting to the camera's server, and for each wait for its data.
CONNECT_S, SILENT_S = 3.0, 3.0

# Bytes of a picture and of the lines before it. A full HD picture has a few hundred kB.
MAX_PICTURE, MAX_HEAD = 1_000_000, 4096

# The page in the browser waits no longer.
SEND_TIMEOUT_S = 5.0

_LENGTH = re.compile(rb"(?im)^content-length:[ \t]*(\d{1,8})[ \t]*\r?$")


class Picture(Struct, frozen=True):
    """One JPEG picture, its number, and its arrival on the clock `steady_ns`."""

    body: bytes
    number: int
    at_ns: Ns


class Parts:
    """Splits a `multipart/x-mixed-replace` stream into pictures.

    Dashes before the boundary in the content type are ignored.
    """

    def __init__(self, boundary: str) -> None:
        self._end = b"\r\n--" + boundary.strip('"').removeprefix("--").encode()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> bytes | None:
        """Return the newest picture that the bytes complete.

        Raises `ValueError` if one is too long.
        """
        self._buffer += data
        newest = None
        while (part := self._part()) is not None:
            newest = part
        return newest

    def _part(self) -> bytes | None:
        head = self._buffer.find(b"\r\n\r\n", 0, MAX_HEAD)
        if head < 0:
            if len(self._buffer) >= MAX_HEAD:
                raise ValueError(
                    f"the header of a picture is missing, or has {MAX_HEAD} bytes or more"
                )
            return None
        begin = head + 4
        if match := _LENGTH.search(self._buffer, 0, head):
            end = begin + int(match[1])
        else:
            end = self._buffer.find(self._end, begin)
        if max(end, len(self._buffer) if end < 0 else 0) - begin > MAX_PICTURE:
            raise ValueError(f"a picture has more than {MAX_PICTURE} bytes")
        if end < 0 or end > len(self._buffer):
            return None
        part = bytes(self._buffer[begin:end])
        del self._buffer[:end]
        return part


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
                except (aiohttp.ClientError, TimeoutError, OSError, ValueError) as error:
                    detail = str(error) or "no answer"
                    self._trouble = ("the camera's stream cannot be read", detail)
                    self.newest = None  # clients get the reason instead of an old picture
                await asyncio.sleep(0.5)
        self.newest = None  # the next client must not get this old picture

    async def _read(self, session: aiohttp.ClientSession) -> None:
        async with session.get(self._url, allow_redirects=False) as answer:
            kind = Message()
            kind["Content-Type"] = answer.headers.get("Content-Type", "")
            boundary = kind.get_boundary()
            if answer.status != 200 or boundary is None:
                raise ValueError(
                    f"the camera answered {answer.status} {answer.content_type}, not an MJPEG "
                    "stream: correct web.camera"
                )
            parts = Parts(boundary)
            async for data in answer.content.iter_any():
                if self._idle():
                    return
                self._take(parts.feed(data))

    def _take(self, body: bytes | None) -> None:
        if body is None or (self.newest is not None and body == self.newest.body):
            return
        self._number += 1
        self.newest = Picture(body, self._number, clock.steady_ns())
        self._changed.set()
        self._changed.clear()

    def _idle(self) -> bool:
        return clock.steady_ns() - self._asked_ns > 5.0 * NS_PER_S
