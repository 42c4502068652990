"""Stops: each is confirmed by one that was asked after it, however many there are."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter

from acsard.messages.schema import ServiceReply
from acsard.web.calls import STOPS_AT_ONCE, Stops

PATIENCE_S = 20.0


def test_stops_beyond_the_room_wait_for_one_asked_after_them_and_none_is_said_to_be_done() -> None:
    asked: Counter[str] = Counter()
    go = threading.Event()

    def held() -> ServiceReply:
        asked["first"] += 1
        go.wait(PATIENCE_S)
        return ServiceReply(True, "stopped")

    def refused() -> ServiceReply:
        asked["later"] += 1
        return ServiceReply(False, "not stopped")

    async def story() -> list[ServiceReply]:
        stops = Stops()
        first = [asyncio.create_task(stops.ask(held)) for _ in range(STOPS_AT_ONCE)]
        await asyncio.sleep(0)
        later = [asyncio.create_task(stops.ask(refused)) for _ in range(100)]
        done, _ = await asyncio.wait(later, timeout=0.1)
        assert not done
        go.set()
        async with asyncio.timeout(PATIENCE_S):
            assert all(reply.success for reply in await asyncio.gather(*first))
            return await asyncio.gather(*later)

    assert asyncio.run(story()) == [ServiceReply(False, "not stopped")] * 100
    assert asked == {"first": STOPS_AT_ONCE, "later": 1}


def test_one_that_fails_fails_those_who_wait_for_it_and_not_the_next() -> None:
    go = threading.Event()

    def held() -> ServiceReply:
        go.wait(PATIENCE_S)
        return ServiceReply(True, "stopped")

    def fails() -> ServiceReply:
        raise ConnectionError("gone")

    async def story() -> None:
        stops = Stops()
        first = [asyncio.create_task(stops.ask(held)) for _ in range(STOPS_AT_ONCE)]
        await asyncio.sleep(0)
        later = [asyncio.create_task(stops.ask(fails)) for _ in range(3)]
        await asyncio.sleep(0)
        go.set()
        async with asyncio.timeout(PATIENCE_S):
            told = await asyncio.gather(*later, return_exceptions=True)
            assert [str(one) for one in told] == ["gone"] * 3
            assert (await stops.ask(held)).success
            await asyncio.gather(*first)

    asyncio.run(story())
