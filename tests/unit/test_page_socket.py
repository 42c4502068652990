"""A viewer is obeyed and served: stops beyond each limit, and each key as often as it asked."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import AsyncMock, Mock

import aiohttp
import msgspec
import pytest
from aiohttp.test_utils import make_mocked_request

from acsard.bus.address import Address
from acsard.core.messages.schema import ServiceReply
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


async def test_a_beat_that_arrives_while_other_values_are_sent_is_sent_once() -> None:
    socket: Any = Socket()
    request: Any = SimpleNamespace(transport=None)
    out = Outgoing(socket, request, Streams(), Counts(), "")
    for key in ("events", "beat"):
        out.subscribe(key, 50.0)
    streams = {key: one.stream for key, one in out.following.items()}
    payload = SimpleNamespace(to_bytes=lambda: b'{"run":7,"boot_us":1}')
    sample = cast(Any, SimpleNamespace(encoding="application/json", payload=payload))
    streams["events"].take(sample)
    looks = 0

    def arrive() -> None:
        if len(socket.sent) == 1:
            streams["beat"].take(sample)

    def look_around(now: float) -> float:
        nonlocal looks
        looks += 1
        return now

    socket.between = arrive
    pump = asyncio.create_task(out.pump(look_around))
    await wait_until(lambda: looks >= 3)
    pump.cancel()
    assert [said["key"] for said in socket.sent] == ["events", "beat"]


async def test_messages_that_a_client_does_not_read_take_bounded_memory() -> None:
    """It may ask for much, such as a pong for each ping, and read nothing."""
    out = Outgoing(cast(Any, None), REQUEST, STREAMS, Counts(), "")
    for number in range(1000):
        out.enqueue(number)
    assert [int(data) for data, _ in out._out] == list(range(800, 1000))


async def test_of_two_calls_the_second_is_refused_until_the_first_is_answered() -> None:
    page, answered = Page("maintainer"), asyncio.Event()

    async def call(who: object, verb: str, payload: object) -> ServiceReply:
        await answered.wait()
        return ServiceReply(True, verb)

    page.viewer._calls.call = call  # type: ignore[method-assign, assignment]
    for number in (1, 2):
        await page.take(json.dumps({"call": "clear", "id": number}))
    await asyncio.sleep(0)
    answered.set()
    await wait_until(lambda: len(page.viewer._out._out) == 2)
    said = [json.loads(text) for text, _ in page.viewer._out._out]
    assert [(one["answer"], one["ok"]) for one in said] == [(2, False), (1, True)]
    assert page.counts.refused() == {"too_fast": 1}
    await page.take('{"call": "clear", "id": 3}')
    await wait_until(lambda: len(page.viewer._out._out) == 3)


async def test_a_ping_of_the_protocol_is_answered_with_its_data() -> None:
    page = Page("viewer")
    page.viewer._take(cast(Any, SimpleNamespace(type=aiohttp.WSMsgType.PING, data=b"7")))
    assert list(page.viewer._out._out) == [(b"7", aiohttp.WSMsgType.PONG)]


async def test_a_ping_is_answered_with_the_wall_clock_in_milliseconds() -> None:
    page = Page("viewer")
    await page.take('{"ping": 12.5}')
    ((text, _),) = page.viewer._out._out
    said = json.loads(text)
    assert said["pong"] == 12.5
    assert abs(said["now"] / 1e3 - time.time()) < PATIENCE_S


async def wait_until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(5.0):
        while not condition():
            await asyncio.sleep(0.001)


PATIENCE_S = 20.0


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


@pytest.mark.parametrize(
    ("frame", "is_obeyed"),
    [
        ('{"cmd": {"linear_x": 0, "angular_z": 0}, "source": "app"}', True),
        ('{"call": "stop"}', True),
        ('{"cmd": {"linear_x": 0.5, "angular_z": 0}, "source": "app"}', False),
        ('{"call": "clear"}', False),
        ('{"ping": 1}', False),
    ],
)
async def test_beyond_the_limit_on_messages_only_a_zero_and_a_stop_are_obeyed(
    frame: str, is_obeyed: bool
) -> None:
    """A burst of messages, for example after a gap of the network, must not prevent them."""
    page, obeyed = Page("maintainer"), list[object]()
    page.viewer._rate = Mock(take=lambda *_: False)
    page.viewer._obey = obeyed.append  # type: ignore[method-assign, assignment]
    await page.take(frame)
    assert bool(obeyed) == is_obeyed
    assert page.counts.refused() == {"too_fast": 1}
    assert page.viewer._ending is not None
    await page.viewer._ending


async def test_a_client_that_must_leave_gets_the_reason_and_a_second_to_read_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame, transport, later = AsyncMock(), Mock(), list[Any]()
    socket: Any = SimpleNamespace(send_frame=frame)
    request: Any = SimpleNamespace(transport=transport)
    out = Outgoing(socket, request, STREAMS, Counts(), "")
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(loop, "call_later", lambda delay, *call: later.append((delay, *call)))
    await out.close("your token has expired")
    monkeypatch.undo()
    frame.assert_awaited_once_with(
        b"\x03\xf0your token has expired",
        aiohttp.WSMsgType.CLOSE,  # 1008, policy violation
    )
    [(delay, call, *words)] = later
    assert delay == 1.0
    transport.abort.assert_not_called()
    call(*words)
    transport.abort.assert_called_once_with()


async def test_a_silent_daemon_is_reported_once_and_its_new_facts_as_they_come() -> None:
    page = Page("viewer")
    for _ in range(2):
        page.viewer._look_around(0.0)
    said = [json.loads(text) for text, _ in page.viewer._out._out]
    assert said == [{"gone": "no daemon answers at tcp/127.0.0.1:1 yet"}]
    page.viewer._out._out.clear()
    for version in ("2", "2", "3"):
        page.viewer._robot.about = msgspec.structs.replace(page.viewer._about, version=version)
        page.viewer._look_around(0.0)
    said = [json.loads(text) for text, _ in page.viewer._out._out]
    assert [each["hello"]["version"] for each in said] == ["2", "3"]


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
