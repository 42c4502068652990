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
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from email.message import Message

import aiohttp
from msgspec import Struct

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.rate_limits import Places
from acsard.web.answers import TroubleError

PICTURE_TIMEOUT_S = 1.0
"""Time limit, s, for each of two waits: until the camera sends a new picture, and until the limit
`SENDS` lets the server send the picture to the client."""

CONNECT_S, SILENT_S = 3.0, 3.0
"""Time limits, s: for connecting to the camera's server (`CONNECT_S`), and for each wait for data
from that server (`SILENT_S`)."""

MAX_PICTURE, MAX_HEAD = 1_000_000, 4096
"""Maximum size of a picture (`MAX_PICTURE`), and of the header lines before a picture (`MAX_HEAD`),
bytes. A full HD picture has a few hundred kB."""

SENDS, SENDS_OF_TOKEN = 8, 2
"""Maximum number of pictures that the server sends at the same time: in total (`SENDS`), and to the
clients with one token (`SENDS_OF_TOKEN`)."""

SEND_TIMEOUT_S = 5.0
"""Time limit for sending a picture, s. The page in the browser waits no longer than this."""

_LENGTH = re.compile(rb"(?im)^content-length:[ \t]*(\d{1,8})[ \t]*\r?$")


class Picture(Struct, frozen=True):
    """One JPEG picture, its number, and its arrival time on the clock `steady_ns`, ns."""

    body: bytes
    number: int
    at_ns: int


class Parts:
    """Splits a `multipart/x-mixed-replace` stream into pictures."""

    def __init__(self, boundary: str) -> None:
        """Create a splitter for a stream with the boundary `boundary`, from its content type.

        Some servers write the two dashes that precede each boundary in the stream also in the
        content type. These dashes are ignored.
        """
        self._end = b"\r\n--" + boundary.strip('"').removeprefix("--").encode()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> bytes | None:
        """Process the received bytes `data`, and return the newest picture that they complete.

        Return None if they complete no picture. Raises `ValueError` if a picture or its header
        lines are too long.
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
        self.newest: Picture | None = None
        """The newest picture. It is None before the first picture, after a failure, and when the
        last request of a client is more than 5 s old."""
        self._number = 0
        self._trouble = "the camera's stream has no picture yet"
        self._asked_ns = 0
        self._changed, self._sent = asyncio.Event(), asyncio.Event()
        self._sends = Places(SENDS, SENDS_OF_TOKEN)
        self._reading: asyncio.Task[None] | None = None

    async def after(self, number: int) -> Picture | None:
        """Wait for a picture that the client does not have, and return the picture.

        `number` is the number of the client's last picture, or 0. Return None if the camera sends
        no other picture within `PICTURE_TIMEOUT_S`. Raises `TroubleError` if no camera is
        configured, if its stream cannot be read, or if it has not sent any picture yet.
        """
        if not self._url:
            raise TroubleError(
                404,
                "no camera is configured: to show one, set web.camera to the address of its stream",
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
            raise TroubleError(503, self._trouble)
        return None if newest.number == number else newest

    @asynccontextmanager
    async def sending(self, token: str) -> AsyncIterator[None]:
        """Limit how many pictures are sent at the same time. Send one picture in the `with` block.

        If a limit is reached (`SENDS`, `SENDS_OF_TOKEN`), first wait until another picture has been
        sent. `token` is the client's token. Raises `TroubleError` after a wait of
        `PICTURE_TIMEOUT_S`.
        """
        try:
            async with asyncio.timeout(PICTURE_TIMEOUT_S):
                while not self._sends.enter(token):
                    await self._sent.wait()
        except TimeoutError:
            text = f"{SENDS_OF_TOKEN} pictures with this token, or {SENDS} in total, are being sent"
            raise TroubleError(503, f"{text}: ask again when one of them has arrived") from None
        try:
            yield
        finally:
            self._sends.leave(token)
            self._sent.set()
            self._sent.clear()

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
                    self._trouble = f"the camera's stream cannot be read: {error or 'no answer'}"
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
