"""The server sends each key as often as the page requested, whatever else it sends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from acsard.web.metrics import Counts
from acsard.web.socket_sender import Following, Outgoing
from acsard.web.streams import Stream, Streams

REQUEST = make_mocked_request("GET", "/ws")
STREAMS = Streams()


async def test_earlier_messages_do_not_delay_a_key_that_is_due_soon() -> None:
    out = Outgoing(web.WebSocketResponse(), REQUEST, STREAMS, Counts(), "")
    subscription = Following("state", 0.1, Stream())
    due = await out._send_due(subscription, 100.03)
    assert abs(due - 100.1) < 1e-6
    woken = [await out._send_due(subscription, now) for now in (100.04, 100.07, 100.099)]
    assert woken == [due] * 3
    assert await out._send_due(subscription, due) > due


class Socket:
    """A WebSocket that records each frame and then delivers what is due in between."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.between: Callable[[], object] = lambda: None

    async def send_frame(self, data: bytes, kind: object) -> None:
        self.sent.append(msgspec.json.decode(data))
        self.between()


async def test_a_beat_is_sent_as_it_arrives_and_ahead_of_everything_that_waits() -> None:
    socket: Any = Socket()
    out = Outgoing(socket, REQUEST, STREAMS, Counts(), "")
    out.subscribe("beat", 20.0)
    stream = out.following["beat"].stream

    def arrive(number: int) -> None:
        payload = SimpleNamespace(to_bytes=lambda: b'{"run":7,"boot_us":%d}' % number)
        stream.take(cast(Any, SimpleNamespace(encoding="application/json", payload=payload)))

    pump = asyncio.create_task(out.pump(lambda now: now + 60.0))
    await asyncio.sleep(0)
    await asyncio.to_thread(arrive, 1)
    await wait_until(lambda: len(socket.sent) == 1)
    for number in range(3):
        out.enqueue({"waits": number})
    socket.between = lambda: arrive(2) if socket.sent[-1] == {"waits": 1} else None
    await wait_until(lambda: len(socket.sent) == 5)
    pump.cancel()
    kinds = [said.get("waits", said.get("value", {}).get("boot_us")) for said in socket.sent]
    assert kinds == [1, 0, 1, 2, 2]
    assert [said.get("key", "") for said in socket.sent] == ["beat", "", "", "beat", ""]


async def wait_until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(5.0):
        while not condition():
            await asyncio.sleep(0.001)
