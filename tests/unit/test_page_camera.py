"""The page shows the newest picture of the camera, and each one once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any
from unittest.mock import MagicMock, Mock

import pytest
from aiohttp import StreamReader

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.web import camera as module
from acsard.web.answers import TroubleError
from acsard.web.camera import STREAM_ERRORS, Camera, pictures
from tests.each import each

PICTURES = [bytes([0xFF, 0xD8, n]) * (n + 1) + b"\r\n--\r\n\r\n" for n in range(5)]
"""Contents that look like the borders between pictures."""


def measured(picture: bytes) -> bytes:
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
    return head.encode() + picture + b"\r\n"


def bare(picture: bytes) -> bytes:
    return b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + picture + b"\r\n"


async def read(boundary: str, stream: bytes, size: int = 1000) -> list[bytes]:
    """Return the pictures of a stream that arrives in pieces of this size."""
    reader = StreamReader(Mock(_reading_paused=False), 2**16)

    async def arrive() -> None:
        for n in range(0, len(stream), size):
            reader.feed_data(stream[n : n + size])
            await asyncio.sleep(0)
        reader.feed_eof()

    arriving = asyncio.create_task(arrive())
    kind = f"multipart/x-mixed-replace; boundary={boundary}"
    try:
        return [picture async for picture in pictures(kind, reader)]
    finally:
        arriving.cancel()


@each("boundary", ["frame", '"frame"', "--frame"])
@each("form", [measured, bare])
@each("size", [1, 7, 1000])
async def test_every_picture_is_found_in_pieces_of_any_size(
    boundary: str, form: Callable[[bytes], bytes], size: int
) -> None:
    stream = b"".join(map(form, PICTURES)) + b"--frame--\r\n"
    assert await read(boundary, stream, size) == PICTURES


@each(
    ("stream", "why"),
    [
        (b"x" * 300_000, "more than"),
        (b"--frame\r\nContent-Length: 99999999\r\n\r\n" + b"x" * 2_000_000, "more than"),
        (b"--frame\r\n\r\n" + b"x" * 2_000_000, "more than"),
    ],
)
async def test_a_stream_that_would_fill_the_memory_is_an_error(stream: bytes, why: str) -> None:
    with pytest.raises(STREAM_ERRORS, match=why):
        await read("frame", stream, 65536)


@each(
    "part",
    [
        b"Content-Length: 9\r\n\r\nabc",
        b"Content-Length: -9\r\n\r\nabc",
        b"no header\r\n\r\nabc",
        b"\xff: \xff\r\n\r\nabc",
        b"A: b\r\n" * 500 + b"\r\n",
        b"Content-Type: multipart/mixed\r\n\r\n--x",
    ],
)
async def test_a_damaged_stream_is_an_error_that_the_camera_expects(part: bytes) -> None:
    with pytest.raises(STREAM_ERRORS):
        await read("frame", b"--frame\r\n" + part)


async def test_an_answer_that_is_not_a_stream_is_an_error() -> None:
    reader = StreamReader(Mock(_reading_paused=False), 2**16)
    with pytest.raises(ValueError, match="'text/html', not an MJPEG stream"):
        await anext(pictures("text/html", reader))


async def test_a_camera_is_not_read_while_nobody_asks_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ns, read = 0, 0
    monkeypatch.setattr(clock, "steady_ns", lambda: now_ns)
    camera = Camera("http://127.0.0.1:9/")

    async def stream(*_: object) -> AsyncIterator[bytes]:
        nonlocal now_ns, read
        for read in range(1, 20):
            yield bytes(read)
            now_ns += NS_PER_S
        pytest.fail("it is read on")

    monkeypatch.setattr(module, "pictures", stream)
    answer = Mock(status=200, headers={})
    session: Any = Mock(get=Mock(return_value=MagicMock()))
    session.get.return_value.__aenter__.return_value = answer
    await camera._read(session)
    assert read == 7  # the sixth one came 5 s after the last request
    assert camera.newest is not None
    assert camera.newest.body == bytes(6)


@pytest.mark.parametrize(
    ("error", "detail"), [(TimeoutError(), "no answer"), (OSError("no route"), "no route")]
)
async def test_a_camera_that_does_not_answer_is_explained(
    monkeypatch: pytest.MonkeyPatch, error: Exception, detail: str
) -> None:
    monkeypatch.setattr(module, "PICTURE_TIMEOUT_S", 0.05)
    camera = Camera("http://127.0.0.1:9/")
    monkeypatch.setattr(camera, "_read", Mock(side_effect=error))
    with pytest.raises(TroubleError) as raised:
        await camera.after(0)
    camera.close()
    assert (raised.value.status, raised.value.detail) == (503, detail)


async def test_a_picture_that_a_server_repeats_is_not_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some servers repeat the last picture when their camera is lost."""
    monkeypatch.setattr(module, "PICTURE_TIMEOUT_S", 0.01)
    camera = Camera("http://127.0.0.1:9/")
    camera._reading = asyncio.create_task(asyncio.sleep(60))  # the test is the stream
    for body in (b"a", b"a", b"b", b"b", b"b"):
        camera._take(body)
    first = await camera.after(0)
    assert first is not None
    assert (first.body, first.number) == (b"b", 2)
    camera._take(b"b")
    assert await camera.after(first.number) is None
    camera._take(b"a")
    again = await camera.after(first.number)
    assert again is not None
    assert again.body == b"a"
    camera.close()
