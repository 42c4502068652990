"""A program that serves a camera's stream for the page to show."""

from __future__ import annotations

import asyncio
import struct
import threading
import zlib

from aiohttp import web

from tests.system.harness import free_endpoint

HZ = 10.0


def picture(grey: int) -> bytes:
    """Return a small PNG picture, which the browser accepts in place of a JPEG.

    It is built by hand, because the tests have no library for pictures.
    """

    def chunk(name: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    rows = zlib.compress(b"".join(b"\0" + bytes([grey] * 32) for _ in range(24)))
    head = struct.pack(">IIBBBBB", 32, 24, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        chunk(name, body) for name, body in ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b""))
    )


class Stream:
    """A program that serves an MJPEG stream at 10 pictures a second."""

    def __init__(self) -> None:
        self.port = int(free_endpoint().rpartition(":")[2])
        self.grey, self.clients = 0, 0
        self.runs, self.silent, self.ends = True, False, False
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(5.0)

    async def _start(self) -> None:
        app = web.Application()
        app.add_routes([web.get("/stream", self._serve)])
        self._runner = web.AppRunner(app, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", self.port).start()

    async def _serve(self, request: web.Request) -> web.StreamResponse:
        answer = web.StreamResponse()
        answer.headers["Content-Type"] = "multipart/x-mixed-replace;boundary=frame"
        await answer.prepare(request)
        self.clients += 1
        try:
            while not self.ends:
                if not self.silent:
                    body = picture(self.grey)
                    head = f"--frame\r\nContent-Length: {len(body)}\r\n\r\n".encode()
                    await answer.write(head + body + b"\r\n")
                self.grey = (self.grey + self.runs) % 256
                await asyncio.sleep(1 / HZ)
        except ConnectionError:
            pass  # the reader may leave at any time
        finally:
            self.clients -= 1
        return answer

    async def _end(self) -> None:
        self.ends = True
        await asyncio.sleep(2 / HZ)
        await self._runner.cleanup()

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
