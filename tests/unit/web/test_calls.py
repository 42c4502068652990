"""The server merges many stops, but confirms a stop only by a call that began after its request."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import pytest
import zenoh
from msgspec.structs import replace

from acsard.client import Client
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.schema import ServiceReply
from acsard.web.callers import RequestRefusedError
from acsard.web.calls import (
    MAX_REMOTE_STOPS,
    MAX_STOPS,
    MIN_STOP_INTERVAL_S,
    Calls,
    StopMerger,
    Stops,
)
from acsard.web.fleet_rows import FleetTracker
from acsard.web.limits import REMOTE_STOP_RATE
from acsard.web.robots import Robots
from tests.unit.web.test_callers import MAINTAINER
from tests.unit.web.test_fleet_rows import quiet, robots, row
from tests.unit.web.test_metrics import STATE

PATIENCE_S = 20.0


def calls_of(
    known: Robots,
    is_known: Callable[[str], bool] = lambda robot: False,
) -> Calls:
    """Return the calls of a page's server that runs no board check and knows no other robot."""
    return Calls(known, is_known)


async def test_stops_beyond_the_limit_share_the_reply_of_a_stop_sent_after_them() -> None:
    asked: Counter[str] = Counter()
    go = threading.Event()

    def held() -> ServiceReply:
        asked["first"] += 1
        go.wait(PATIENCE_S)
        return ServiceReply(True, "stopped")

    def refused() -> ServiceReply:
        asked["later"] += 1
        return ServiceReply(False, "not stopped")

    stops = Stops()
    first = [asyncio.create_task(stops.send_stop(held)) for _ in range(MAX_STOPS)]
    await asyncio.sleep(0)
    later = [asyncio.create_task(stops.send_stop(refused)) for _ in range(100)]
    done, _ = await asyncio.wait(later, timeout=0.1)
    assert not done
    go.set()
    async with asyncio.timeout(PATIENCE_S):
        assert all(reply.success for reply in await asyncio.gather(*first))
        assert (await asyncio.gather(*later)) == [ServiceReply(False, "not stopped")] * 100
    assert asked == {"first": MAX_STOPS, "later": 1}


async def test_a_stop_that_fails_fails_its_waiting_callers_and_not_the_next_stop() -> None:
    go = threading.Event()

    def held() -> ServiceReply:
        go.wait(PATIENCE_S)
        return ServiceReply(True, "stopped")

    def fails() -> ServiceReply:
        raise ConnectionError("gone")

    stops = Stops()
    first = [asyncio.create_task(stops.send_stop(held)) for _ in range(MAX_STOPS)]
    await asyncio.sleep(0)
    later = [asyncio.create_task(stops.send_stop(fails)) for _ in range(3)]
    await asyncio.sleep(0)
    go.set()
    async with asyncio.timeout(PATIENCE_S):
        results = await asyncio.gather(*later, return_exceptions=True)
        assert [str(result) for result in results] == ["gone"] * 3
        assert (await stops.send_stop(held)).success
        await asyncio.gather(*first)


async def test_only_stop_may_be_called_on_another_robot_and_only_with_a_valid_id() -> None:
    calls = calls_of(robots(None))
    with pytest.raises(
        RequestRefusedError, match=r"r2 is not this page's robot.*own page"
    ) as error:
        await calls.call(MAINTAINER, "clear", {}, "r2")
    assert error.value.reason == "role"
    with pytest.raises(RequestRefusedError, match="not a robot's id") as error:
        await calls.call(MAINTAINER, "stop", {}, "**")
    assert error.value.reason == "malformed"
    # Naming the page's own robot counts as its own.
    assert not (await calls.call(MAINTAINER, "clear", {}, "acsar")).success


async def test_a_stop_of_another_robot_is_sent_however_many_replies_are_pending() -> None:
    queries: list[zenoh.Query] = []
    keys: list[str] = []
    with zenoh.open(quiet()) as session:
        session.declare_queryable("acsard/r2/srv/stop", queries.append)
        session.declare_subscriber(
            "acsard/*/stop", lambda sample: keys.append(str(sample.key_expr))
        )
        calls = calls_of(robots(Client(session, "acsar", "teleop")))

        async def stop(robot: str, client: int = 0) -> ServiceReply:
            return await calls.call(replace(MAINTAINER, token=f"{client}"), "stop", {}, robot)

        first = [asyncio.create_task(stop("r2", n)) for n in range(MAX_REMOTE_STOPS)]
        async with asyncio.timeout(PATIENCE_S):
            while len(queries) < MAX_REMOTE_STOPS:
                await asyncio.sleep(0.01)
            beyond = await stop("r3")
            while not keys:
                await asyncio.sleep(0.01)
        assert not beyond.success
        assert "the stop was sent to r3" in beyond.message
        assert keys == ["acsard/r3/stop"]
        answer = encode(ServiceReply(True, "stopped"), "msgpack")
        while queries:
            with queries.pop() as query:
                kind = encoding_name("msgpack", "ServiceReply")
                query.reply(query.key_expr, answer, encoding=kind)
        assert all(reply.success for reply in await asyncio.gather(*first))


async def test_stops_of_one_client_to_one_robot_are_merged_without_a_loss() -> None:
    merged, loop = StopMerger(), asyncio.get_running_loop()
    sent: list[float] = []

    async def stop() -> ServiceReply:
        sent.append(loop.time())
        return ServiceReply(True, str(len(sent)))

    async def asked() -> None:
        begun = loop.time()
        reply = await merged.send_stop(("viewer", "r2"), stop)
        assert sent[int(reply.message) - 1] >= begun

    for _ in range(3):
        await asyncio.gather(*(asked() for _ in range(100)))
    # On a busy machine, 100 stops may take longer than one interval.
    assert 4 <= (merged_stops := len(sent)) < 20
    # The time begins shortly before a stop is sent.
    assert all(later - sooner > 0.9 * MIN_STOP_INTERVAL_S for sooner, later in pairwise(sent))
    await asyncio.gather(*(merged.send_stop((f"viewer {n}", "r2"), stop) for n in range(9)))
    assert len(sent) == merged_stops + 9
    await asyncio.sleep(2 * MIN_STOP_INTERVAL_S)
    assert not merged._rests


async def test_a_stop_that_comes_as_the_pause_ends_is_sent_and_so_are_the_later_ones() -> None:
    merged, sent = StopMerger(), 0

    async def stop() -> ServiceReply:
        nonlocal sent
        sent += 1
        return ServiceReply(True, "stopped")

    await merged.send_stop("viewer", stop)
    # The event loop is late, so it runs the next stop and the end of the pause in one turn.
    time.sleep(2 * MIN_STOP_INTERVAL_S)
    for _ in range(2):
        async with asyncio.timeout(PATIENCE_S):
            assert (await asyncio.create_task(merged.send_stop("viewer", stop))).success
    assert sent == 3


async def test_stops_to_silent_robots_are_limited_and_an_answering_robot_is_stopped() -> None:
    stop_counts: Counter[str] = Counter()

    def served(query: zenoh.Query) -> None:
        with query:
            stop_counts["r2"] += 1
            answer = encode(ServiceReply(True, "stopped"), "msgpack")
            kind = encoding_name("msgpack", "ServiceReply")
            query.reply(query.key_expr, answer, encoding=kind)

    with zenoh.open(quiet()) as session:
        session.declare_queryable("acsard/r2/srv/stop", served)
        calls = calls_of(robots(Client(session, "acsar", "teleop")))

        async def stop(robot: str) -> bool:
            return (await calls.call(MAINTAINER, "stop", {}, robot)).success

        assert await stop("r2")
        refused = 0
        for n in range(100):
            try:
                await stop(f"x{n}")
            except RequestRefusedError:
                refused += 1
        assert refused > 100 - 2 * REMOTE_STOP_RATE.burst
        assert await stop("r2")
        assert stop_counts["r2"] == 2


async def test_a_robot_that_a_page_shows_is_stopped_however_many_stops_were_refused() -> None:
    with zenoh.open(quiet()) as session:
        known = robots(Client(session, "acsar", "teleop"))
        fleet = FleetTracker(known)
        calls = calls_of(known, is_known=fleet.sees)

        async def stop(robot: str) -> str:
            """Stop this robot, and return the message of the answer or the reason of the refusal.

            No robot is on the bus, so the answer is an error.
            """
            try:
                return (await calls.call(MAINTAINER, "stop", {}, robot)).message
            except RequestRefusedError as error:
                return error.reason

        async def refused() -> None:
            async with asyncio.timeout(PATIENCE_S):
                while await stop("ghost") != "too_fast":
                    pass

        fleet.join(1)
        token = session.liveliness().declare_token("acsard/r2/alive")
        await row(fleet, lambda entry: entry.robot == "r2")
        await refused()
        assert await stop("r2") != "too_fast"
        token.undeclare()
        await row(fleet, lambda entry: entry.robot == "r2" and entry.mode == "gone")
        await refused()
        assert await stop("r2") == "too_fast"
        fleet.leave(1)
        assert known.client is not None
        await known.streams.follow(known.client, "r3", "state")
        await refused()
        assert await stop("r3") == "too_fast"
        state = encode(STATE, "msgpack")
        session.put("acsard/r3/state", state, encoding=encoding_name("msgpack", "RobotState"))
        async with asyncio.timeout(PATIENCE_S):
            while not fleet.sees("r3"):
                await asyncio.sleep(0.01)
        await refused()
        assert await stop("r3") != "too_fast"
        known.streams.leave("r3", "state")
