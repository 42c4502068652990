"""A viewer is obeyed and served: stops beyond each limit, and each key as often as it asked."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import AsyncMock, Mock

import aiohttp
import msgspec
import pytest
from aiohttp.test_utils import make_mocked_request

from acsard.bus.address import Address
from acsard.core.messages.schema import Beat, ServiceReply
from acsard.core.values import Role
from acsard.web.callers import AdmittedClient
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.socket_sender import Outgoing
from acsard.web.streams import Streams
from acsard.web.viewer import Parts, Viewer
from tests.unit.test_page_messages import INVALID_STOPS

REQUEST = make_mocked_request("GET", "/ws")
STREAMS = Streams()


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
    out.subscribe("beat", 0.1)  # its period would be longer than the test
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


PATIENCE_S = 20.0


@pytest.mark.slow
async def test_a_zero_is_obeyed_beyond_the_limit_on_messages() -> None:
    """A burst of messages, for example after a gap of the network, must not prevent the zero."""
    put: list[tuple[float, str]] = []

    class Fake:
        certificate, session = "", None

        def put(self, twist: Any, signature: Any, source: str) -> None:
            put.append((twist.linear.x, source))
            assert signature.echo == Beat(7, 1)

    counts = Counts()
    about = About("1", True, 1.0, 4.0, 10.0, "", {"slow": 10.0})
    fake: Any = Fake()
    robot = FollowedRobot(Address("tcp/127.0.0.1:1", "acsar", ""), lambda: fake, about, counts)
    robot.client = fake
    parts = Parts(robot, counts)
    request: Any = SimpleNamespace(transport=None)
    socket: Any = SimpleNamespace()
    viewer = Viewer(
        socket, request, AdmittedClient("operator", "bob", "token", "1.2.3.4"), parts, camera=False
    )

    def take(frame: dict[str, Any]) -> None:
        message: Any = SimpleNamespace(type=aiohttp.WSMsgType.TEXT, data=json.dumps(frame))
        viewer._take(message)

    def drive(speed: float) -> None:
        wish = {"linear_x": speed, "angular_z": 0.0}
        beat = {"run": 7, "boot_us": 1}
        take({"cmd": wish, "source": "slow", "echo": beat})

    drive(0.5)
    parts.outbox.flush(PATIENCE_S)
    for number in range(700):
        take({"ping": number})
    drive(0.5)
    drive(0.0)
    parts.outbox.flush(PATIENCE_S)
    assert put == [(0.5, "slow"), (0.0, "slow")]


class Page:
    """A viewer, and the stops that it has called."""

    def __init__(self, role: Role) -> None:
        self.stops: list[ServiceReply] = []
        counts = Counts()
        about = About("1", True, 1.0, 4.0, 10.0, "", {})
        robot = FollowedRobot(Address("tcp/127.0.0.1:1", "r1", ""), Mock(), about, counts)
        parts = Parts(robot, counts)
        parts.calls.call = self._call  # type: ignore[method-assign, assignment]
        who = AdmittedClient(role, "bob", "token", "1.2.3.4")
        socket: Any = SimpleNamespace(send_frame=AsyncMock())
        request: Any = SimpleNamespace(transport=None)
        self.viewer, self.counts = Viewer(socket, request, who, parts, camera=False), counts

    async def _call(self, who: object, verb: str, payload: object) -> ServiceReply:
        assert (verb, payload) == ("stop", {})
        self.stops.append(ServiceReply(True, "stopped"))
        return self.stops[-1]

    async def take(self, frame: str) -> None:
        message: Any = SimpleNamespace(type=aiohttp.WSMsgType.TEXT, data=frame)
        self.viewer._take(message)
        if self.viewer._stopping is not None:
            await self.viewer._stopping


@pytest.mark.parametrize("role", ["viewer", "maintainer"])
async def test_an_invalid_message_that_asks_for_a_stop_is_refused_and_stops_this_robot(
    role: Role,
) -> None:
    page = Page(role)
    for count, text in enumerate(INVALID_STOPS, 1):
        await page.take(text)
        assert len(page.stops) == count, text
        assert page.counts.refused() == {"malformed": count}


async def test_an_invalid_message_without_a_stop_is_only_refused() -> None:
    page = Page("maintainer")
    await page.take('{"call": "clear", "id": null}')
    assert page.stops == []
    assert page.counts.refused() == {"malformed": 1}


async def test_a_stop_counts_even_after_the_close_frame_and_nothing_else_does() -> None:
    page = Page("maintainer")
    page.viewer.end("too fast")
    for frame in ('{"call": "clear"}', '{"ping": 1}'):
        await page.take(frame)
    assert page.stops == []
    await page.take('{"call": "stop"}')
    assert len(page.stops) == 1


async def test_a_flood_of_messages_leaves_each_other_client_its_turn() -> None:
    page, turns = Page("viewer"), 0

    async def flood() -> AsyncIterator[Any]:
        for _ in range(1000):
            yield SimpleNamespace(type=aiohttp.WSMsgType.PONG, data=b"")

    async def take_turns() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    page.viewer._socket = cast(Any, flood())
    other = asyncio.create_task(take_turns())
    async with asyncio.timeout(PATIENCE_S):
        await page.viewer.run()
    other.cancel()
    assert turns > 900


async def test_every_press_is_answered_by_a_stop_that_was_sent_after_it() -> None:
    """Each further press comes just as the stop before it ends."""
    page, loop, sent, pressed = Page("viewer"), asyncio.get_running_loop(), list[int](), 0

    def press() -> None:
        nonlocal pressed
        data = json.dumps({"call": "stop", "id": pressed})
        pressed += 1
        page.viewer._take(cast(Any, SimpleNamespace(type=aiohttp.WSMsgType.TEXT, data=data)))

    async def call(who: object, verb: str, payload: object) -> ServiceReply:
        sent.append(pressed)
        if pressed < 9:
            for _ in range(3):
                loop.call_soon(press)
        return ServiceReply(True, str(len(sent)))

    page.viewer._calls.call = call  # type: ignore[method-assign, assignment]
    press()
    async with asyncio.timeout(PATIENCE_S):
        while len(page.viewer._out._out) < 10:
            await asyncio.sleep(0)
    answers = [json.loads(text) for text, _ in page.viewer._out._out]
    assert [answer["answer"] for answer in answers] == list(range(10))
    assert all(sent[int(answer["text"]) - 1] > answer["answer"] for answer in answers)
    assert len(sent) == 4  # three presses share a stop
