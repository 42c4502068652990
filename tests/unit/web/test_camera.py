"""The server finds the pictures in a camera's stream, however its bytes are divided."""

from __future__ import annotations

import pytest

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.web.camera import MAX_HEAD, MAX_PICTURE, Camera, Parts
from tests.each import each

PICTURES = [bytes([0xFF, 0xD8, n]) * (n + 1) + b"\r\n--\r\n\r\n" for n in range(5)]
"""Contents that look like the borders between pictures."""


def measured(picture: bytes) -> bytes:
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
    return head.encode() + picture + b"\r\n"


def bare(picture: bytes) -> bytes:
    return b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + picture + b"\r\n"


@each("boundary", ["frame", '"frame"', "--frame"])
@each("form", [measured, bare])
@each("size", [1, 7, 1000])
def test_every_picture_is_found_in_pieces_of_any_size(boundary, form, size) -> None:  # type: ignore[no-untyped-def]
    stream = b"".join(map(form, [*PICTURES, b"last"]))
    parts = Parts(boundary)
    pieces = [stream[n : n + size] for n in range(0, len(stream), size)]
    pictures = [part for piece in pieces if (part := parts.feed(piece)) is not None]
    wanted = [*PICTURES, b"last"] if form is measured else PICTURES
    if size == 1:
        assert pictures == wanted
    else:
        assert pictures[-1] == wanted[-1]  # of several at once only the newest counts
        assert all(picture in wanted for picture in pictures)


@each(
    "stream",
    [
        b"x" * MAX_HEAD,
        b"--frame\r\nContent-Length: 99999999\r\n\r\n",
        b"--frame\r\n\r\n" + b"x" * (MAX_PICTURE + 1),
    ],
)
def test_a_stream_that_would_fill_the_memory_is_an_error(stream: bytes) -> None:
    with pytest.raises(ValueError, match=r"header of a picture|more than"):
        Parts("frame").feed(stream)


async def test_a_camera_that_no_client_asked_for_in_a_suspend_is_idle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = Camera("http://127.0.0.1:1/")
    camera._take(b"picture")
    await camera.after(0)
    camera.close()
    assert not camera._idle()
    slept_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns)
    assert camera._idle()
