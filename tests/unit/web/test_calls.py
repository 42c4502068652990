"""The server merges many stops, but confirms a stop only by a call that began after its request."""

from __future__ import annotations

import asyncio
import threading
import time
import tomllib
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec.structs import replace

from acsard.core.messages.schema import Change, Info, ReplyData, ServiceReply
from acsard.web.calls import MAX_STOPS, MIN_STOP_INTERVAL_S, Calls, StopMerger, Stops

PATIENCE_S = 20.0


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


async def test_stops_of_one_client_are_merged_without_a_loss() -> None:
    merged, loop = StopMerger(), asyncio.get_running_loop()
    sent: list[float] = []

    async def stop() -> ServiceReply:
        sent.append(loop.time())
        return ServiceReply(True, str(len(sent)))

    async def asked() -> None:
        begun = loop.time()
        reply = await merged.send_stop("viewer", stop)
        assert sent[int(reply.message) - 1] >= begun

    for _ in range(3):
        await asyncio.gather(*(asked() for _ in range(100)))
    # On a busy machine, 100 stops may take longer than one interval.
    assert 4 <= (merged_stops := len(sent)) < 20
    # The time begins shortly before a stop is sent.
    assert all(later - sooner > 0.9 * MIN_STOP_INTERVAL_S for sooner, later in pairwise(sent))
    await asyncio.gather(*(merged.send_stop(f"viewer {n}", stop) for n in range(9)))
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


class KeepingRobot:
    """A daemon on this machine that sets everything, as the connection of the page."""

    id, gone = "acsar", ""

    def __init__(self) -> None:
        self.client, self.asked = self, list[object]()

    def get(self, key: str) -> Info:
        return Info("acsar", "0", 1, "sim", True, 100.0, [], [])

    def set(self, settings: object) -> ServiceReply:
        return self.request("set", {"settings": settings})

    def request(self, verb: str, fields: object) -> ServiceReply:
        self.asked.append(fields)
        return ServiceReply(True, "done", ReplyData(changes={"rates.telemetry": Change(10.0, 5.0)}))

    def refresh_about(self) -> None: ...


async def test_keep_writes_the_file_of_the_page_or_says_why_it_may_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, file = KeepingRobot(), tmp_path / "robot.toml"
    monkeypatch.setattr("acsard.web.calls._named", lambda *_: robot)
    monkeypatch.setattr("acsard.web.calls.require", lambda *_: None)
    monkeypatch.setattr("acsard.machine.kept_settings.is_daemon_here", lambda pid: True)
    calls, wish = Calls(cast(Any, robot), str(file)), {"settings": {"rates.telemetry": 5}}
    file.touch(0o444)
    refused = await calls.call(cast(Any, None), "set", wish | {"keep": True})
    assert "it is read-only" in refused.message
    assert not refused.success
    assert not robot.asked
    file.chmod(0o644)
    kept = await calls.call(cast(Any, None), "set", wish | {"keep": True})
    assert kept == replace(robot.request("", wish), message=f"done; written to {file}")
    del robot.asked[-1]
    assert tomllib.loads(file.read_text()) == {"rates": {"telemetry": 5}}
    assert (await calls.call(cast(Any, None), "set", wish | {"keep": False})).message == "done"
    assert robot.asked == [wish, wish]
