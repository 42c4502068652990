"""The server sends each key as often as the page requested, whatever else it sends."""

from __future__ import annotations

import msgspec
import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from acsard.web.metrics import Counts
from acsard.web.socket_sender import Following, Outgoing
from acsard.web.streams import Stream


async def test_earlier_messages_do_not_delay_a_key_that_is_due_soon() -> None:
    out = Outgoing(web.WebSocketResponse(), make_mocked_request("GET", "/ws"), Counts(), "")
    subscription = Following("state", 0.1)
    subscription.stream = Stream()
    due = await out._send_due(subscription, 100.03)
    assert abs(due - 100.1) < 1e-6
    woken = [await out._send_due(subscription, now) for now in (100.04, 100.07, 100.099)]
    assert woken == [due] * 3
    assert await out._send_due(subscription, due) > due


@pytest.mark.slow
async def test_a_refusal_is_reported_once_a_second_for_each_kind_of_message_and_reason() -> None:
    counts = Counts()
    out = Outgoing(web.WebSocketResponse(), make_mocked_request("GET", "/ws"), counts, "")
    for _ in range(3):
        out.refuse("subscribe", "malformed", "no such key")
        out.refuse("cmd", "malformed", "not a number")
        out.refuse("cmd", "role", "for operators")
    messages = [msgspec.json.decode(message) for message in out._out]
    assert [message["refused"] for message in messages] == ["subscribe", "cmd", "cmd"]
    assert counts.refused() == {"malformed": 6, "role": 3}
